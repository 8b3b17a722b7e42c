"""Medians and shares of methods on the objects of a category, by the data sets' metrics.

Cells of a summary: ``instances``, those with rows that are not left out, ``failed`` and
``left_out``; ``keypoints``, the mean number of those that did not fail; over these the medians of
the result table's errors, ``yaw_error_deg_90``, the 90th percentile, and ``milliseconds``, the
median time of an estimate. Of all instances, failures included: ``accuracy_pi_6``, the share of
rotation errors below 30 degrees; ``iou_25``, ``iou_50``, ``iou_75``, boxes with a larger IoU;
``deg_5_cm_5`` and the like; ``scan2cad_aligned``; ``mssd_recall``, ``mspd_recall`` and
``vsd_recall``, and their mean ``average_recall``. NaN where there is none, as for objects whose
truth is not known.

The categories of objects with simulated keypoints are marked so. Behind all categories comes
``mean of categories``, as Scan2CAD and PASCAL3D+ report.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.metrics.bop import BOP
from cadalign.evaluation.metrics.kitti import KITTI
from cadalign.evaluation.metrics.nine_dof import NINE_DOF
from cadalign.evaluation.metrics.pascal3d import VIEWPOINT
from cadalign.evaluation.metrics.scan2cad import SCAN2CAD
from cadalign.evaluation.metrics.sets import medians_of, shares_of
from cadalign.evaluation.metrics.table import Metric
from cadalign.evaluation.outcome import FAILED, LEFT_OUT, OK
from cadalign.evaluation.photos.protocols import SETS, protocol_of
from cadalign.evaluation.photos.sighting import SIMULATED
from cadalign.evaluation.photos.tasks import UNREADABLE
from cadalign.evaluation.runs.opened import Cells, Run
from cadalign.evaluation.summary import (
    ALL,
    ConsoleTable,
    Summary,
    mean_of,
    median_of,
    summaries_of,
    text_rows,
    where,
)

MEAN = "mean of categories"
GALLERY = (
    *(metric for each in SETS for metric in each.medians),
    metrics.RMS,
    *BOP.shares,
)
"""Errors of single objects."""
# The data sets' own first.
_OWN_FIRST = (SCAN2CAD, KITTI, BOP, VIEWPOINT, NINE_DOF)
HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.LEFT_OUT, metrics.KEYPOINTS),
    *(metric for each in _OWN_FIRST for metric in each.headline),
    *(metric for each in _OWN_FIRST for metric in each.details),
    *(metrics.RMS, metrics.QUERY_MILLISECONDS),
)


def summarize(run: Run) -> list[Summary]:
    """A summary for every category and method, for all together, and the mean of categories."""
    return summarize_cells(run.cells, run.methods, further=run.metrics)


def summarize_cells(
    cells: Cells, methods: Sequence[str], *, further: Sequence[Metric] = ()
) -> list[Summary]:
    """Summaries of the columns of a result table; see `summarize`."""
    marked = {**cells, "category": _categories(cells)}
    found = summaries_of(marked, methods, _summarize, further=further)
    names = dict.fromkeys(each.group for each in found if each.group not in (ALL, UNREADABLE))
    if len(names) < 2:
        return found
    return [*found, *(_mean([s for s in found if s.method == name]) for name in methods)]


def _categories(cells: Cells) -> npt.NDArray[np.object_]:
    """The rows' categories, those of objects with simulated keypoints marked."""
    categories, is_simulated = cells["category"], cells["source"] == SIMULATED
    known_otherwise = set(categories[(cells["status"] != LEFT_OUT) & ~is_simulated].tolist())
    only = set(categories[is_simulated].tolist()) - known_otherwise
    marked = is_simulated | np.isin(categories.astype(str), sorted(only))
    names = [
        f"{name}, {SIMULATED}" if mark else name
        for name, mark in zip(categories.tolist(), marked.tolist(), strict=True)
    ]
    return np.array(names, dtype=object)


def console_table(run: Run, summaries: Sequence[Summary]) -> ConsoleTable:
    """The summaries for the console: the columns that the data set has."""
    sets = protocol_of(str(run.config.get("kind"))).metrics
    columns = (
        *(metrics.INSTANCES, metrics.FAILED, metrics.LEFT_OUT),
        *(column for each in sets for column in each.console),
        *(replace(metrics.RMS, symbol="rms px"), metrics.QUERY_MILLISECONDS),
        *run.metrics,
    )
    shown = [column for column in columns if any(_is_known(each[column.key]) for each in summaries)]
    return ConsoleTable(
        title="Medians and shares per category and method",
        labels=("category", "method"),
        heads=tuple(column.symbol for column in shown),
        rows=text_rows(summaries, shown),
        note=_note(summaries),
        narrow=True,
        wraps=True,
    )


def _note(summaries: Sequence[Summary]) -> str:
    has_simulated = any(SIMULATED in each.group for each in summaries)
    more = f"; {SIMULATED}: keypoints projected with the true pose, with noise"
    return f"shares count failures{more if has_simulated else ''}"


def _summarize(category: str, method: str, cells: Cells) -> Summary:
    chosen = where(cells, cells["method"] == method)
    left_out = chosen["status"] == LEFT_OUT
    rated = where(chosen, ~left_out)
    solved = where(rated, rated["status"] == OK)
    values = {
        "instances": len(rated["method"]),
        "failed": int((rated["status"] == FAILED).sum()),
        metrics.LEFT_OUT.key: int(left_out.sum()),
        "keypoints": mean_of(solved["keypoints"]),
        **medians_of(SETS, solved, metrics.RMS),
        **shares_of(SETS, rated, solved),
        "milliseconds": 1e3 * median_of(solved["seconds"]),
    }
    return Summary(category, {"category": category, "method": method}, values)


def _mean(found: Sequence[Summary]) -> Summary:
    """The mean of a method's values over categories; its counts are those of all."""
    (every,) = (each for each in found if each.group == ALL)
    single = [each for each in found if each.group not in (ALL, UNREADABLE)]
    counts = ("instances", "failed", metrics.LEFT_OUT.key)
    values = {
        key: value if key in counts else mean_of(np.array([each.values[key] for each in single]))
        for key, value in every.values.items()
    }
    return Summary(MEAN, {"category": MEAN, "method": every.method}, values)


def _is_known(value: float) -> bool:
    return value == value
