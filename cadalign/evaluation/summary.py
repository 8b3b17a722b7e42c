"""Summaries of results: lines of tables, quartiles, medians, and their CSV file."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.evaluation.metrics import CATEGORY, INSTANCES, Metric
from cadalign.evaluation.runs.work import OK, SKIPPED, Row

if TYPE_CHECKING:
    from cadalign.evaluation.runs.tables import Cells, Run

    Statistics = Mapping[str, Callable[[Cells], float]]

ALL = "all"
"""Name of the summary over all categories."""
MEAN = "mean of categories"
"""Name of the summary of the categories' own values."""


@dataclass(frozen=True)
class Summary:
    """Numbers of one method on one group of tasks: a row of ``summary.csv``, a line of a headline.

    ``names`` are the columns that name the row, the method among them; ``values`` numbers and
    `Quartiles` by column, in the metrics' own units, NaN for what is unknown. ``tasks`` is for the
    headline's column of that name, by default ``instances``.
    """

    group: str
    names: Row
    values: Row
    tasks: int | None = None

    @property
    def method(self) -> str:
        """Name of the method."""
        return str(self.names["method"])

    def __getitem__(self, column: str) -> Any:
        """A cell of the row."""
        return self.names[column] if column in self.names else self.values[column]

    def number(self, key: str) -> float | None:
        """The number of a metric, the median where there are quartiles; None if there is none."""
        if key == INSTANCES.key and self.tasks is not None:
            return self.tasks
        value = self.values.get(key)
        return value.median if isinstance(value, Quartiles) else value

    def cells(self) -> Row:
        """All cells, flat: quartiles are three."""
        cells = dict(self.names)
        for name, value in self.values.items():
            if isinstance(value, Quartiles):
                cells[f"{name}_lower_quartile"] = value.lower
                cells[f"{name}_median"] = value.median
                cells[f"{name}_upper_quartile"] = value.upper
            else:
                cells[name] = value
        return cells

    def to_dict(self) -> Row:
        """All cells for JSON."""
        quartiles = {name: vars(v) for name, v in self.values.items() if isinstance(v, Quartiles)}
        return {**self.names, **self.values, **quartiles}


@dataclass(frozen=True)
class ConsoleTable:
    """A table for the console, with a note beneath.

    ``labels`` head the columns of texts, which come first, ``heads`` those of numbers. A narrow
    table has no frame and little room between columns; a grouped one sets apart the rows that
    differ in the first column, which is not repeated; the heads of one that wraps may take several
    lines.
    """

    title: str
    labels: tuple[str, ...]
    heads: tuple[str, ...]
    rows: list[tuple[str, ...]]
    note: str
    narrow: bool = False
    grouped: bool = True
    wraps: bool = False

    @classmethod
    def of(
        cls,
        title: str,
        summaries: Sequence[Summary],
        shown: Sequence[Metric],
        *,
        labels: tuple[str, str] = ("category", "method"),
        note: str = "",
        **look: bool,
    ) -> ConsoleTable:
        """The table of the shown cells of summaries, each with its group and method."""
        heads = tuple(column.symbol for column in shown)
        rows = [
            (s.group, s.method, *(column.text(s.number(column.key)) for column in shown))
            for s in summaries
        ]
        return cls(title, labels, heads, rows, note, **look)


@dataclass(frozen=True)
class Conclusion:
    """Numbers of rows and of failed ones, and a note on these, that a finished run ends with."""

    rows: int
    failed: int
    counts: dict[str, int]
    note: str


@dataclass(frozen=True)
class Quartiles:
    """Quartiles, NaN where there are none."""

    lower: float
    median: float
    upper: float

    @classmethod
    def of(cls, values: FloatArray) -> Quartiles:
        """Quartiles of values (n,), infinite ones being failures.

        A quartile is NaN where so many failed that it is a failure: giving up on the hard inputs
        does not improve it.

        Examples
        --------
        >>> Quartiles.of(np.array([3.0, 1.0, 2.0, np.inf]))
        Quartiles(lower=1.0, median=2.0, upper=3.0)
        >>> Quartiles.of(np.array([1.0, np.inf, np.inf]))
        Quartiles(lower=1.0, median=nan, upper=nan)
        """
        if not len(values):
            return cls(np.nan, np.nan, np.nan)
        # Order statistics: interpolation would reckon with infinities.
        found = np.percentile(values, [25, 50, 75], method="inverted_cdf")
        return cls(*np.where(np.isfinite(found), found, np.nan).tolist())

    @classmethod
    def of_solved(cls, values: FloatArray) -> Quartiles:
        """Quartiles of the finite ones of values (n,)."""
        values = values[np.isfinite(values)]
        if not len(values):
            return cls(np.nan, np.nan, np.nan)
        return cls(*np.percentile(values, [25, 50, 75]).tolist())


def summary_csv(summaries: Sequence[Summary], *, rename: Mapping[str, str]) -> str:
    """The summaries as a CSV file, some columns by another name; unknown cells are empty."""
    rows = [summary.cells() for summary in summaries]
    head = [rename.get(name, name) for name in rows[0]]
    cells = [["" if value != value else value for value in row.values()] for row in rows]
    return csv_text([head, *cells])


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Rows as a CSV file."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def medians(run: Run, columns: Sequence[Metric], *, group: Metric = CATEGORY) -> list[Summary]:
    """Numbers of rows, of failures, and medians of the others, for every group and method.

    Columns that the run's results lack are left out.
    """
    statistics = {metric.key: median(metric.key) for metric in columns if metric.key in run.cells}
    summaries = []
    for value in sorted(set(run.cells[group.key].tolist())):
        cells = where(run.cells, run.cells[group.key] == value)
        for method in run.methods:
            names = {group.key: value, "method": method}
            values = _values(cells, method, statistics)
            summaries.append(Summary(group_name(group, value), names, values))
    return summaries


def by_category_and_method(run: Run, statistics: Statistics) -> list[Summary]:
    """A summary of each category's cells for every method, and of all where there are several.

    Statistics are of the rows that are ok. Medians of further metrics are added.
    """

    def summarize(category: str, method: str, cells: Cells) -> Summary:
        values = _values(cells, method, statistics)
        return Summary(category, {"category": category, "method": method}, values)

    return summaries_of(run.cells, run.methods, summarize, further=run.metrics)


def _values(cells: Cells, method: str, statistics: Statistics) -> Row:
    counts, _, solved = counted(cells, method)
    return {**counts, **{name: made(solved) for name, made in statistics.items()}}


def median(key: str) -> Callable[[Cells], float]:
    """The median of a column."""
    return lambda cells: median_of(cells[key])


def mean(key: str) -> Callable[[Cells], float]:
    """The mean of a column."""
    return lambda cells: mean_of(cells[key])


def percentile(key: str, percent: float) -> Callable[[Cells], float]:
    """A percentile of a column, NaN where all cells are missing."""

    def made(cells: Cells) -> float:
        values = known(cells[key])
        return float(np.percentile(values, percent)) if len(values) else np.nan

    return made


def milliseconds(cells: Cells) -> float:
    """The median time."""
    return median_of(1e3 * cells["seconds"].astype(float))


def summaries_of(
    cells: Cells,
    methods: Sequence[str],
    summarize: Callable[[str, str, Cells], Summary],
    *,
    further: Sequence[Metric] = (),
    single: bool = False,
) -> list[Summary]:
    """Summaries of cells by category for some methods; see `by_category_and_method`.

    ``single``: also of all cells where there is a single category.
    """
    categories = sorted(set(cells["category"].tolist()))
    groups = [f"category {name}" if name in (ALL, MEAN) else name for name in categories]
    chosen = (where(cells, cells["category"] == name) for name in categories)
    parts = list(zip(groups, chosen, strict=True))
    if single or len(parts) > 1:
        parts.append((ALL, cells))
    return [
        with_medians(summarize(category, method, found), found, further)
        for category, found in parts
        for method in methods
        if method in found["method"]
    ]


def with_medians(summary: Summary, cells: Cells, metrics: Sequence[Metric]) -> Summary:
    """The summary with medians of the rows of its method that are no failures."""
    if not metrics:
        return summary
    solved = (cells["method"] == summary.method) & (cells["status"] == OK)
    medians = {metric.key: median_of(cells[metric.key][solved]) for metric in metrics}
    return replace(summary, values={**summary.values, **medians})


def counted(cells: Cells, method: str) -> tuple[Row, int, Cells]:
    """Numbers of instances and of failures of a method, of skipped ones, and the rows without."""
    chosen = cells["method"] == method
    solved = where(cells, chosen & (cells["status"] == OK))
    skipped = int((chosen & (cells["status"] == SKIPPED)).sum())
    count = int(chosen.sum()) - skipped
    return {"instances": count, "failed": count - len(solved["method"])}, skipped, solved


def group_name(group: Metric, value: Any) -> str:
    """A group's name: the value that its tasks share, as shown."""
    return value if isinstance(value, str) else f"{group.factor * value:g}"


def where(cells: Cells, chosen: npt.NDArray[np.bool_]) -> Cells:
    """The chosen rows."""
    return {name: column[chosen] for name, column in cells.items()}


def known(values: npt.NDArray[Any]) -> FloatArray:
    """The values (n,) that are not missing."""
    numbers = values.astype(float)
    return np.asarray(numbers[~np.isnan(numbers)])


def median_of(values: npt.NDArray[Any]) -> float:
    """Median of the values (n,) that are not missing; NaN if all are."""
    found = known(values)
    return float(np.median(found)) if len(found) else np.nan


def mean_of(values: npt.NDArray[Any]) -> float:
    """Mean of the values (n,) that are not missing; NaN if all are."""
    found = known(values)
    return float(found.mean()) if len(found) else np.nan
