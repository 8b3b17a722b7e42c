"""Medians and coverage of methods on the objects of a category.

Cells of a summary: ``instances`` and ``failed``; ``keypoints``, the mean number of those that did
not fail; over these the medians of the result table's errors, ``rotation_error_deg_90``, the 90th
percentile, and ``milliseconds``, the median time of an estimate; ``rotation_in_68``,
``rotation_in_95``, ``stretch_in_68``, ``stretch_in_95``, ``keypoints_within_68`` and
``keypoints_within_95``, the share of the truths that lie within the regions of these probabilities.
NaN where there is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.outcome import OK
from cadalign.evaluation.runs.opened import Cells, Run
from cadalign.evaluation.summary import (
    ConsoleTable,
    Summary,
    by_category_and_method,
    known,
    mean_of,
    median_of,
    text_rows,
    where,
)

_MEDIANS = (
    *(metrics.ROTATION, metrics.BEST_ROTATION),
    *(metrics.TRANSLATION, metrics.TRANSLATION_UP_TO_SCALE),
    *(metrics.BOX_IOU, metrics.BOX_IOU_UP_TO_SCALE, metrics.STATED_BOX_IOU_UP_TO_SCALE),
    metrics.KEYPOINT_ERROR,
)
_COVERAGE = (
    *(metrics.ROTATION_IN_68, metrics.ROTATION_IN_95),
    *(metrics.STRETCH_IN_68, metrics.STRETCH_IN_95),
    *(metrics.KEYPOINTS_IN_68, metrics.KEYPOINTS_IN_95),
)
GALLERY = _MEDIANS
"""Errors of single objects."""
HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.KEYPOINTS, metrics.ROTATION, metrics.ROTATION_90),
    *(*_MEDIANS[1:], *_COVERAGE, metrics.QUERY_MILLISECONDS),
)


def summarize(run: Run) -> list[Summary]:
    """A summary for every category and method, and for all categories together."""
    return by_category_and_method(run, _summarize)


def console_table(run: Run, summaries: Sequence[Summary]) -> ConsoleTable:
    """The summaries for the console."""
    shown = (
        *(metrics.INSTANCES, metrics.FAILED),
        *(replace(metrics.ROTATION, digits=2), replace(metrics.ROTATION_90, digits=1)),
        *(replace(metrics.TRANSLATION_UP_TO_SCALE, digits=3), metrics.BOX_IOU_UP_TO_SCALE),
        *(replace(metrics.KEYPOINT_ERROR, digits=3), *_COVERAGE, metrics.QUERY_MILLISECONDS),
        *run.metrics,
    )
    return ConsoleTable(
        title="Medians per category and method, and truths within stated regions",
        labels=("category", "method"),
        heads=tuple(column.symbol for column in shown),
        rows=text_rows(summaries, shown),
        note="lengths in model diagonals; ~ scaled about the camera centre",
        narrow=True,
        wraps=True,
    )


def _summarize(category: str, method: str, cells: Cells) -> Summary:
    chosen = cells["method"] == method
    solved = where(cells, chosen & (cells["status"] == OK))
    count = int(chosen.sum())
    rotations = known(solved["rotation_error_deg"])
    values = {
        "instances": count,
        "failed": count - len(solved["method"]),
        "keypoints": mean_of(solved["keypoints"]),
        **{metric.key: median_of(solved[metric.key]) for metric in _MEDIANS},
        "rotation_error_deg_90": float(np.percentile(rotations, 90)) if len(rotations) else np.nan,
        **{
            f"{name}_in_{percent}": _share(solved[f"{name}_level"], percent / 100)
            for name in ("rotation", "stretch")
            for percent in (68, 95)
        },
        "keypoints_within_68": mean_of(solved["keypoints_within_68"]),
        "keypoints_within_95": mean_of(solved["keypoints_within_95"]),
        "milliseconds": median_of(1e3 * solved["seconds"]),
    }
    return Summary(category, {"category": category, "method": method}, values)


def _share(levels: npt.NDArray[np.object_], nominal: float) -> float:
    """Share of the known levels that are at most the nominal one; NaN of none."""
    found = known(levels)
    return float((found <= nominal).mean()) if len(found) else np.nan
