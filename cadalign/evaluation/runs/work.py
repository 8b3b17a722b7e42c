"""Experiments as the engine sees them: tasks become table rows, chunk by chunk.

An experiment is a small picklable object; a task is all that it needs to know of one instance, also
picklable. Chunks are handled on any machine and in any order, and an experiment must not let its
rows depend on that: all randomness comes from the run's seed and the task's name
(`cadalign.arrays.instance_rng`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from cadalign.errors import CadalignError, DataError, TooFewVisibleError

T = TypeVar("T")
T_contra = TypeVar("T_contra", contravariant=True)

Row = dict[str, Any]
"""Cells of a table by column; what is missing or None is an empty cell."""
Columns = tuple[tuple[str, Any], ...]
"""Names of a table's columns and their types: str, int, float or bool."""

COLUMNS: Columns = (("method", str), ("status", str), ("reason", str))
"""Columns of the result table of every experiment."""
OK = "ok"
FAILED = "failed"
LEFT_OUT = "left out"
"""Status of an instance, or a method on it, that lacks what is asked for: neither failed nor ok."""
UNREADABLE = "unreadable"
"""The category of records that cannot be read."""
SKIPPED = "skipped"
"""Status of an instance that no view shows enough keypoints of: no method was run."""


class LeftOutError(CadalignError):
    """An instance, or a method on it, lacks what is asked for; that is no failure."""


@dataclass(frozen=True)
class Outcome:
    """Result of one method on one task.

    ``names`` are the columns that name the row, such as category, model id and method; ``values``
    those of facts and metrics, as far as they are known. ``status`` is ``ok``, ``failed``,
    ``left out``, ``skipped`` or one of the experiment's own, ``reason`` why it is not ok.
    ``seconds`` are not part of a result table, since no two runs agree on them.
    """

    names: Row
    values: Row = field(default_factory=dict)
    status: str = OK
    reason: str = ""
    seconds: float | None = None

    @property
    def is_ok(self) -> bool:
        """True where there are metrics."""
        return self.status == OK

    def row(self) -> Row:
        """The row of the result table, and its seconds."""
        named = {**self.names, "status": self.status, "reason": self.reason}
        return {**named, **self.values, "seconds": self.seconds}


def status_of(error: Exception) -> str:
    """The status of a row without metrics, by the reason that there are none."""
    if isinstance(error, TooFewVisibleError):
        return SKIPPED
    return LEFT_OUT if isinstance(error, LeftOutError) else FAILED


def reason_of(error: Exception) -> str:
    """An error in one line; errors of other packages with their type's name."""
    if isinstance(error, CadalignError):
        return str(error)
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


class Experiment(Protocol[T_contra]):
    """Interface by which a run turns tasks into rows, with cells of all three tables."""

    @property
    def columns(self) -> Columns:
        """The columns of the result table."""

    @property
    def record_columns(self) -> Columns:
        """The columns of the table of records, for rows that have the last one; may be empty."""

    def evaluate(self, tasks: Sequence[T_contra]) -> list[Row]:
        """The rows of some tasks, in their order."""

    def failure(self, task: T_contra, reason: str) -> list[Row]:
        """The rows of a task that could not be evaluated."""


@dataclass(frozen=True)
class Plan(Generic[T]):
    """All that a run needs to be done."""

    experiment: Experiment[T]
    tasks: Sequence[T]
    """In the order of the result table. Sliced, and only as far as chunks are handed out."""
    config: dict[str, Any]
    """All that the results depend on, JSON; the run can only go on with the same."""
    chunk_size: int
    """Number of tasks that a worker gets at a time. Part of the configuration: another size would
    cut a half-done run into other chunks."""


def fingerprint(*parts: str | bytes | npt.NDArray[Any]) -> str:
    """Hash for a run's configuration of what it must not go on without, or with another."""
    digest = hashlib.sha256()
    for part in parts:
        data = np.ascontiguousarray(part).tobytes() if isinstance(part, np.ndarray) else part
        digest.update(data.encode("utf-8", "replace") if isinstance(data, str) else data)
    return digest.hexdigest()[:16]


def fingerprint_of_files(paths: Iterable[Path]) -> str:
    """Hash of names, sizes and times: to read thousands of files would take as long as a run."""
    lines = []
    for path in paths:
        try:
            status = path.stat()
        except (OSError, ValueError):
            continue  # whoever reads it says so
        lines.append(f"{path.name} {status.st_size} {status.st_mtime_ns}\n")
    return fingerprint(*lines)


class AbortError(DataError):
    """A failure that would repeat with every other instance, such as a full disk."""
