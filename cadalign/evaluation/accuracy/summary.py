"""Summaries of outcomes: the columns of the AEPnP paper's Table 1, success rates, the limit."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.evaluation.accuracy.methods import LIMIT
from cadalign.evaluation.accuracy.outcome import OK, Outcome

ALL = "all"
"""What the summary over all categories is called."""
MEDIANS = (
    "rotation_error_deg",
    "translation_error",
    "scale_y_error",
    "scale_z_error",
    "box_iou",
    "sym_rotation_error_deg",
    "sym_translation_error",
    "sym_box_iou",
)
_Cells = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class CategorySummary:
    """What one method did on one category's instances.

    Parameters
    ----------
    category, method : str
    instances, failed : int
        How many there are, and how many of them failed.
    keypoints : float
        Mean number of keypoints of those that didn't fail.
    rotation_error_deg, translation_error, scale_y_error, scale_z_error, box_iou : float
        Medians over those that didn't fail; the scale errors are fractions. NaN where all failed.
    sym_rotation_error_deg, sym_translation_error, sym_box_iou : float
        The same, from the nearest truth that looks the same.
    success_5deg_5pct, success_10deg_10pct : float
        Share of all instances, failed ones too, with symmetry-aware rotation error, translation
        error in diagonals of the model's box and both relative scale errors at most this.
    over_limit : float
        Median rotation error over that of the Cramer-Rao limit; NaN where that was not evaluated.
    """

    category: str
    method: str
    instances: int
    failed: int
    keypoints: float
    rotation_error_deg: float
    translation_error: float
    scale_y_error: float
    scale_z_error: float
    box_iou: float
    sym_rotation_error_deg: float
    sym_translation_error: float
    sym_box_iou: float
    success_5deg_5pct: float
    success_10deg_10pct: float
    over_limit: float = np.nan

    def cells(self) -> list[str]:
        """The plain medians as text, the scale errors in percent; a dash where there is none."""
        values = (
            (self.keypoints, ".1f"),
            (self.rotation_error_deg, ".3f"),
            (self.translation_error, ".4f"),
            (100 * self.scale_y_error, ".2f"),
            (100 * self.scale_z_error, ".2f"),
            (self.box_iou, ".3f"),
        )
        return ["-" if np.isnan(value) else format(value, form) for value, form in values]


def summarize(outcomes: Sequence[Outcome]) -> list[CategorySummary]:
    """A summary for every category and method, categories in alphabetical order."""
    rows = [outcome.row() for outcome in outcomes]
    cells = {name: np.array([row[name] for row in rows]) for name in Outcome.columns()}
    return [
        summary
        for category in sorted({row["category"] for row in rows})
        for summary in summarize_cells(category, _where(cells, cells["category"] == category))
    ]


def summarize_cells(category: str, cells: _Cells) -> list[CategorySummary]:
    """A summary for every method, in the order in which they come.

    Parameters
    ----------
    category : str
        What to call these rows.
    cells : dict of array
        Columns of a result table.
    """
    methods = list(dict.fromkeys(cells["method"].tolist()))
    limit = np.nan
    if LIMIT in methods:
        limit = _median(_where(cells, _solved(cells, LIMIT)), "rotation_error_deg")
    return [_summarize_method(category, method, cells, limit) for method in methods]


def summary_csv(summaries: Iterable[CategorySummary]) -> str:
    """The summaries as a CSV file."""
    names = [field.name for field in fields(CategorySummary)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    for summary in summaries:
        values = [getattr(summary, name) for name in names]
        writer.writerow(["" if value != value else value for value in values])
    return text.getvalue()


def _summarize_method(category: str, method: str, cells: _Cells, limit: float) -> CategorySummary:
    of_method = cells["method"] == method
    solved = _where(cells, _solved(cells, method))
    count = int(of_method.sum())
    medians = {name: _median(solved, name) for name in MEDIANS}
    return CategorySummary(
        category=category,
        method=method,
        instances=count,
        failed=count - len(solved["method"]),
        keypoints=float(solved["keypoints"].astype(float).mean())
        if len(solved["method"])
        else np.nan,
        success_5deg_5pct=_success(solved, 5.0, 0.05) / max(count, 1),
        success_10deg_10pct=_success(solved, 10.0, 0.10) / max(count, 1),
        over_limit=medians["rotation_error_deg"] / limit if limit > 0 else np.nan,
        **medians,
    )


def _success(solved: _Cells, degrees: float, fraction: float) -> int:
    within = solved["sym_rotation_error_deg"].astype(float) <= degrees
    for name in ("sym_translation_error", "scale_y_error", "scale_z_error"):
        within &= solved[name].astype(float) <= fraction
    return int(within.sum())


def _solved(cells: _Cells, method: str) -> npt.NDArray[np.bool_]:
    return np.asarray((cells["method"] == method) & (cells["status"] == OK))


def _where(cells: _Cells, chosen: npt.NDArray[np.bool_]) -> _Cells:
    return {name: column[chosen] for name, column in cells.items()}


def _median(cells: _Cells, name: str) -> float:
    values = cells[name].astype(float)
    values = values[~np.isnan(values)]
    return float(np.median(values)) if len(values) else np.nan
