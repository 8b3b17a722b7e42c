"""Summaries of results: lines of tables, quartiles, medians, and their CSV file."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.evaluation.metrics import CATEGORY, Metric
from cadalign.evaluation.outcome import OK
from cadalign.evaluation.runs.opened import Cells, Run

ALL = "all"
"""Name of the summary over all categories."""


@dataclass(frozen=True)
class Line:
    """Numbers of one method on one group of tasks: a line of a headline table.

    Parameters
    ----------
    group : str
        Name of the group.
    method : str
    values : dict
        Numbers by the metric's key, in the metric's own unit.
    """

    group: str
    method: str
    values: Mapping[str, Any]

    def cells(self) -> dict[str, Any]:
        """All numbers by name, flat."""
        return {"group": self.group, "method": self.method, **self.values}


class Summary(Protocol):
    """What a summary must tell of itself."""

    def cells(self) -> dict[str, Any]:
        """All numbers by name, flat: a row of ``summary.csv``."""


@dataclass(frozen=True)
class ConsoleTable:
    """A table for the console.

    Parameters
    ----------
    title : str
    labels : tuple of str
        Heads of the columns of texts, which come first.
    heads : tuple of str
        Heads of the columns of numbers.
    rows : list of tuple of str
    note : str
        Text beneath.
    narrow : bool
        Without frame and with little room between columns.
    grouped : bool
        Set apart the rows that differ in the first column, which is not repeated.
    wraps : bool
        Heads may take several lines.
    """

    title: str
    labels: tuple[str, ...]
    heads: tuple[str, ...]
    rows: list[tuple[str, ...]]
    note: str = ""
    narrow: bool = False
    grouped: bool = True
    wraps: bool = False


@dataclass(frozen=True)
class Conclusion:
    """Numbers of rows, and of failed ones, that a finished run ends with.

    Parameters
    ----------
    rows, failed : int
    counts : dict
        More numbers to be told.
    note : str
        What is to be said of the failed rows.
    """

    rows: int
    failed: int
    counts: dict[str, int] = field(default_factory=dict)
    note: str = ""


@dataclass(frozen=True)
class Quartiles:
    """Quartiles, NaN where there are none.

    Parameters
    ----------
    lower, median, upper : float
    """

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


def flat(summary: object) -> dict[str, Any]:
    """The fields of a summary by name, quartiles as three cells."""
    cells: dict[str, Any] = {}
    for name, value in vars(summary).items():
        if isinstance(value, Quartiles):
            for quartile in ("lower", "median", "upper"):
                suffix = "" if quartile == "median" else "_quartile"
                cells[f"{name}_{quartile}{suffix}"] = getattr(value, quartile)
        else:
            cells[name] = value
    return cells


def summary_csv(summaries: Sequence[Summary]) -> str:
    """The summaries as a CSV file; cells without a number are empty."""
    rows = [summary.cells() for summary in summaries]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: "" if value != value else value for name, value in row.items()})
    return text.getvalue()


def medians(run: Run, columns: Sequence[Metric], *, group: Metric = CATEGORY) -> list[Line]:
    """Numbers of rows, of failures, and medians of the others, for every group and method.

    Parameters
    ----------
    run : Run
    columns : sequence of Metric
        Of which those are taken that are columns of the run's results.
    group : Metric
        The column that rows are grouped by.
    """
    cells = run.cells
    metrics = [metric.key for metric in columns if metric.key in cells]
    lines = []
    for value in sorted(set(cells[group.key].tolist())):
        for method in run.methods:
            chosen = (cells[group.key] == value) & (cells["method"] == method)
            solved = chosen & (cells["status"] == OK)
            counts = {"instances": int(chosen.sum()), "failed": int((chosen & ~solved).sum())}
            values = {name: median_of(cells[name][solved]) for name in metrics}
            lines.append(Line(group_name(group, value), method, {**counts, **values}))
    return lines


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
