"""Errors of estimates by column, the Cramer-Rao bound, and coverage of stated uncertainties."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError, InputError
from cadalign.evaluation.runs.work import Row
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.camera import Camera, projection_jacobian
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.geometry.symmetry import Symmetry
from cadalign.metrics import (
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
from cadalign.shapes.parts import probability_within
from cadalign.solvers.constants import UNKNOWNS

if TYPE_CHECKING:
    from cadalign.evaluation.instances.instance import Instance


_LEAST_INFORMATION = 1e-12
_LARGEST_LOG = 50.0
# Smaller eigenvalues, relative to the largest one, count as no variance.
_NO_VARIANCE = 1e-12
_OF_STRETCHED = [0, 1, 2, 3, 4, 5, 7, 8]  # unknowns of a pose with scales (1, s_y, s_z)


def alignment_errors(*, est: Alignment, gt: Alignment, length: float = 1.0) -> dict[str, float]:
    """Errors of pose and stretch by column; ``length`` [model units] divides the translation's."""
    _, scale_y, scale_z = scale_error(est=est, gt=gt).tolist()
    return {
        "rotation_error_deg": rotation_error(est=est, gt=gt),
        "translation_error": translation_error(est=est, gt=gt) / length,
        "scale_y_error": scale_y,
        "scale_z_error": scale_z,
    }


def overlap(*, est: Box, gt: Box, up_to_scale: bool = False) -> float | None:
    """Intersection over union of two boxes; None if one has no volume.

    ``up_to_scale`` scales the estimate about the camera centre first.
    """
    try:
        return (box_iou_up_to_scale if up_to_scale else box_iou)(est=est, gt=gt)
    except InputError:
        return None


@np.errstate(all="ignore")
def estimate_errors(
    estimates: Sequence[Alignment],
    instances: Sequence[Instance],
    symmetries: Sequence[Symmetry],
) -> list[Row | InputError]:
    """Errors of one estimate per instance, by column; an InputError if it is not finite.

    All instances have the same camera. ``symmetries`` belong to their models.
    """
    if not estimates:
        return []
    est, gt = Alignments.stack(estimates), Alignments.stack([each.gt for each in instances])
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
            symmetries[k].nearest_pose(instances[k].gt, estimates[k].rotation) for k in turned
        ]
        some = Alignments(*(array[turned] for array in est))
        aware = _pose_errors(some, Alignments.stack(nearest), bounds[turned], diagonals[turned])
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
    """Errors that depend on symmetry; the box IoU of a model without volume is NaN."""
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
    """Root mean square residuals (n,) [px], also of estimates behind the camera."""
    pairs = zip(estimates, instances, strict=True)
    placed = [each.points_3d @ est.linear.T + est.translation for est, each in pairs]
    camera = instances[0].camera
    projected = camera.pixels_of_rays(np.concatenate(placed))
    observed = np.concatenate([each.points_2d for each in instances])
    squares = ((projected - observed) ** 2).sum(axis=1)
    ends = np.cumsum([len(each.points_2d) for each in instances]).tolist()
    means = [squares[start:end].mean() for start, end in pairwise([0, *ends])]
    return np.sqrt(means)


# Cramer-Rao bound and coverage --------------------------------------------------------------------


def _scaled_columns(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Scale columns to length 1 and return their lengths; raises DegenerateError if singular."""
    norms = np.linalg.norm(rows, axis=0)
    scaled = rows / np.where(norms > 0, norms, 1.0)
    if len(rows) < rows.shape[1] or np.linalg.eigvalsh(scaled.T @ scaled)[0] < _LEAST_INFORMATION:
        raise DegenerateError("the points do not determine the alignment", where="points_3d")
    return scaled, norms


def limit_estimate(
    points_3d: FloatArray, points_2d: FloatArray, camera: Camera, gt: Alignment
) -> Alignment:
    """Estimate of an ideal estimator from noisy observations (n, 2) [px], to first order.

    The Gauss-Newton step from the truth, (J' J)^-1 J' e with the noise e of the observations. The
    covariance of its errors is the Cramer-Rao bound. It uses the same noise as the compared
    methods. The truth must have the scale 1 along x, and the camera no lens distortion.
    """
    jacobian = projection_jacobian(points_3d, camera, gt)[:, :, _OF_STRETCHED]
    jacobian = jacobian.reshape(-1, UNKNOWNS)
    noise = (points_2d - camera.project(gt.apply(points_3d))).ravel()
    scaled, norms = _scaled_columns(jacobian)
    step = np.linalg.solve(scaled.T @ scaled, scaled.T @ noise) / norms
    # The exponential of a weakly determined scale would overflow.
    factors = np.exp(np.clip(step[6:], -_LARGEST_LOG, _LARGEST_LOG))
    return Alignment(
        rotation_from_vector(step[:3]) @ gt.rotation,
        gt.translation + step[3:6],
        gt.scale * np.append(1.0, factors),
    )


def probability_level(
    error: FloatArray, covariance: FloatArray, degrees_of_freedom: float | None = None
) -> float | None:
    """Probability of the smallest ellipsoid about the estimate that holds the truth.

    ``error`` (k,) is estimate minus truth; ``covariance`` (k, k) is the stated one. Errors follow a
    t distribution with ``degrees_of_freedom``, or a Gaussian if None. Levels are uniform over
    [0, 1] if the stated covariance is right. The level is 1 if the error has a component in a
    direction without variance, and None if there is no variance at all.
    """
    if not np.isfinite(covariance).all():
        return None
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    free = values > _NO_VARIANCE * max(float(values[-1]), 0.0)
    if not free.any():
        return None
    parts = vectors.T @ error
    if (parts[~free] ** 2 > 1e-6 * values[-1]).any():
        return 1.0
    square = float((parts[free] ** 2 / values[free]).sum())
    return float(probability_within(square, int(free.sum()), degrees_of_freedom))
