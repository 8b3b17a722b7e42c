"""An experiment that worker processes can import."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cadalign.evaluation.runs.work import AbortError, Columns, Rows


@dataclass(frozen=True)
class Squares:
    """An experiment that is quick and can be told to fail."""

    raises: tuple[int, ...] = ()
    kills: tuple[int, ...] = ()
    kills_once: tuple[int, ...] = ()
    full_disk: bool = False
    dead_on_arrival: bool = False
    scratch: Path | None = None

    @property
    def columns(self) -> Columns:
        return (("task", int), ("square", float), ("reason", str))

    @property
    def timing_columns(self) -> Columns:
        return (("task", int), ("process", int))

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)
        if self.dead_on_arrival:
            os.kill(os.getpid(), signal.SIGKILL)

    def evaluate(self, tasks: Sequence[int]) -> Rows:
        rows = []
        for task in tasks:
            if self.full_disk:
                raise AbortError("no room")
            if task in self.raises:
                raise ValueError(f"cannot square {task}")
            if task in self.kills:
                os.kill(os.getpid(), signal.SIGKILL)
            if task in self.kills_once and self.scratch is not None:
                flag = self.scratch / f"killed_{task}"
                if not flag.exists():
                    flag.touch()
                    os.kill(os.getpid(), signal.SIGKILL)
            rows.append({"task": task, "square": float(task) ** 2, "reason": ""})
        return Rows(rows, [{"task": task, "process": os.getpid()} for task in tasks])

    def failure(self, task: int, reason: str) -> Rows:
        rows = [{"task": task, "square": None, "reason": reason}]
        return Rows(rows, [{"task": task, "process": 0}])
