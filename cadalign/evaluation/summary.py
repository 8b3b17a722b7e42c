"""Summaries of results: statistics of groups of rows, for the console and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray
from cadalign.evaluation.metrics import CATEGORY, Metric
from cadalign.evaluation.runs.work import OK, SKIPPED, Row

if TYPE_CHECKING:
    from cadalign.evaluation.runs.tables import Cells, Run

    Statistics = Mapping[str, Callable[["Group"], Any]]

ALL = "all"
"""Name of the summary over all categories."""


@dataclass(frozen=True)
class Summary:
    """Statistics of one method on one group of tasks: a row of ``summary.csv``.

    ``names`` are the cells that identify the row, with the method. ``values`` are numbers by
    column, in the units of the result table; NaN if unknown.
    """

    group: str
    names: Row
    values: Row

    @property
    def method(self) -> str:
        """Name of the method."""
        return str(self.names["method"])

    def __getitem__(self, column: str) -> Any:
        """A cell of the row."""
        return self.names[column] if column in self.names else self.values[column]

    def number(self, key: str) -> float | None:
        """The number of a metric; None if it is missing."""
        return self.values.get(key)

    def cells(self) -> Row:
        """All cells of the row."""
        return self.names | self.values


@dataclass(frozen=True)
class ConsoleTable:
    """A table for the console, with a note below.

    ``labels`` are the heads of text columns, which come first; ``heads`` are the heads of numeric
    columns. A grouped table separates rows that differ in the first column, and does not repeat
    equal cells in it.
    """

    title: str
    labels: tuple[str, ...]
    heads: tuple[str, ...]
    rows: list[tuple[str, ...]]
    note: str = ""
    grouped: bool = True


def summary_csv(summaries: Sequence[Summary], *, rename: Mapping[str, str]) -> str:
    """Format summaries as CSV; ``rename`` maps columns to other names. Unknown cells are empty."""
    rows = [summary.cells() for summary in summaries]
    head = [rename.get(name, name) for name in rows[0]]
    cells = [["" if value != value else value for value in row.values()] for row in rows]
    return csv_text([head, *cells])


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Format rows as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


class Group(NamedTuple):
    """Rows of a method on a group of tasks: all that count, and the successful ones."""

    rows: Cells
    solved: Cells


def summarize(
    run: Run,
    statistics: Statistics,
    *,
    by: Sequence[str] = (CATEGORY.key,),
    name: Callable[..., str] = str,
    apart: str = SKIPPED,
) -> list[Summary]:
    """Summarize every method on every group of tasks, and on all categories together.

    Tasks of a group have equal cells in the columns ``by``; without columns there is one group.
    ``name`` makes the group's name of these cells. Rows with the status ``apart`` do not count.
    Medians of users' metrics are added.
    """
    cells = run.cells
    statistics = {**statistics, **{each.key: median(each.key) for each in run.metrics}}
    choices: list[list[Any]] = [sorted(set(cells[key].tolist())) for key in by]
    if by[:1] == (CATEGORY.key,) and len(choices[0]) > 1:
        choices[0].append(None)
    found = []
    for values in product(*choices):
        chosen = np.ones(len(cells["method"]), dtype=bool)
        for key, value in zip(by, values, strict=True):
            chosen &= (cells[key] == value) | (value is None)
        labels = [f"category {each}" if each == ALL else each for each in values]
        labels = [ALL if each is None else each for each in labels]
        for method in run.methods:
            rows = select_rows(cells, chosen & (cells["method"] == method))
            rated = select_rows(rows, rows["status"] != apart)
            group = Group(rated, select_rows(rated, rated["status"] == OK))
            counts = [len(each["method"]) for each in (rows, *group)]
            if not counts[0]:
                continue
            names = {**dict(zip(by, labels, strict=True)), "method": method}
            numbers = {"instances": counts[1], "failed": counts[1] - counts[2]}
            numbers |= {key: statistic(group) for key, statistic in statistics.items()}
            numbers[apart.replace(" ", "_")] = counts[0] - counts[1]
            found.append(Summary(name(*labels) if labels else ALL, names, numbers))
    return found


def medians(*columns: Metric) -> Statistics:
    """Medians of columns, by column."""
    return {column.key: median(column.key) for column in columns}


def median(key: str, factor: float = 1.0) -> Callable[[Group], float]:
    """The median of a column, times a factor; NaN if the run lacks the column."""

    def made(group: Group) -> float:
        values = factor * drop_nan(group.solved.get(key, np.empty(0)))
        return float(np.median(values)) if len(values) else np.nan

    return made


def mean(key: str) -> Callable[[Group], float]:
    """The mean of a column."""
    return lambda group: mean_of(group.solved[key])


def share(is_within: Callable[[Cells], BoolArray]) -> Callable[[Group], float]:
    """The share of rows that are ok and satisfy a condition; NaN without rows."""

    def made(group: Group) -> float:
        count = len(group.rows["method"])
        return int(is_within(group.solved).sum()) / count if count else np.nan

    return made


milliseconds = median("seconds", 1e3)
"""Median time [ms]."""


def group_name(group: Metric, value: Any) -> str:
    """A group's name: the common value of its tasks, in the metric's unit."""
    return value if isinstance(value, str) else f"{group.factor * value:g}"


def select_rows(cells: Cells, chosen: npt.NDArray[np.bool_]) -> Cells:
    """Select rows by a mask (n,)."""
    return {name: column[chosen] for name, column in cells.items()}


def drop_nan(values: npt.NDArray[Any]) -> FloatArray:
    """The values (n,) that are not missing."""
    numbers = values.astype(float)
    return np.asarray(numbers[~np.isnan(numbers)])


def mean_of(values: npt.NDArray[Any]) -> float:
    """Mean of the values (n,) that are not missing; NaN if all are."""
    found = drop_nan(values)
    return float(found.mean()) if len(found) else np.nan
