"""Metrics of photos: sets of them, those of PASCAL3D+, of boxes, and of Scan2CAD.

A set is what a data set's protocol measures of each object, and shows of many. A new metric of
photos is a line of one set; a new set has its place in `cadalign.evaluation.experiments.photos`.

Tulsiani, Malik, "Viewpoints and Keypoints", CVPR 2015, section 4.1: accuracy at pi/6, median error.
Wang et al., "Normalized Object Coordinate Space for Category-Level 6D Object Pose and Size
Estimation" (NOCS), CVPR 2019, section 5: IoU of boxes over an object's symmetries.
Avetisyan et al., "Scan2CAD: Learning CAD Model Alignment in RGB-D Scans", CVPR 2019, section 8, and
the benchmark's script: 20 cm, 20 degrees and 20 % of scale.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.evaluation import metrics
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.metrics.errors import overlap_up_to_scale
from cadalign.evaluation.runs.work import Columns, Row
from cadalign.evaluation.summary import Group, known, medians
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.geometry.symmetry import Symmetry
from cadalign.metrics import box_iou, rotation_error, scale_error

if TYPE_CHECKING:
    from cadalign.evaluation.instances.sighting import PhotoTarget
    from cadalign.evaluation.runs.tables import Cells
    from cadalign.evaluation.summary import Statistics


@dataclass(frozen=True)
class Rate:
    """A share of objects, of those that have a value of a column."""

    metric: Metric
    column: Metric
    limit: float | None = None
    """Values below it count; without one, those that are not 0."""

    def count(self, values: FloatArray) -> int:
        """Number of the values (n,) that count."""
        within = values > 0 if self.limit is None else values < self.limit
        return int(within.sum())


@dataclass(frozen=True)
class MetricSet:
    """Metrics of a protocol."""

    measure: Callable[[PhotoTarget, Alignment, Alignment, Box], Row]
    """Errors by column, some of which may be None: of an object, an estimate of the data set's
    model, the true one, and the estimated box."""
    medians: tuple[Metric, ...]  # columns whose medians are shown
    rates: tuple[Rate, ...] = ()

    @property
    def shown(self) -> tuple[Metric, ...]:
        """The columns of its summary."""
        return (*(rate.metric for rate in self.rates), *self.medians)


@dataclass(frozen=True)
class Protocol:
    """Evaluation of a data set: its metrics, and what it is given."""

    metrics: tuple[MetricSet, ...]
    up_axis: str = "y"  # the upward axis of its models
    sigma_of_side: float = 1 / 64
    """Standard deviation of its keypoints as a share of the longer side of the object's rectangle:
    networks' heatmaps have 64 cells."""
    sigma_of_width: float | None = None  # the same as a share of the image's width


def score_columns(sets: Iterable[MetricSet]) -> Columns:
    """The columns of some sets in the result table."""
    found = (m for each in sets for m in (*each.medians, *(rate.column for rate in each.rates)))
    return tuple(dict.fromkeys((metric.key, float) for metric in found))


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
    found = medians(*(metric for each in sets for metric in each.medians))
    rates = (rate for each in sets for rate in each.rates)
    shares = {
        rate.metric.key: partial(_rate, rate)
        for rate in rates
        if len(known(cells[rate.column.key]))
    }
    return {**found, **shares}


def _rate(rate: Rate, group: Group) -> float:
    values = known(group.solved[rate.column.key])
    count = len(values) + len(group.rows["method"]) - len(group.solved["method"])
    return rate.count(values) / count if count else np.nan


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


VIEWPOINT = MetricSet(_measure_viewpoint, (ROTATION,), (Rate(ACCURACY, ROTATION, ACCURACY_DEG),))

# Boxes --------------------------------------------------------------------------------------------

_STEPS = 20  # about an axis of symmetry, as NOCS tries
TRANSLATION = Metric("translation_cm", "translation error", "cm", symbol="t cm")


def symmetric_box_iou(*, est: Box, gt: Box, symmetry: Symmetry) -> float:
    """Largest IoU of the true box and the estimated one over the object's symmetries.

    As in NOCS, the estimate is turned about its own centre by the symmetries' rotations, those
    about an axis in 20 steps; the boxes' axes are the model's. Raises InputError if a box has no
    volume.
    """
    angles = 2 * np.pi * np.arange(_STEPS) / _STEPS
    about = [rotation_from_vector(angle * axis) for axis in symmetry.axes for angle in angles]
    turns = [turn @ each for each in symmetry.rotations for turn in (about or [np.eye(3)])]
    boxes = (Box(est.center, est.rotation @ turn, est.extents) for turn in turns)
    return max(box_iou(est=box, gt=gt) for box in boxes)


def _measure_box(target: PhotoTarget, est: Alignment, gt: Alignment, box: Box) -> Row:
    found, gt_box = target.found, target.gt_box
    values: Row = {}
    if found.truth.metres is not None:
        gap = float(np.linalg.norm(est.translation - gt.translation))
        values[TRANSLATION.key] = 100 * found.truth.metres * gap
    if gt_box is not None and min(box.volume, gt_box.volume) > 0:
        iou = symmetric_box_iou(est=box, gt=gt_box, symmetry=found.symmetry)
        values[metrics.BOX_IOU.key] = iou
        values[metrics.BOX_IOU_UP_TO_SCALE.key] = overlap_up_to_scale(est=box, gt=gt_box)
    return values


BOX = MetricSet(_measure_box, (TRANSLATION, metrics.BOX_IOU, metrics.BOX_IOU_UP_TO_SCALE))

# Scan2CAD -----------------------------------------------------------------------------------------

_MAX_TRANSLATION, _MAX_ROTATION_DEG, _MAX_SCALE = 0.2, 20.0, 0.2  # [m], [degrees], fraction
_TRANSLATION_M = Metric("scan2cad_translation_m", "translation error", "m", 3, symbol="t m")
_SCALE = Metric("scan2cad_scale", "mean scale error", "%", 1, factor=100.0, symbol="s %")
_ALIGNED = metrics.rate("scan2cad_aligned", "Scan2CAD accuracy", "acc %")
_ALIGNED_AXES = metrics.rate("scan2cad_aligned_axes", "Scan2CAD accuracy, each axis", "acc xyz %")


def scan2cad_errors(
    *,
    est: Alignment,
    gt: Alignment,
    symmetry: Symmetry | None = None,
    center: FloatArray | None = None,
) -> Row:
    """Errors of an estimate of a true alignment, in metres, by column.

    Positions of the point ``center`` (3,) of the model are compared, by default of its origin.
    Rotations about an axis of symmetry are compared exactly; the benchmark's script takes steps of
    10 degrees there, so that its errors are larger by up to 5 degrees. The scale's error is the
    benchmark's: the mean over the axes of the ratio to the truth, less 1. Errors of opposite sign
    cancel in it; aligned on each axis is what none of them is over the threshold of.
    """
    point = np.zeros(3) if center is None else center
    gap = est.apply([point])[0] - gt.apply([point])[0]
    turn = model_rotation_error(est=est, gt=gt, symmetry=symmetry or Symmetry.none())
    distance = float(np.linalg.norm(gap))
    scale = float(np.abs(np.mean(est.scale / gt.scale) - 1))
    is_aligned = distance <= _MAX_TRANSLATION and turn <= _MAX_ROTATION_DEG and scale <= _MAX_SCALE
    on_each_axis = is_aligned and bool((scale_error(est=est, gt=gt) <= _MAX_SCALE).all())
    return {
        ROTATION.key: turn,
        _TRANSLATION_M.key: distance,
        _SCALE.key: scale,
        _ALIGNED.key: float(is_aligned),
        _ALIGNED_AXES.key: float(on_each_axis),
    }


def _measure_scan2cad(target: PhotoTarget, est: Alignment, gt: Alignment, box: Box) -> Row:
    # The benchmark's script takes minus the centre of the model's box.
    center = None if target.bounds is None else -target.bounds.mean(axis=0)
    return scan2cad_errors(est=est, gt=gt, symmetry=target.found.symmetry, center=center)


SCAN2CAD = MetricSet(
    _measure_scan2cad,
    (_TRANSLATION_M, _SCALE),
    (Rate(_ALIGNED, _ALIGNED), Rate(_ALIGNED_AXES, _ALIGNED_AXES)),
)
