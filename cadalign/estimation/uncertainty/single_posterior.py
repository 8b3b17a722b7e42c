"""Posterior of pose and shape from one view's keypoints and a learned shape, at a minimum.

About it the whitened residuals are linear, ``r + J dp + A dx``, with steps dp of the pose and dx of
the shape, whose covariance S is the prior's. Without the shape they have the covariance
``M = I + A S A'``, so that the pose has the information ``J' M^-1 J``, and given the pose the shape
is ``-S A' M^-1 J dp`` with the covariance ``S - S A' M^-1 A S``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.estimates import widen_box
from cadalign.estimation.uncertainty.residuals import loss_slopes
from cadalign.estimation.uncertainty.shape_posterior import whitened_errors
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import by_rotation
from cadalign.solvers.marginal.problem import Mixture, Seen, coordinates_of, shape_at

_POSE = 6


class SinglePosterior(NamedTuple):
    """Pose, points (m, 3) and the box's ``lengths`` (3,) of an estimate, and covariances.

    ``covariance`` (9, 9) is that of the pose and the log lengths of the box, whose corners are the
    last two points; ``of_points`` (m, 3, 3) are those of the points in the model's frame, and
    ``of_seen`` (m, 3, 3) in the camera's, where they include the pose.
    """

    pose: Alignment
    points: FloatArray
    lengths: FloatArray
    covariance: FloatArray
    of_points: FloatArray
    of_seen: FloatArray


def single_posterior(
    mixture: Mixture, component: int, seen: Seen, state: FloatArray, inflation: float
) -> SinglePosterior:
    """The posterior at a state, under a prior whose deviations are widened by a factor.

    The box holds the keypoints that are seen. Covariances are infinite where the pose is not
    determined.
    """
    rotation = state[:9].reshape(3, 3)
    pose = Alignment(rotation, state[9:12], np.ones(3), is_valid=True)
    points = shape_at(mixture, component, seen, state)
    widened = points.copy()
    widen_box(widened, seen.points)
    lengths, count, m = widened[-1] - widened[-2], len(seen.points), len(points)
    errors, by_pose = whitened_errors(points[seen.points], pose, seen.rays, seen.whitening)
    weights, _ = loss_slopes((errors**2).sum(axis=1), seen.loss, seen.loss_scale)
    by_pose *= np.sqrt(weights)[:, None, None]
    by_shape = np.zeros((count, 2, count, 3))
    by_shape[np.arange(count), :, np.arange(count)] = by_pose[:, :, 3:] @ rotation
    rows, jacobian = by_shape.reshape(2 * count, -1), by_pose.reshape(2 * count, -1)
    prior = inflation**2 * mixture.covariances[component]
    columns = coordinates_of(seen)
    told = prior[:, columns] @ rows.T  # covariance of the points with the residuals
    blocks = prior.reshape(m, 3, m, 3)
    # Behind the points, the difference of the box's corners.
    told = np.concatenate([told, told[-3:] - told[-6:-3]])
    corners = blocks[-2:, :, -2:]
    difference = corners[1, :, 1] + corners[0, :, 0] - corners[1, :, 0] - corners[0, :, 1]
    own = np.concatenate([blocks[np.arange(m), :, np.arange(m)], difference[None]])
    both = np.concatenate([told.T, jacobian], axis=1)
    solved = np.linalg.solve(rows @ told[columns] + np.eye(2 * count), both).T
    solved, weight = solved[:-_POSE], solved[-_POSE:]
    by_steps = -solved @ jacobian
    try:
        inverse = np.linalg.inv(np.linalg.cholesky(weight @ jacobian))
    except np.linalg.LinAlgError:
        unknown = np.full((m, 3, 3), np.inf)
        return SinglePosterior(pose, widened, lengths, np.full((9, 9), np.inf), unknown, unknown)
    of_pose, by_steps = inverse.T @ inverse, by_steps.reshape(m + 1, 3, _POSE)
    given = own - solved.reshape(m + 1, 3, -1) @ told.reshape(m + 1, 3, -1).swapaxes(1, 2)
    whole = given + by_steps @ of_pose @ by_steps.swapaxes(1, 2)
    in_camera = rotation @ by_steps[:m]
    in_camera[:, :, :3] += by_rotation(points @ rotation.T)
    in_camera[:, :, 3:] += np.eye(3)
    of_seen = rotation @ given[:m] @ rotation.T
    of_seen += in_camera @ of_pose @ in_camera.swapaxes(1, 2)
    extent = points[-1] - points[-2]
    relative = np.where(extent > 0, 1.0 / np.where(extent > 0, extent, 1.0), 0.0)
    logs = np.vstack([np.eye(_POSE), relative[:, None] * by_steps[m]])
    covariance = logs @ of_pose @ logs.T
    covariance[_POSE:, _POSE:] += np.outer(relative, relative) * given[m]
    return SinglePosterior(pose, widened, lengths, covariance, whole[:m], of_seen)
