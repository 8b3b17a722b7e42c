"""Errors of estimates by column of the result table, of one or many at once, and of trajectories.

Sturm, Engelhard, Endres, Burgard, Cremers, "A benchmark for the evaluation of RGB-D SLAM systems",
2012: the absolute error compares poses frame by frame, the relative one the motion between frames
that are some frames apart. Poses are those of the object in one frame; none is aligned before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import InputError
from cadalign.evaluation.runs.work import Row
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.metrics import (
    Alignments,
    Boxes,
    box_iou,
    box_iou_up_to_scale,
    box_ious,
    have_volume,
    rotation_error,
    rotation_errors,
    scale_error,
    scale_errors,
    translation_error,
    translation_errors,
    translation_errors_up_to_scale,
)
from cadalign.geometry.rotations import angles_between, vector_from_rotation
from cadalign.geometry.symmetry_group import SymmetryGroup

if TYPE_CHECKING:
    from cadalign.evaluation.instances.instance import Instance

_FLIPPED_DEG = 90.0


def alignment_errors(*, est: Alignment, gt: Alignment, length: float = 1.0) -> dict[str, float]:
    """Errors of pose and stretch by column, the translation's over a length [model units]."""
    _, scale_y, scale_z = scale_error(est=est, gt=gt).tolist()
    return {
        "rotation_error_deg": rotation_error(est=est, gt=gt),
        "translation_error": translation_error(est=est, gt=gt) / length,
        "scale_y_error": scale_y,
        "scale_z_error": scale_z,
    }


def overlap(*, est: Box, gt: Box) -> float | None:
    """Intersection over union of two boxes; None where one has no volume."""
    try:
        return box_iou(est=est, gt=gt)
    except InputError:
        return None


def overlap_up_to_scale(*, est: Box, gt: Box) -> float | None:
    """Like `overlap`, after the estimate was scaled about the camera centre."""
    try:
        return box_iou_up_to_scale(est=est, gt=gt)
    except InputError:
        return None


@np.errstate(all="ignore")
def estimate_errors(
    estimates: Sequence[Alignment],
    instances: Sequence[Instance],
    symmetries: Sequence[SymmetryGroup],
) -> list[Row | InputError]:
    """Errors of an estimate of each instance; the reason where one is not finite.

    The instances are of one camera; ``symmetries`` are those of their models.
    """
    if not estimates:
        return []
    est, gt = Alignments.of(estimates), Alignments.of([each.gt for each in instances])
    bounds = np.array([each.bounds for each in instances])
    diagonals = np.array([each.diagonal for each in instances])
    plain = _pose_errors(est, gt, bounds, diagonals)
    up_to_scale = translation_errors_up_to_scale(est=est, gt=gt) / diagonals
    scales = scale_errors(est=est, gt=gt)
    columns = {
        **plain,
        "scale_y_error": scales[:, 1],
        "scale_z_error": scales[:, 2],
        "translation_error_up_to_scale": up_to_scale,
        "rms_px": _rms_px(estimates, instances),
        **{f"sym_{name}": values.copy() for name, values in plain.items()},
    }
    turned = [k for k, symmetry in enumerate(symmetries) if not symmetry.is_trivial]
    if turned:
        nearest = [
            symmetries[k].nearest_turned(instances[k].gt, estimates[k].rotation) for k in turned
        ]
        some = Alignments(*(array[turned] for array in est))
        aware = _pose_errors(some, Alignments.of(nearest), bounds[turned], diagonals[turned])
        for name, values in aware.items():
            columns[f"sym_{name}"][turned] = values
    cells = {name: values.tolist() for name, values in columns.items()}
    for name in ("box_iou", "sym_box_iou"):
        cells[name] = [None if np.isnan(value) else value for value in cells[name]]
    rows: list[Row | InputError] = [
        dict(zip(cells, row, strict=True)) for row in zip(*cells.values(), strict=True)
    ]
    packed = np.concatenate([each.reshape(len(rows), -1) for each in est], axis=1)
    for k in np.flatnonzero(~np.isfinite(packed).all(axis=1)).tolist():
        rows[k] = InputError("the estimate has NaN or infinite values", where="estimate")
    return rows


def _pose_errors(
    est: Alignments, gt: Alignments, bounds: FloatArray, diagonals: FloatArray
) -> dict[str, FloatArray]:
    """The columns `POSE_ERRORS`; the box IoU of a model without volume is NaN."""
    boxes, gt_boxes = Boxes.from_models(bounds, est), Boxes.from_models(bounds, gt)
    solid = have_volume(boxes) & have_volume(gt_boxes)
    ious = np.full(len(bounds), np.nan)
    ious[solid] = box_ious(
        est=Boxes(*(array[solid] for array in boxes)),
        gt=Boxes(*(array[solid] for array in gt_boxes)),
    )
    return {
        "rotation_error_deg": rotation_errors(est=est, gt=gt),
        "translation_error": translation_errors(est=est, gt=gt) / diagonals,
        "box_iou": ious,
    }


def _rms_px(estimates: Sequence[Alignment], instances: Sequence[Instance]) -> FloatArray:
    """Root mean square residuals (n,) [px]; also of the bound's estimates behind the camera."""
    pairs = zip(estimates, instances, strict=True)
    placed = [each.points_3d @ est.linear.T + est.translation for est, each in pairs]
    camera = instances[0].camera
    projected = camera.pixels_of_rays(np.concatenate(placed))
    observed = np.concatenate([each.points_2d for each in instances])
    squares = ((projected - observed) ** 2).sum(axis=1)
    ends = np.cumsum([len(each.points_2d) for each in instances]).tolist()
    means = [squares[start:end].mean() for start, end in pairwise([0, *ends])]
    return np.sqrt(means)


# Trajectories -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PoseErrors:
    """Root mean squares of rotation [degrees] and translation [model units]."""

    rotation_deg: float
    translation: float

    @classmethod
    def of(cls, est: FloatArray, gt: FloatArray) -> PoseErrors:
        """The errors of poses (P, 12), rotations by rows and translations."""
        angles = angles_between(_rotations(est), _rotations(gt))
        gaps = np.linalg.norm(est[:, 9:] - gt[:, 9:], axis=1)
        return cls(*(float(np.sqrt((each**2).mean())) for each in (angles, gaps)))


def absolute_pose_error(*, est: FloatArray, gt: FloatArray) -> PoseErrors:
    """Root mean square error of the poses (P, 12) of all frames.

    Raises InputError if there are other frames than true ones, or none.
    """
    _check(est, gt, least=1)
    return PoseErrors.of(est, gt)


def relative_pose_error(*, est: FloatArray, gt: FloatArray, step: int = 1) -> PoseErrors:
    """Root mean square error of the motions between frames that are ``step`` frames apart.

    A motion is that of the body in its own axes, ``inv(T_k) T_k+step``. Those of frames without a
    pose, which are NaN, do not count. Raises InputError if there are other frames than true ones,
    or no such motion.
    """
    _check(est, gt, least=step + 1)
    motions, true = _motions(est, step), _motions(gt, step)
    has = _finite(motions, what="no two frames that far apart have a pose")
    return PoseErrors.of(motions[has], true[has])


def rotation_jitter_deg(poses: FloatArray) -> float:
    """Standard deviation of the second difference of the rotation [degrees], per axis.

    Zero for a turn at constant speed. Frames without a pose are NaN. Raises InputError if no three
    successive frames have one.
    """
    _check(poses, poses, least=3)
    motions = _motions(poses, 1)
    lost = np.full(3, np.nan)
    turns = [
        vector_from_rotation(each) if np.isfinite(each).all() else lost
        for each in _rotations(motions)
    ]
    changes = np.diff(turns, axis=0)
    changes = changes[_finite(changes, what="no three successive frames have a pose")]
    return float(np.degrees(np.sqrt((changes**2).mean())))


def count_flips(*, est: FloatArray, gt: FloatArray) -> int:
    """Number of frames whose rotation is more than 90 degrees off."""
    _check(est, gt, least=1)
    return int((angles_between(_rotations(est), _rotations(gt)) > _FLIPPED_DEG).sum())


def _rotations(poses: FloatArray) -> FloatArray:
    return poses[:, :9].reshape(-1, 3, 3)


def _motions(poses: FloatArray, step: int) -> FloatArray:
    """Motions (P - step, 12) of the body in its own axes."""
    first, second = poses[:-step], poses[step:]
    back = _rotations(first).swapaxes(1, 2)
    turns = (back @ _rotations(second)).reshape(-1, 9)
    moves = np.einsum("nij,nj->ni", back, second[:, 9:] - first[:, 9:])
    return np.concatenate([turns, moves], axis=1)


def _finite(rows: FloatArray, *, what: str) -> BoolArray:
    """Mask of the finite rows; raises InputError, which says ``what``, where there is none."""
    has = np.isfinite(rows).all(axis=1)
    if not has.any():
        raise InputError(what, where="est")
    return np.asarray(has)


def _check(est: FloatArray, gt: FloatArray, *, least: int) -> None:
    if len(est) != len(gt):
        raise InputError(f"{len(est)} poses for {len(gt)} true ones", where="est")
    if len(est) < least:
        raise InputError(f"{len(est)} poses, but {least} are needed", where="est")
