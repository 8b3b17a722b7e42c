"""What a run does: an experiment turns tasks into table rows, chunk by chunk.

An experiment is a small picklable object; a task is whatever it needs to know of one instance,
also picklable. Nothing here says on which machine or in which order chunks are handled, and an
experiment must not let its rows depend on that: all randomness comes from the run's seed and the
task's name (`cadalign.seeding.instance_rng`).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar, runtime_checkable

from cadalign.errors import CadalignError, DataError

T = TypeVar("T")
T_contra = TypeVar("T_contra", contravariant=True)

Row = dict[str, Any]
Columns = tuple[tuple[str, type], ...]
"""Names of a table's columns and their types: str, int, float or bool. Cells may be None."""


@dataclass(frozen=True)
class Result:
    """The rows that came of some tasks.

    Parameters
    ----------
    rows : list of dict
        Of the result table; the same in every run.
    timings : list of dict
        Of the table of what differs from run to run.
    exhibits : list of dict
        Of the table of what there is to see, for experiments that are `Exhibiting`.
    """

    rows: list[Row]
    timings: list[Row]
    exhibits: list[Row] = field(default_factory=list)

    @classmethod
    def joined(cls, parts: Sequence[Result]) -> Result:
        """Put results of successive tasks together."""
        return cls(
            [row for part in parts for row in part.rows],
            [row for part in parts for row in part.timings],
            [row for part in parts for row in part.exhibits],
        )


class Experiment(Protocol[T_contra]):
    """What a run needs to know to turn tasks into rows."""

    @property
    def columns(self) -> Columns:
        """The columns of the result table."""

    @property
    def timing_columns(self) -> Columns:
        """The columns of the table of timings."""

    def warm_up(self) -> None:
        """Compile, in one worker, what all workers will need; must not depend on tasks."""

    def evaluate(self, tasks: Sequence[T_contra]) -> Result:
        """The rows of some tasks, in their order."""

    def failure(self, task: T_contra, reason: str) -> Result:
        """The rows of a task that could not be evaluated."""


@runtime_checkable
class Exhibiting(Protocol):
    """An experiment that also records what there is to see of its tasks, the same in every run."""

    @property
    def exhibit_columns(self) -> Columns:
        """The columns of the table of exhibits."""


class AbortError(DataError):
    """Something that no other instance would fare better with, such as a full disk."""


def evaluate_chunk(experiment: Experiment[T], tasks: Sequence[T]) -> Result:
    """Evaluate tasks; one that raises becomes failed rows and does not stop the others.

    Raises
    ------
    AbortError
        If the run cannot go on.
    """
    try:
        return experiment.evaluate(tasks)
    except AbortError as error:
        raise copy.copy(error) from None
    except Exception as error:
        if len(tasks) == 1:
            return experiment.failure(tasks[0], reason_of(error))
    return Result.joined([evaluate_chunk(experiment, [task]) for task in tasks])


def reason_of(error: Exception) -> str:
    """An error in one line; ours speak for themselves, others are named."""
    return str(error) if isinstance(error, CadalignError) else f"{type(error).__name__}: {error}"
