"""Outcome of one task with one method: a row of a result table, or the reason of its failure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from cadalign.errors import CadalignError, TooFewVisibleError

if TYPE_CHECKING:
    from cadalign.evaluation.runs.tables import Row

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

    @classmethod
    def failure(cls, reason: str, names: Row, **values: Any) -> Outcome:
        """A failed task; ``values`` are the columns that are known of it all the same."""
        return cls(names, values, FAILED, reason)

    @property
    def is_ok(self) -> bool:
        """True where there are metrics."""
        return self.status == OK

    def row(self) -> Row:
        """The row of the result table."""
        return {**self.names, "status": self.status, "reason": self.reason, **self.values}

    def timing(self) -> Row:
        """The row of the table of timings."""
        return {**self.names, "seconds": self.seconds}


def status_of(error: Exception) -> str:
    """The status of a row without metrics, by the reason that there are none."""
    if isinstance(error, TooFewVisibleError):
        return SKIPPED
    return LEFT_OUT if isinstance(error, LeftOutError) else FAILED


def reason_of(error: Exception) -> str:
    """An error in one line; errors of other packages with their type's name."""
    return str(error) if isinstance(error, CadalignError) else f"{type(error).__name__}: {error}"
