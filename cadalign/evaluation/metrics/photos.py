"""Metrics of photos: sets of them, and those of PASCAL3D+ and of boxes with nine degrees.

A set is what a data set's protocol measures of each object, and shows of many. A new metric of
photos is a column and a line of one set, in the module with its formula; a new set is a module, and
its place in `cadalign.evaluation.photos.protocols`.

Tulsiani, Malik, "Viewpoints and Keypoints", CVPR 2015, section 4.1: accuracy at pi/6, median error.
Wang et al., "Normalized Object Coordinate Space for Category-Level 6D Object Pose and Size
Estimation" (NOCS), CVPR 2019, section 5: IoU at 25, 50 and 75 %, and degrees and cm.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.arrays import BoolArray
from cadalign.evaluation import metrics
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.metrics.errors import overlap_up_to_scale
from cadalign.evaluation.runs.work import Columns, Row
from cadalign.evaluation.summary import Group, known, medians
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.metrics import box_iou, rotation_error
from cadalign.geometry.symmetry import Symmetry

if TYPE_CHECKING:
    from cadalign.evaluation.photos.target import PhotoTarget
    from cadalign.evaluation.runs.tables import Cells
    from cadalign.evaluation.summary import Statistics


@dataclass(frozen=True)
class Rate:
    """A share of objects within thresholds, of those that have a value of a column."""

    metric: Metric
    column: Metric
    is_within: Callable[[Cells], BoolArray]


@dataclass(frozen=True)
class MetricSet:
    """Metrics of a protocol."""

    measure: Callable[[PhotoTarget, Alignment, Alignment, Box], Row]
    """Errors by column, some of which may be None: of an object, an estimate of the data set's
    model, the true one, and the estimated box."""
    columns: tuple[str, ...]  # columns of the result table, numbers
    medians: tuple[Metric, ...]  # columns whose medians are shown
    rates: tuple[Rate, ...] = ()
    shares: tuple[Metric, ...] = ()
    """Columns between 0 and 1 whose means over all objects are shown."""
    headline: tuple[Metric, ...] = ()  # first columns of the headline table
    details: tuple[Metric, ...] = ()  # its last columns
    console: tuple[Metric, ...] = ()  # columns of the console's table


def score_columns(sets: Iterable[MetricSet]) -> Columns:
    """The columns of some sets in the result table."""
    return tuple((name, float) for each in sets for name in each.columns)


def score_alignment(
    target: PhotoTarget, sets: Sequence[MetricSet], est: Alignment, box: Box
) -> Row:
    """Errors of an estimate by column; none where the truth is not known.

    ``est`` aligns the data set's model, ``box`` is the estimated box, both in the frame of the
    photo's camera.
    """
    gt = target.gt
    if gt is None:
        return {}
    return {
        name: value
        for each in sets
        for name, value in each.measure(target, est, gt, box).items()
        if value is not None
    }


def statistics_of(sets: Sequence[MetricSet], cells: Cells) -> Statistics:
    """Medians of the objects that did not fail, and shares of all whose truth is known.

    Failures count as misses. Shares of a column that has no value in a whole table, of ``cells``,
    are left out.
    """
    measured = {name for name, _ in score_columns(sets) if len(known(cells[name]))}
    found = medians(*(metric for each in sets for metric in each.medians))
    rates = (rate for each in sets for rate in (*each.rates, *map(_share_of, each.shares)))
    shares = {
        each.metric.key: partial(_rate, each) for each in rates if each.column.key in measured
    }
    return {**found, **shares}


def _share_of(metric: Metric) -> Rate:
    return Rate(metric, metric, lambda cells: np.nan_to_num(numbers(cells, metric)))


def _rate(rate: Rate, group: Group) -> float:
    failures = len(group.rows["method"]) - len(group.solved["method"])
    count = len(known(group.solved[rate.column.key])) + failures
    return float(rate.is_within(group.solved).sum()) / count if count else np.nan


def numbers(cells: Cells, metric: Metric) -> Any:
    """A column of numbers, NaN where one is missing."""
    return cells[metric.key].astype(float)


def model_rotation_error(*, est: Alignment, gt: Alignment, symmetry: Symmetry) -> float:
    """Rotation error [degrees] over all of a model's symmetries: protocols know no stretch."""
    return rotation_error(est=est, gt=replace(gt, scale=np.ones(3)), symmetry=symmetry)


# PASCAL3D+ ----------------------------------------------------------------------------------------

ACCURACY_DEG = 30.0
"""pi/6 [degrees]."""


ROTATION = replace(metrics.ROTATION, digits=2)
ACCURACY = metrics.rate("accuracy_pi_6", "accuracy at pi/6", "Acc pi/6")


def _measure_viewpoint(target: PhotoTarget, est: Alignment, gt: Alignment, box: Box) -> Row:
    error = model_rotation_error(est=est, gt=gt, symmetry=target.found.symmetry)
    return {ROTATION.key: error}


VIEWPOINT = MetricSet(
    _measure_viewpoint,
    columns=(ROTATION.key,),
    medians=(ROTATION,),
    rates=(Rate(ACCURACY, ROTATION, lambda cells: numbers(cells, ROTATION) < ACCURACY_DEG),),
    headline=(ROTATION, ACCURACY),
    console=(ROTATION, ACCURACY),
)

# Nine degrees of freedom --------------------------------------------------------------------------

IOU_THRESHOLDS = (0.25, 0.5, 0.75)
DEGREE_CM = ((5.0, 2.0), (5.0, 5.0), (10.0, 2.0), (10.0, 5.0), (10.0, 10.0))
"""Thresholds [degrees, cm]."""
# NOCS tries 20 rotations about an axis of symmetry.
_MAX_STEP = np.pi / 20


def nine_dof_iou(*, est: Box, gt: Box, symmetry: Symmetry) -> float:
    """Largest IoU of the true box and the estimated one over the object's symmetries.

    As in NOCS, the estimate is turned about its own centre by the symmetries' rotations, those
    about an axis in 20 steps; the boxes' axes are the model's. Raises InputError if a box has no
    volume.
    """
    rotations = symmetry.poses(max_step=_MAX_STEP)[:, :3, :3]
    return max(
        box_iou(est=Box(est.center, est.rotation @ turn, est.extents), gt=gt) for turn in rotations
    )


def degree_cm(
    *, est: Alignment, gt: Alignment, symmetry: Symmetry, metres: float
) -> tuple[float, float]:
    """Rotation error [degrees], symmetry-aware, and translation error [cm].

    ``metres`` is the length of one unit of the camera frame [m].
    """
    gap = float(np.linalg.norm(est.translation - gt.translation))
    degrees = model_rotation_error(est=est, gt=gt, symmetry=symmetry)
    return degrees, 100 * metres * gap


TRANSLATION = Metric("translation_cm", "translation error", "cm", symbol="t cm", limit=50.0)
_IOUS = {
    limit: metrics.rate(
        f"iou_{100 * limit:.0f}", f"IoU over {100 * limit:.0f} %", f"IoU{100 * limit:.0f}"
    )
    for limit in IOU_THRESHOLDS
}
_DEGREE_CM = {
    (deg, cm): metrics.rate(
        f"deg_{deg:.0f}_cm_{cm:.0f}",
        f"within {deg:.0f} deg, {cm:.0f} cm",
        f"{deg:.0f}deg{cm:.0f}cm",
    )
    for deg, cm in DEGREE_CM
}


def _measure_nine_dof(target: PhotoTarget, est: Alignment, gt: Alignment, box: Box) -> Row:
    found, gt_box = target.found, target.gt_box
    values: Row = {}
    if found.truth.metres is not None:
        how: dict[str, Any] = {"symmetry": found.symmetry, "metres": found.truth.metres}
        values[TRANSLATION.key] = degree_cm(est=est, gt=gt, **how)[1]
    if gt_box is not None and min(box.volume, gt_box.volume) > 0:
        iou = nine_dof_iou(est=box, gt=gt_box, symmetry=found.symmetry)
        values[metrics.BOX_IOU.key] = iou
        values[metrics.BOX_IOU_UP_TO_SCALE.key] = overlap_up_to_scale(est=box, gt=gt_box)
    return values


def _is_over(cells: Cells, *, limit: float) -> BoolArray:
    return np.asarray(numbers(cells, metrics.BOX_IOU) > limit)


def _is_within(cells: Cells, *, limits: tuple[float, float]) -> BoolArray:
    rotation, translation = numbers(cells, ROTATION), numbers(cells, TRANSLATION)
    return np.asarray((rotation <= limits[0]) & (translation <= limits[1]))


NINE_DOF = MetricSet(
    _measure_nine_dof,
    columns=(TRANSLATION.key, metrics.BOX_IOU.key, metrics.BOX_IOU_UP_TO_SCALE.key),
    medians=(TRANSLATION, metrics.BOX_IOU, metrics.BOX_IOU_UP_TO_SCALE),
    rates=(
        *(
            Rate(metric, metrics.BOX_IOU, partial(_is_over, limit=limit))
            for limit, metric in _IOUS.items()
        ),
        *(
            Rate(metric, TRANSLATION, partial(_is_within, limits=limits))
            for limits, metric in _DEGREE_CM.items()
        ),
    ),
    headline=(
        *(*_IOUS.values(), TRANSLATION, *_DEGREE_CM.values()),
        *(metrics.BOX_IOU, metrics.BOX_IOU_UP_TO_SCALE),
    ),
    console=(TRANSLATION, _DEGREE_CM[10.0, 10.0], _IOUS[0.5]),
)
