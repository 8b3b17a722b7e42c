"""Headline tables: their columns and rows, the best values, the failures by reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa

from cadalign.evaluation.accuracy.methods import LIMIT
from cadalign.evaluation.accuracy.outcome import FAILED
from cadalign.report.looks import HIGH, LOW

_MOST_REASONS = 200
OTHER_REASONS = "other reasons"


@dataclass(frozen=True)
class Column:
    """A column of numbers.

    Parameters
    ----------
    key, label, unit : str
    digits : int
        Shown after the point.
    better : {"low", "high"}, optional
        Which values are better; None for those that are no quality, such as counts.
    factor : float
        Of the summary's value.
    """

    key: str
    label: str
    unit: str = ""
    digits: int = 2
    better: str | None = LOW
    factor: float = 1.0


@dataclass(frozen=True)
class HeadlineRow:
    """What one method reached.

    Parameters
    ----------
    run : int
        Which of the runs.
    category : str
        Or the value that was varied.
    method : str
    cells : dict of str to float
        By column, as displayed; None where there is none.
    best : tuple of str
        The columns in which no method did better on the same.
    """

    run: int
    category: str
    method: str
    cells: dict[str, float | None]
    best: tuple[str, ...] = ()


@dataclass(frozen=True)
class Failure:
    """Why instances failed, and how many."""

    run: int
    category: str
    method: str
    reason: str
    count: int


@dataclass(frozen=True)
class Headline:
    """The headline table.

    Parameters
    ----------
    group : str
        What ``category`` is.
    columns : tuple of Column
    rows : list of HeadlineRow
    failures : list of Failure
    paper : list of HeadlineRow
        What the AEPnP paper states on the same categories.
    note : str
    """

    group: str
    columns: tuple[Column, ...]
    rows: list[HeadlineRow]
    failures: list[Failure] = field(default_factory=list)
    paper: list[HeadlineRow] = field(default_factory=list)
    note: str = ""


COUNTS = (
    Column("instances", "instances", digits=0, better=None),
    Column("failed", "failed", digits=0, better=None),
)


def varied(column: str, value: float) -> str:
    """A value that was varied, as its axis has it."""
    return f"{100 * value:g}" if column in ("outliers", "outlier_share") else f"{value:g}"


def headline_row(
    run: int, category: str, method: str, values: dict[str, Any], columns: Sequence[Column]
) -> HeadlineRow:
    """A row of a summary's values by column, in the columns' units."""
    cells: dict[str, float | None] = {}
    for column in columns:
        value = values.get(column.key)
        known = value is not None and np.isfinite(value)
        cells[column.key] = column.factor * value if known and value is not None else None
    return HeadlineRow(run, category, method, cells)


def with_best(rows: Sequence[HeadlineRow], columns: Sequence[Column]) -> list[HeadlineRow]:
    """The rows with the best ones marked, among methods on the same; the limit is out of it."""
    best: dict[tuple[str, str], float] = {}
    rivals = Counter(row.category for row in rows if row.method != LIMIT)
    for column in columns:
        for row in rows:
            value = row.cells[column.key]
            if column.better is None or row.method == LIMIT or value is None:
                continue
            place = (row.category, column.key)
            choose = max if column.better == HIGH else min
            best[place] = choose(best.get(place, value), value)
    return [
        HeadlineRow(
            row.run,
            row.category,
            row.method,
            row.cells,
            tuple(
                column.key
                for column in columns
                if row.method != LIMIT
                and rivals[row.category] > 1
                and row.cells[column.key] is not None
                and row.cells[column.key] == best.get((row.category, column.key))
            ),
        )
        for row in rows
    ]


def failures_of(run: int, results: pa.Table, group: str) -> list[Failure]:
    """Reasons with their numbers, the most frequent first; rare ones beyond a number as one."""
    chosen = [results[name].to_pylist() for name in (group, "method", "status", "reason")]
    counts = Counter(
        (category if isinstance(category, str) else varied(group, category), method, reason)
        for category, method, status, reason in zip(*chosen, strict=True)
        if status == FAILED
    )
    listed = counts.most_common(_MOST_REASONS)
    rest: Counter[tuple[str, str, str]] = Counter()
    for (category, method, _), count in counts.most_common()[_MOST_REASONS:]:
        rest[category, method, OTHER_REASONS] += count
    return [Failure(run, *names, count) for names, count in (*listed, *rest.items())]
