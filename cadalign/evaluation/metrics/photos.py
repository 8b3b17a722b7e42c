"""Metrics on photos: viewpoints (PASCAL3D+), boxes (NOCS), and alignments (Scan2CAD).

A new metric is a column of a measure, listed in `MEDIANS` or `RATES`. The measures of each data set
are chosen in `cadalign.evaluation.experiments.photos`.

Tulsiani, Malik, "Viewpoints and Keypoints", CVPR 2015, section 4.1: accuracy at pi/6, median error.
Wang et al., "Normalized Object Coordinate Space for Category-Level 6D Object Pose and Size
Estimation" (NOCS), CVPR 2019, section 5: IoU of boxes over an object's symmetries.
Avetisyan et al., "Scan2CAD: Learning CAD Model Alignment in RGB-D Scans", CVPR 2019, section 8, and
the benchmark's script: 20 cm, 20 degrees and 20 % of scale.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.evaluation import metrics
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.metrics.errors import overlap
from cadalign.evaluation.runs.work import Row
from cadalign.evaluation.summary import Group, drop_nan
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.geometry.symmetry import Symmetry
from cadalign.metrics import box_iou, rotation_error, scale_error

if TYPE_CHECKING:
    from cadalign.evaluation.instances.sighting import PhotoTarget

Measure = Callable[["PhotoTarget", Alignment, Alignment, Box], Row]
"""Function of an object, the estimated and the true alignment of the data set's model, and the
estimated box, in the camera frame. Returns errors by column; some may be missing."""


@dataclass(frozen=True)
class Rate:
    """A share of the objects with a value in a column."""

    metric: Metric
    column: Metric
    limit: float | None = None
    """Values below the limit count; without a limit, values above 0."""

    def share(self, group: Group) -> float:
        """The share in a group; failures count as misses."""
        values = drop_nan(group.solved[self.column.key])
        count = len(values) + len(group.rows["method"]) - len(group.solved["method"])
        within = values > 0 if self.limit is None else values < self.limit
        return int(within.sum()) / count if count else np.nan


@dataclass(frozen=True)
class Protocol:
    """Protocol of a data set: metrics, upward axis, and keypoint noise."""

    measures: tuple[Measure, ...]
    up_axis: str = "y"  # the upward axis of its models
    sigma_of_width: float | None = None
    """Standard deviation of the keypoints relative to the image width; by default it is 1/64 of the
    longer side of the object's bounding rectangle."""

    def score(self, target: PhotoTarget, est: Alignment, box: Box) -> Row:
        """Errors of an estimate by column; empty if the truth is unknown."""
        gt = target.gt
        rows = [] if gt is None else [each(target, est, gt, box) for each in self.measures]
        return {name: value for row in rows for name, value in row.items()}


def model_rotation_error(*, est: Alignment, gt: Alignment, symmetry: Symmetry) -> float:
    """Rotation error [degrees] up to the symmetry of the unstretched model."""
    return rotation_error(est=est, gt=replace(gt, scale=np.ones(3)), symmetry=symmetry)


# PASCAL3D+ ----------------------------------------------------------------------------------------

_ACCURACY_DEG = 30.0  # pi/6
ROTATION = replace(metrics.ROTATION, digits=2)
_ACCURACY = metrics.rate("accuracy_pi_6", "accuracy at pi/6", "acc pi/6 %")


def measure_viewpoint(target: PhotoTarget, est: Alignment, gt: Alignment, box: Box) -> Row:
    """Rotation error up to the object's symmetry."""
    error = model_rotation_error(est=est, gt=gt, symmetry=target.found.symmetry)
    return {ROTATION.key: error}


# Boxes --------------------------------------------------------------------------------------------

_STEPS = 20  # about an axis of symmetry, as in NOCS


def symmetric_box_iou(*, est: Box, gt: Box, symmetry: Symmetry) -> float:
    """Largest IoU of the true box and the estimated one over the object's symmetries.

    As in NOCS, the estimate is rotated about its own centre by the rotations of the symmetry, in 20
    steps about each axis of symmetry. The axes of the boxes are the model's. Raises InputError if a
    box has no volume.
    """
    angles = 2 * np.pi * np.arange(_STEPS) / _STEPS
    about = [rotation_from_vector(angle * axis) for axis in symmetry.axes for angle in angles]
    turns = [turn @ each for each in symmetry.rotations for turn in (about or [np.eye(3)])]
    boxes = (Box(est.center, est.rotation @ turn, est.extents) for turn in turns)
    return max(box_iou(est=box, gt=gt) for box in boxes)


def measure_box(target: PhotoTarget, est: Alignment, gt: Alignment, box: Box) -> Row:
    """Intersection over union of the boxes."""
    gt_box = target.gt_box
    if gt_box is None or min(box.volume, gt_box.volume) <= 0:
        return {}
    return {
        metrics.BOX_IOU.key: symmetric_box_iou(est=box, gt=gt_box, symmetry=target.found.symmetry),
        metrics.BOX_IOU_UP_TO_SCALE.key: overlap(est=box, gt=gt_box, up_to_scale=True),
    }


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
    """Errors of an alignment by column; alignments are in metres.

    The translation error is the distance between the estimated and the true position of the model's
    point ``center`` (3,), by default its origin. Rotations about an axis of symmetry are free; the
    benchmark's script tries them in steps of 10 degrees, so its errors are larger by up to 5
    degrees. The scale error is the benchmark's: abs(mean(estimate / truth over the axes) - 1).
    Errors of opposite sign cancel in it; ``scan2cad_aligned_axes`` requires each axis within the
    threshold.
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


def measure_scan2cad(target: PhotoTarget, est: Alignment, gt: Alignment, box: Box) -> Row:
    """Errors of `scan2cad_errors` at the centre that the benchmark's script uses."""
    # The script uses minus the centre of the model's box.
    center = None if target.bounds is None else -target.bounds.mean(axis=0)
    return scan2cad_errors(est=est, gt=gt, symmetry=target.found.symmetry, center=center)


MEDIANS = (*(ROTATION, metrics.BOX_IOU, metrics.BOX_IOU_UP_TO_SCALE, _TRANSLATION_M, _SCALE),)
"""Columns reported as medians."""
RATES = (
    Rate(_ACCURACY, ROTATION, _ACCURACY_DEG),
    Rate(_ALIGNED, _ALIGNED),
    Rate(_ALIGNED_AXES, _ALIGNED_AXES),
)
"""Reported shares of objects."""
