"""Medians and success rates of methods on the models of a category."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cadalign.evaluation import metrics
from cadalign.evaluation.accuracy.methods import LIMIT
from cadalign.evaluation.outcome import OK
from cadalign.evaluation.runs.opened import Cells, Run
from cadalign.evaluation.summary import ALL, ConsoleTable, Line, mean_of, median_of, where

MEDIANS = tuple(metric.key for metric in metrics.INSTANCE_METRICS if metric is not metrics.RMS)
TABLE = (
    *(metrics.KEYPOINTS, metrics.ROTATION, metrics.TRANSLATION),
    *(metrics.SCALE_Y, metrics.SCALE_Z, metrics.BOX_IOU),
)
"""Columns of the plain medians."""
HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, *TABLE, metrics.SYM_ROTATION),
    *(metrics.SUCCESS_5, metrics.SUCCESS_10, metrics.OVER_BOUND),
)


@dataclass(frozen=True)
class CategorySummary:
    """Numbers of one method on one category's instances.

    Parameters
    ----------
    category, method : str
    instances, failed : int
        Their number, and that of those that failed.
    keypoints : float
        Mean number of keypoints of those that didn't fail.
    rotation_error_deg to sym_box_iou : float
        Medians of the result table's columns over those that didn't fail; NaN where all failed.
    success_5deg_5pct, success_10deg_10pct : float
        Share of all instances, failed ones too, with symmetry-aware rotation error, translation
        error in diagonals of the model's box and both relative scale errors at most this.
    over_limit : float
        Median rotation error over that of the Cramer-Rao bound; NaN where that was not evaluated.
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

    def cells(self) -> dict[str, Any]:
        """All numbers by name."""
        return dict(vars(self))

    def texts(self) -> list[str]:
        """The plain medians as shown."""
        return [column.text(getattr(self, column.key)) for column in TABLE]


def summarize(run: Run) -> list[CategorySummary]:
    """A summary for every category and method, and for all categories together."""
    cells = run.cells
    categories = sorted(set(cells["category"].tolist()))
    summaries = [
        summary
        for name in categories
        for summary in summarize_cells(name, where(cells, cells["category"] == name))
    ]
    return [*summaries, *summarize_cells(ALL, cells)]


def summarize_cells(category: str, cells: Cells) -> list[CategorySummary]:
    """A summary for every method, in the order in which they come.

    Parameters
    ----------
    category : str
        Name of these rows.
    cells : dict of array
        Columns of a result table.
    """
    methods = list(dict.fromkeys(cells["method"].tolist()))
    bound = np.nan
    if LIMIT in methods:
        solved = (cells["method"] == LIMIT) & (cells["status"] == OK)
        bound = median_of(cells["rotation_error_deg"][solved])
    return [_summarize_method(category, method, cells, bound) for method in methods]


def lines(summaries: Sequence[CategorySummary]) -> list[Line]:
    """Lines of the headline table; a single category needs no line for all."""
    categories = {summary.category for summary in summaries}
    return [
        Line(summary.category, summary.method, vars(summary))
        for summary in summaries
        if summary.category != ALL or len(categories) > 2
    ]


def console_table(run: Run, summaries: Sequence[CategorySummary]) -> ConsoleTable:
    """The summaries for the console."""
    shown = (metrics.INSTANCES, metrics.FAILED, *TABLE, metrics.SYM_ROTATION, metrics.SUCCESS_5)
    return ConsoleTable(
        title="Medians per category and method; success over all instances",
        labels=("category", "method"),
        heads=tuple(column.symbol for column in shown),
        rows=[
            (s.category, s.method, *(column.text(getattr(s, column.key)) for column in shown))
            for s in summaries
        ],
        note="t in model diagonals; * rotations that map a model onto itself are no errors",
    )


def _summarize_method(category: str, method: str, cells: Cells, bound: float) -> CategorySummary:
    chosen = cells["method"] == method
    solved = where(cells, chosen & (cells["status"] == OK))
    count = int(chosen.sum())
    medians = {name: median_of(solved[name]) for name in MEDIANS}
    return CategorySummary(
        category=category,
        method=method,
        instances=count,
        failed=count - len(solved["method"]),
        keypoints=mean_of(solved["keypoints"]),
        success_5deg_5pct=_success(solved, 5.0, 0.05) / max(count, 1),
        success_10deg_10pct=_success(solved, 10.0, 0.10) / max(count, 1),
        over_limit=medians["rotation_error_deg"] / bound if bound > 0 else np.nan,
        **medians,
    )


def _success(solved: Cells, degrees: float, fraction: float) -> int:
    """Number of instances within an angle, and a fraction of diagonal and scales."""
    within = solved["sym_rotation_error_deg"].astype(float) <= degrees
    for name in ("sym_translation_error", "scale_y_error", "scale_z_error"):
        within &= solved[name].astype(float) <= fraction
    return int(within.sum())
