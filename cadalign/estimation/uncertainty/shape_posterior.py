"""Learned shapes in one view: the posterior of the whole shape, and how it predicts keypoints.

The reprojection errors are linear in shape and pose about the estimate of `align`. Whitened and
projected to what no change of the pose explains, they read ``A x = b + noise`` of unit covariance,
with the stacked rows x of the shape: each Gaussian of the category is conditioned on that in closed
form, and its weight grows with the probability that it gave to b.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.estimation.estimates import Estimate, placed_box, widened_boxes
from cadalign.estimation.options import FitOptions
from cadalign.estimation.pack import seen_keypoints
from cadalign.estimation.prior import prior_of
from cadalign.estimation.uncertainty.residuals import loss_slopes, whitening_matrices
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import faced, turned_alignment
from cadalign.geometry.pixels import perspective
from cadalign.geometry.rotations import by_rotation
from cadalign.shapes.gaussians import Gaussians
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.marginal.problem import Mixture, Seen, coordinates_of, shape_at
from cadalign.solvers.projection import ray_derivatives

if TYPE_CHECKING:
    from cadalign.estimation.result import Result
    from cadalign.estimation.view import View

_POSE = 6


class ShapePosterior(NamedTuple):
    """Knowledge of an object's shape from one image and a shape model.

    ``shapes`` is a mixture over stacked rows: x, y, z of each keypoint, then of the box's corners.
    ``log_evidence``, up to a constant, compares shape models that have all keypoints of the image.
    """

    shapes: Gaussians
    log_evidence: float


def shape_posterior(
    result: Result, view: View, *, loss: str = "linear", loss_scale: float = 2.0
) -> ShapePosterior:
    """Posterior of the shape whose alignment with the inliers of one view is ``result``.

    Depths and directions are not used; the ``loss`` weights keypoints by their residuals. Raises
    InputError if the result is not that of a shape model and one view.
    """
    if not isinstance(result.model, ShapeModel) or len(result.poses) != 1:
        what = "expected the alignment of a shape model with one view"
        raise InputError(what, where="result")
    camera, rows_of = faced(view.camera, view.pixels), prior_of(result.model).rows_of
    options = FitOptions(loss=loss, loss_scale=loss_scale)
    names = rows_of(view.keypoint_ids, "view.ids")
    seen = seen_keypoints(replace(view, camera=camera), view.pixels, names, options)
    kept = result.inliers
    seen = Seen(seen.points[kept], seen.rays[kept], seen.whitening[kept], *seen[3:])
    pose = turned_alignment(result.alignment, camera.lens_from_camera.T)
    estimate, columns = np.concatenate([result.points_3d, result.bounds]), coordinates_of(seen)
    errors, rows, by_pose = _linearised(estimate[seen.points], pose, seen)
    full, triangle = np.linalg.qr(by_pose, mode="complete")
    rest = full[:, _POSE:].T
    rows, right = rest @ rows, rest @ (rows @ estimate[seen.points].ravel() - errors)
    logs, means, covariances = [], [], []
    for weight, mean, covariance in zip(*gaussians_of(result.model), strict=True):
        across = rows @ covariance[columns]
        spread = across[:, columns] @ rows.T + np.eye(len(right))
        gap = right - rows @ mean[columns]
        gain = np.linalg.solve(spread, across).T
        square = float(gap @ np.linalg.solve(spread, gap))
        logs.append(np.log(weight) - 0.5 * (square + np.linalg.slogdet(spread)[1]))
        means.append(mean + gain @ gap)
        covariances.append(covariance - gain @ across)
    total = float(np.logaddexp.reduce(logs))
    shapes = Gaussians(np.exp(np.array(logs) - total), np.array(means), np.array(covariances))
    # The estimate's objective has the log determinant of the shape, linear here: a slope by the
    # keypoints, which moves the means. The box of an estimate is widened to hold what is seen.
    keypoints = result.points_3d.size
    gap = (estimate.ravel() - shapes.means[result.component])[:keypoints]
    own = shapes.covariances[result.component][:keypoints, :keypoints]
    slope = np.linalg.pinv(own, hermitian=True) @ gap
    shifts = shapes.covariances[:, :, :keypoints] @ slope
    moved = Gaussians(shapes.weights, shapes.means + shifts, shapes.covariances)
    pose_volume = float(np.log(np.abs(triangle.diagonal())).sum())
    return ShapePosterior(moved, total - pose_volume)


def gaussians_of(model: ShapeModel) -> Gaussians:
    weights, means, covariances = model.gaussians
    return Gaussians(weights, means.reshape(len(means), -1), covariances)


def _linearised(
    points: FloatArray, pose: Alignment, seen: Seen
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weighted errors (2 n,), and their derivatives by points (2 n, 3 n) and pose (2 n, 6)."""
    count, matrices = len(points), whitening_matrices(seen.whitening)
    errors = (matrices @ (perspective(pose.apply(points)) - seen.rays)[:, :, None])[:, :, 0]
    by_pose = matrices @ ray_derivatives(points, pose.packed)[:, :, :_POSE]
    weights, _ = loss_slopes((errors**2).sum(axis=1), seen.loss, seen.loss_scale)
    roots = np.sqrt(weights)[:, None]
    by_pose *= roots[..., None]
    blocks = np.zeros((count, 2, count, 3))  # a translation moves every point alike
    np.einsum("iaib->iab", blocks)[:] = by_pose[..., 3:] @ (pose.rotation * pose.scale)
    rows = blocks.reshape(2 * count, 3 * count)
    return (roots * errors).ravel(), rows, by_pose.reshape(2 * count, _POSE)


def single_posterior(
    mixture: Mixture,
    component: int,
    seen: Seen,
    state: FloatArray,
    inflation: float,
    model: ShapeModel | None = None,
) -> Estimate:
    """The estimate at a state (D,) of a component, with its posterior; infinite without a pose.

    The prior's deviations are widened by the ``inflation``. The box holds the keypoints that are
    seen.
    """
    count, m = len(seen.points), mixture.means.shape[1]
    rotation = state[:9].reshape(3, 3)
    pose = Alignment(rotation, state[9:12], np.ones(3), is_valid=True)
    points = shape_at(mixture, component, seen, state)
    prior, columns = inflation**2 * mixture.covariances[component], coordinates_of(seen)
    if model is not None:
        points[-2:], faces = placed_box(points, len(model.ids), seen.points, model)
        own = np.append(np.arange(3 * m - 6), 3 * faces + np.arange(3))
        prior = prior[np.ix_(own, own)]
    boxed, still = widened_boxes(points, seen.points), np.ones(3)
    _, rows, jacobian = _linearised(points[seen.points], pose, seen)
    # Behind the points, the difference of the box's corners.
    prior = np.concatenate([prior, prior[-3:] - prior[-6:-3]])
    prior = np.concatenate([prior, prior[:, -3:] - prior[:, -6:-3]], axis=1)
    across = prior[:, columns] @ rows.T  # covariance of points with residuals
    inverse = np.linalg.inv(rows @ across[columns] + np.eye(2 * count))
    weight = jacobian.T @ inverse
    try:
        root = np.linalg.inv(np.linalg.cholesky(weight @ jacobian))
    except np.linalg.LinAlgError:
        unknown = np.full((m, 3, 3), np.inf)
        return Estimate(boxed, still, (pose,), (np.full((9, 9), np.inf),), unknown, unknown)
    of_pose, solved = root.T @ root, across @ inverse
    by_steps = (-solved @ jacobian).reshape(m + 1, 3, _POSE)
    left = np.einsum("iaib->iab", prior.reshape(m + 1, 3, m + 1, 3))
    blocks = m + 1, 3, 2 * count
    left = left - solved.reshape(blocks) @ across.reshape(blocks).swapaxes(1, 2)
    whole = left + by_steps @ of_pose @ by_steps.swapaxes(1, 2)
    in_camera = rotation @ by_steps[:m]
    in_camera[..., :3] += by_rotation(points @ rotation.T)
    in_camera[..., 3:] += np.eye(3)
    of_seen = rotation @ left[:m] @ rotation.T + in_camera @ of_pose @ in_camera.swapaxes(1, 2)
    extent = points[-1] - points[-2]
    relative = np.where(extent > 0, 1.0 / np.where(extent > 0, extent, 1.0), 0.0)
    logs = np.concatenate([np.eye(_POSE), relative[:, None] * by_steps[m]])
    covariance = logs @ of_pose @ logs.T
    covariance[_POSE:, _POSE:] += relative[:, None] * relative * left[m]
    return Estimate(boxed, still, (pose,), (covariance,), whole[:m], of_seen)
