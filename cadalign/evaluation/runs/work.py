"""Interface between experiments and the engine: tasks become table rows, chunk by chunk.

An experiment is a small picklable object. A task, also picklable, describes one instance. Rows must
not depend on the machine or on the order of chunks: all randomness comes from the run's seed and
the task's name (`cadalign.arrays.instance_rng`).
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
"""Cells of a table by column; missing cells and None are empty."""
Columns = tuple[tuple[str, Any], ...]
"""Names and types of a table's columns: str, int, float or bool."""

COLUMNS: Columns = (("method", str), ("status", str), ("reason", str))
"""Columns that every result table has."""
OK = "ok"
FAILED = "failed"
LEFT_OUT = "left out"
"""Status of an instance that lacks an input of the method: neither failed nor ok."""
UNREADABLE = "unreadable"
"""Category of records that cannot be read."""
SKIPPED = "skipped"
"""Status of an instance without a view of enough keypoints: no method was run."""


class LeftOutError(CadalignError):
    """An instance lacks an input of the method, which does not count as a failure."""


@dataclass(frozen=True)
class Outcome:
    """Result of one method on one task.

    ``names`` are the cells that identify the row, such as category, model id and method. ``values``
    are the known facts and metrics. ``status`` is ``ok``, ``failed``, ``left out``, ``skipped`` or
    specific to the experiment; ``reason`` explains any status but ok. ``seconds`` are not part of
    the result table, as they are not reproducible.
    """

    names: Row
    values: Row = field(default_factory=dict)
    status: str = OK
    reason: str = ""
    seconds: float | None = None

    @property
    def is_ok(self) -> bool:
        """True if there are metrics."""
        return self.status == OK

    def row(self) -> Row:
        """The row of the result table, with its seconds."""
        named = {**self.names, "status": self.status, "reason": self.reason}
        return {**named, **self.values, "seconds": self.seconds}


def status_of(error: Exception) -> str:
    """The status of a row that has an error instead of metrics."""
    if isinstance(error, TooFewVisibleError):
        return SKIPPED
    return LEFT_OUT if isinstance(error, LeftOutError) else FAILED


def reason_of(error: Exception) -> str:
    """Format an error in one line, with its type unless it is a CadalignError."""
    if isinstance(error, CadalignError):
        return str(error)
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


class Experiment(Protocol[T_contra]):
    """Interface of experiments: turns tasks into rows, with the columns of all three tables."""

    @property
    def columns(self) -> Columns:
        """Columns of the result table."""

    @property
    def record_columns(self) -> Columns:
        """Columns of the table of records, or none; a row is a record if it has the last one."""

    def evaluate(self, tasks: Sequence[T_contra]) -> list[Row]:
        """Rows of tasks, in their order."""

    def failure(self, task: T_contra, reason: str) -> list[Row]:
        """Rows of a task that could not be evaluated."""


@dataclass(frozen=True)
class Plan(Generic[T]):
    """Plan of a run."""

    experiment: Experiment[T]
    tasks: Sequence[T]
    """In the order of the result table; sliced on demand, chunk by chunk."""
    config: dict[str, Any]
    """Everything that the results depend on, as JSON; a run continues only if it is equal."""
    chunk_size: int
    """Number of tasks per chunk. Part of the configuration, as the files of an interrupted run
    depend on it."""


def fingerprint(*parts: str | bytes | npt.NDArray[Any]) -> str:
    """Hash of data, for a run's configuration: a run continues only with equal data."""
    digest = hashlib.sha256()
    for part in parts:
        data = np.ascontiguousarray(part).tobytes() if isinstance(part, np.ndarray) else part
        digest.update(data.encode("utf-8", "replace") if isinstance(data, str) else data)
    return digest.hexdigest()[:16]


def fingerprint_of_files(paths: Iterable[Path]) -> str:
    """Hash of names, sizes and times of files, as reading them would take too long."""
    lines = []
    for path in paths:
        try:
            status = path.stat()
        except (OSError, ValueError):
            continue  # its reader raises the error
        lines.append(f"{path.name} {status.st_size} {status.st_mtime_ns}\n")
    return fingerprint(*lines)


class AbortError(DataError):
    """A failure that every other instance would repeat, such as a full disk."""
