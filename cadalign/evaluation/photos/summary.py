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

from cadalign.evaluation import metrics
from cadalign.evaluation.metrics import HIGH, Metric
from cadalign.evaluation.outcome import FAILED, LEFT_OUT, OK
from cadalign.evaluation.photos.metrics.nine_dof import DEGREE_CM, IOU_THRESHOLDS
from cadalign.evaluation.photos.metrics.pascal3d import ACCURACY_DEG
from cadalign.evaluation.photos.protocols import (
    BOP,
    KITTI,
    NINE_DOF,
    SCAN2CAD,
    VIEWPOINT,
    protocol_of,
)
from cadalign.evaluation.photos.sighting import SIMULATED
from cadalign.evaluation.photos.tasks import UNREADABLE
from cadalign.evaluation.runs.opened import Cells, Run
from cadalign.evaluation.summary import (
    ALL,
    ConsoleTable,
    Summary,
    known,
    mean_of,
    median_of,
    summaries_of,
    text_rows,
    where,
)

MEAN = "mean of categories"
_RATE = Metric("", "", "%", 1, better=HIGH, factor=100.0, log=False)


def _rate(key: str, label: str, symbol: str) -> Metric:
    return replace(_RATE, key=key, label=label, head=label, symbol=symbol)


LEFT_OUT_COUNT = replace(
    metrics.FAILED, key="left_out", label="left out", head="left out", symbol="out"
)
ROTATION = replace(metrics.ROTATION, digits=2)
TRANSLATION = Metric("translation_cm", "translation error", "cm", symbol="t cm", limit=50.0)
SCAN2CAD_TRANSLATION = Metric("scan2cad_translation_m", "translation error", "m", 3, symbol="t m")
SCAN2CAD_SCALE = Metric("scan2cad_scale", "mean scale error", "%", 1, factor=100.0, symbol="s %")
YAW = Metric("yaw_error_deg", "yaw error", "deg", symbol="yaw", limit=30.0)
YAW_90 = replace(
    YAW, key="yaw_error_deg_90", label="90th percentile of the yaw error", head="yaw error, 90 %",
    symbol="yaw90",
)  # fmt: skip
DEPTH = Metric(
    "depth_error_relative", "depth error", "%", 1, factor=100.0, symbol="depth %", limit=50.0
)
IOU_3D = replace(metrics.BOX_IOU, key="iou_3d", label="3D IoU", head="3D IoU", symbol="IoU3D")
IOU_BEV = replace(
    metrics.BOX_IOU, key="iou_bev", label="bird's-eye IoU", head="bird's-eye IoU", symbol="BEV"
)
MSSD = Metric("mssd", "MSSD", "diameters", 4)
MSPD = Metric("mspd_px", "MSPD", "px", symbol="MSPD px")
_RECALLS = tuple(
    _rate(f"{name}_recall", f"average recall of {name.upper()}", name.upper())
    for name in ("vsd", "mssd", "mspd")
)
AVERAGE_RECALL = _rate("average_recall", "average recall", "AR")
ACCURACY = _rate("accuracy_pi_6", "accuracy at pi/6", "Acc pi/6")
ALIGNED = _rate("scan2cad_aligned", "Scan2CAD accuracy", "acc %")
ALIGNED_AXES = _rate("scan2cad_aligned_axes", "Scan2CAD accuracy, each axis", "acc xyz %")
_IOUS = {limit: _rate(f"iou_{100 * limit:.0f}", f"IoU over {100 * limit:.0f} %",
                      f"IoU{100 * limit:.0f}") for limit in IOU_THRESHOLDS}  # fmt: skip
_DEGREE_CM = {
    (deg, cm): _rate(f"deg_{deg:.0f}_cm_{cm:.0f}", f"within {deg:.0f} deg, {cm:.0f} cm",
                     f"{deg:.0f}deg{cm:.0f}cm") for deg, cm in DEGREE_CM
}  # fmt: skip

_MEDIANS = (
    *(ROTATION, TRANSLATION, metrics.BOX_IOU, metrics.BOX_IOU_UP_TO_SCALE),
    *(SCAN2CAD_TRANSLATION, SCAN2CAD_SCALE, YAW, DEPTH, IOU_3D, IOU_BEV, MSSD, MSPD, metrics.RMS),
)
GALLERY = (*_MEDIANS, *_RECALLS)
"""Errors of single objects."""
_SHARES = (ALIGNED, ALIGNED_AXES, *_RECALLS)
"""Columns of single objects, of which failures have 0."""
HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, LEFT_OUT_COUNT, metrics.KEYPOINTS),
    # The data sets' own first.
    *(ALIGNED, ALIGNED_AXES, YAW, YAW_90, DEPTH, IOU_3D, IOU_BEV),
    *(AVERAGE_RECALL, *_RECALLS, MSSD, MSPD, ROTATION, ACCURACY, *_IOUS.values()),
    *(TRANSLATION, *_DEGREE_CM.values(), metrics.BOX_IOU, metrics.BOX_IOU_UP_TO_SCALE),
    *(SCAN2CAD_TRANSLATION, SCAN2CAD_SCALE, metrics.RMS, metrics.QUERY_MILLISECONDS),
)
_OF_KIND = {
    VIEWPOINT: (ROTATION, ACCURACY),
    NINE_DOF: (TRANSLATION, _DEGREE_CM[10.0, 10.0], _IOUS[0.5]),
    SCAN2CAD: (ALIGNED,),
    KITTI: (YAW, YAW_90, DEPTH, IOU_3D, IOU_BEV),
    BOP: (*_RECALLS, AVERAGE_RECALL),
}
"""Columns of each kind of metrics on the console, which is narrow."""


def summarize(run: Run) -> list[Summary]:
    """A summary for every category and method, for all together, and the mean of categories."""
    return summarize_cells(run.cells, run.methods)


def summarize_cells(cells: Cells, methods: Sequence[str]) -> list[Summary]:
    """Summaries of the columns of a result table; see `summarize`."""
    found = summaries_of({**cells, "category": _categories(cells)}, methods, _summarize)
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
    kinds = protocol_of(str(run.config.get("kind"))).metrics
    columns = (
        *(metrics.INSTANCES, metrics.FAILED, LEFT_OUT_COUNT),
        *(column for kind in kinds for column in _OF_KIND[kind]),
        *(replace(metrics.RMS, symbol="rms px"), metrics.QUERY_MILLISECONDS),
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
    yaws = known(solved[YAW.key])
    rates = {**_pose_rates(rated, solved), **_shares(rated, solved)}
    recalls = [rates[metric.key] for metric in _RECALLS]
    values = {
        "instances": len(rated["method"]),
        "failed": int((rated["status"] == FAILED).sum()),
        LEFT_OUT_COUNT.key: int(left_out.sum()),
        "keypoints": mean_of(solved["keypoints"]),
        **{metric.key: median_of(solved[metric.key]) for metric in _MEDIANS},
        YAW_90.key: float(np.percentile(yaws, 90)) if len(yaws) else np.nan,
        **rates,
        AVERAGE_RECALL.key: float(np.nanmean(recalls)) if np.isfinite(recalls).any() else np.nan,
        "milliseconds": 1e3 * median_of(solved["seconds"]),
    }
    return Summary(category, {"category": category, "method": method}, values)


def _pose_rates(rated: Cells, solved: Cells) -> dict[str, float]:
    """Shares within thresholds, of all instances whose truth is known."""
    rotation, translation = (solved[m.key].astype(float) for m in (ROTATION, TRANSLATION))
    iou = solved[metrics.BOX_IOU.key].astype(float)
    within = {ACCURACY.key: (rotation, rotation < ACCURACY_DEG)}
    for limit, metric in _IOUS.items():
        within[metric.key] = (iou, iou > limit)
    for (degrees, cm), metric in _DEGREE_CM.items():
        within[metric.key] = (translation, (rotation <= degrees) & (translation <= cm))
    failures = int((rated["status"] == FAILED).sum())
    return {
        key: _share_of(float(found.sum()), int(np.isfinite(values).sum()), failures)
        for key, (values, found) in within.items()
    }


def _shares(rated: Cells, solved: Cells) -> dict[str, float]:
    """Means of columns between 0 and 1, of all instances whose truth is known."""
    failures = int((rated["status"] == FAILED).sum())
    found = {metric.key: known(solved[metric.key]) for metric in _SHARES}
    return {k: _share_of(float(v.sum()), len(v), failures) for k, v in found.items()}


def _share_of(total: float, count: int, failures: int) -> float:
    """A mean over values and failures, which count as 0; NaN where no value is known."""
    return total / (count + failures) if count else np.nan


def _mean(found: Sequence[Summary]) -> Summary:
    """The mean of a method's values over categories; its counts are those of all."""
    (every,) = (each for each in found if each.group == ALL)
    single = [each for each in found if each.group not in (ALL, UNREADABLE)]
    counts = ("instances", "failed", LEFT_OUT_COUNT.key)
    values = {
        key: value if key in counts else mean_of(np.array([each.values[key] for each in single]))
        for key, value in every.values.items()
    }
    return Summary(MEAN, {"category": MEAN, "method": every.method}, values)


def _is_known(value: float) -> bool:
    return value == value
