"""An experiment that worker processes can import."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cadalign.evaluation.runs.work import AbortError, Columns, Row


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
    def record_columns(self) -> Columns:
        return (("task", int), ("process", int))

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)
        if self.dead_on_arrival:
            os.kill(os.getpid(), signal.SIGKILL)

    def evaluate(self, tasks: Sequence[int]) -> list[Row]:
        rows: list[Row] = []
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
            row = {"task": task, "square": float(task) ** 2, "reason": "", "process": os.getpid()}
            rows.append(row)
        return rows

    def failure(self, task: int, reason: str) -> list[Row]:
        return [{"task": task, "square": None, "reason": reason, "process": 0}]
