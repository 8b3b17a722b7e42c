"""Medians and success rates of methods on the models of a category.

Cells of a summary: ``instances``, those that were not skipped, ``failed`` and ``skipped``;
``keypoints``, the mean number of those that did
not fail; medians of the result table's errors over these, NaN where all failed; those up to scale
only in runs that have them; ``success_5deg_5pct`` and ``success_10deg_10pct``, the share of all
instances, failed ones too, with symmetry-aware rotation error, translation error in diagonals of
the model and both relative scale errors at most this; ``over_limit``, the median rotation error
over that of the Cramer-Rao bound.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cadalign.evaluation.methods.fitted import LIMIT
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.metrics.table import Metric
from cadalign.evaluation.outcome import OK, SKIPPED
from cadalign.evaluation.runs.opened import Cells, Run
from cadalign.evaluation.summary import (
    ALL,
    ConsoleTable,
    Summary,
    mean_of,
    median_of,
    text_rows,
    where,
    with_medians,
)

MEDIANS = (
    *(metric.key for metric in metrics.INSTANCE_METRICS if metric is not metrics.RMS),
    *(metric.key for metric in metrics.UP_TO_SCALE),
)
TABLE = (
    *(metrics.KEYPOINTS, metrics.ROTATION, metrics.TRANSLATION),
    *(metrics.SCALE_Y, metrics.SCALE_Z, metrics.BOX_IOU),
)
"""Columns of the plain medians."""
HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.SKIPPED),
    *(*TABLE, *metrics.UP_TO_SCALE, metrics.SYM_ROTATION),
    *(metrics.SUCCESS_5, metrics.SUCCESS_10, metrics.OVER_BOUND),
)


def summarize(run: Run) -> list[Summary]:
    """A summary for every category and method, and for all categories together."""
    cells = run.cells
    categories = sorted(set(cells["category"].tolist()))
    summaries = [
        summary
        for name in categories
        for summary in summarize_cells(
            name, where(cells, cells["category"] == name), further=run.metrics
        )
    ]
    return [*summaries, *summarize_cells(ALL, cells, further=run.metrics)]


def summarize_cells(
    category: str, cells: Cells, *, further: Sequence[Metric] = ()
) -> list[Summary]:
    """A summary of rows for every method, in the order in which they come."""
    methods = list(dict.fromkeys(cells["method"].tolist()))
    bound = np.nan
    if LIMIT in methods:
        solved = (cells["method"] == LIMIT) & (cells["status"] == OK)
        bound = median_of(cells["rotation_error_deg"][solved])
    return [
        with_medians(_summarize_method(category, method, cells, bound), cells, further)
        for method in methods
    ]


def lines(summaries: Sequence[Summary]) -> list[Summary]:
    """Lines of the headline table; a single category needs no line for all."""
    single = len({summary.group for summary in summaries}) == 2
    return [summary for summary in summaries if summary.group != ALL or not single]


def texts(summary: Summary) -> list[str]:
    """The plain medians as shown."""
    return [column.text(summary[column.key]) for column in TABLE]


def console_table(run: Run, summaries: Sequence[Summary]) -> ConsoleTable:
    """The summaries for the console."""
    rest = (metrics.SYM_ROTATION, metrics.SUCCESS_5)
    if metrics.BOX_IOU_UP_TO_SCALE.key in run.cells:  # the table must not be wider
        rest = metrics.UP_TO_SCALE
    counts = (metrics.INSTANCES, metrics.FAILED, metrics.SKIPPED)
    told = [each for each in counts if metrics.told(each, [s[each.key] for s in summaries])]
    shown = (*told, *TABLE, *rest, *run.metrics)
    return ConsoleTable(
        title="Medians per category and method; success over all instances",
        labels=("category", "method"),
        heads=tuple(column.symbol for column in shown),
        rows=text_rows(summaries, shown),
        note="t in model diagonals; * rotations that map a model onto itself are no errors"
        if rest is not metrics.UP_TO_SCALE
        else "t in model diagonals; ~ up to scale: one image does not tell the size",
    )


def _summarize_method(category: str, method: str, cells: Cells, bound: float) -> Summary:
    chosen = cells["method"] == method
    solved = where(cells, chosen & (cells["status"] == OK))
    skipped = int((chosen & (cells["status"] == SKIPPED)).sum())
    count = int(chosen.sum()) - skipped
    medians = {name: median_of(solved[name]) for name in MEDIANS if name in solved}
    values = {
        "instances": count,
        "failed": count - len(solved["method"]),
        "keypoints": mean_of(solved["keypoints"]),
        **medians,
        "success_5deg_5pct": _success(solved, 5.0, 0.05) / count if count else np.nan,
        "success_10deg_10pct": _success(solved, 10.0, 0.10) / count if count else np.nan,
        "over_limit": medians["rotation_error_deg"] / bound if bound > 0 else np.nan,
        "skipped": skipped,
    }
    return Summary(category, {"category": category, "method": method}, values)


def _success(solved: Cells, degrees: float, fraction: float) -> int:
    """Number of instances within an angle, and a fraction of diagonal and scales."""
    within = solved["sym_rotation_error_deg"].astype(float) <= degrees
    for name in ("sym_translation_error", "scale_y_error", "scale_z_error"):
        within &= solved[name].astype(float) <= fraction
    return int(within.sum())
