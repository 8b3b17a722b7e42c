"""Medians of the errors by evidence, over the bounds, for every category and for all.

Cells of a summary: ``instances`` and ``failed``; over those that did not fail the mean number of
``keypoints``, the medians of the result table's errors, ``over_limit``, the median ratio of the
rotation error to its bound, and ``milliseconds``, the median time of an alignment. NaN where there
is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.outcome import OK, SKIPPED
from cadalign.evaluation.runs.opened import Cells, Run
from cadalign.evaluation.summary import (
    ConsoleTable,
    Summary,
    by_category_and_method,
    mean_of,
    median_of,
    text_rows,
    where,
)

ROTATION_BOUND = replace(
    metrics.ROTATION,
    key="rotation_bound_deg",
    label="rotation error of an ideal estimator",
    head="R bound",
    symbol="bound",
)
_MEDIANS = (
    *(metrics.ROTATION, metrics.TRANSLATION, metrics.SCALE_Y, metrics.SCALE_Z, metrics.BOX_IOU),
    *(ROTATION_BOUND, metrics.OVER_BOUND),
)
HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.SKIPPED, metrics.KEYPOINTS, *_MEDIANS),
    metrics.QUERY_MILLISECONDS,
)


def summarize(run: Run) -> list[Summary]:
    """A summary for every category and method, and for all categories together."""
    return by_category_and_method(run, _summarize)


def console_table(run: Run, summaries: Sequence[Summary]) -> ConsoleTable:
    """The summaries for the console."""
    shown = (
        *(metrics.INSTANCES, metrics.FAILED, metrics.ROTATION),
        *(replace(metrics.TRANSLATION, digits=4), metrics.SCALE_Y, metrics.SCALE_Z),
        *(metrics.BOX_IOU, ROTATION_BOUND, replace(metrics.OVER_BOUND, symbol="R/bound")),
        metrics.QUERY_MILLISECONDS,
        *run.metrics,
    )
    return ConsoleTable(
        title="Medians per category and evidence",
        labels=("category", "evidence"),
        heads=tuple(column.symbol for column in shown),
        rows=text_rows(summaries, shown),
        note="t in diagonals of the object; R/bound: median ratio to the instance's own bound",
        narrow=True,
        wraps=True,
    )


def _summarize(category: str, method: str, cells: Cells) -> Summary:
    chosen = cells["method"] == method
    solved = where(cells, chosen & (cells["status"] == OK))
    skipped = int((chosen & (cells["status"] == SKIPPED)).sum())
    count = int(chosen.sum()) - skipped
    seconds = np.asarray(solved["seconds"], dtype=float)
    values = {
        "instances": count,
        "failed": count - len(solved["method"]),
        "keypoints": mean_of(solved["keypoints"]),
        **{metric.key: median_of(solved[metric.key]) for metric in _MEDIANS},
        "milliseconds": median_of(1e3 * seconds),
        "skipped": skipped,
    }
    return Summary(category, {"category": category, "method": method}, values)
