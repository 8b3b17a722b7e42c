"""Posterior of a learned shape and its pose in one view, linear about the estimate."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.estimates import Estimate, placed_box, widened_boxes
from cadalign.estimation.uncertainty.residuals import loss_slopes, whitening_matrices
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.pixels import perspective
from cadalign.geometry.rotations import by_rotation
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.marginal.problem import Mixture, Seen, coordinates_of, shape_at
from cadalign.solvers.projection import ray_derivatives

_POSE = 6


def linearised(
    points: FloatArray, pose: Alignment, seen: Seen
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weighted errors (2 n,), and their derivatives by points (2 n, 3 n) and pose (2 n, 6)."""
    count, matrices = len(points), whitening_matrices(seen.whitening)
    rays = perspective(points @ pose.linear.T + pose.translation)
    errors = (matrices @ (rays - seen.rays)[:, :, None])[:, :, 0]
    by_pose = matrices @ ray_derivatives(points, pose.packed)[:, :, :_POSE]
    weights, _ = loss_slopes((errors**2).sum(axis=1), seen.loss, seen.loss_scale)
    roots = np.sqrt(weights)[:, None]
    by_pose *= roots[..., None]
    blocks = np.zeros((count, 2, count, 3))  # a translation moves every point alike
    np.einsum("iaib->iab", blocks)[:] = by_pose[..., 3:] @ pose.linear
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
    _, rows, jacobian = linearised(points[seen.points], pose, seen)
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
