"""Posterior of pose and shape at a minimum."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import fast_sums, kernel
from cadalign.solvers.linalg import cholesky, multiply_3, solve_cholesky
from cadalign.solvers.marginal.equations import (
    POSE,
    POSE_UNKNOWNS,
    Posed,
    PosedEquations,
    evaluate_posed,
    force_of,
    posed_room,
)
from cadalign.solvers.marginal.problem import (
    GaussianTarget,
    Mixture,
    Seen,
    shape_at,
    target_of,
    whiten,
)
from cadalign.solvers.search import Minima


class Posterior(NamedTuple):
    """Points (m, 3) of an estimate and covariances.

    ``covariance`` (9, 9) is that of the pose and the log lengths of the box, whose corners are the
    last two points; ``of_points`` (m, 3, 3) are those of the points in the model's frame, and
    ``of_seen`` (m, 3, 3) in the camera's, where they include the pose.
    """

    points: FloatArray
    covariance: FloatArray
    of_points: FloatArray
    of_seen: FloatArray


class Likely(NamedTuple):
    """Posteriors of L estimates at ``poses`` (L, 12), and the ``lengths`` (L, 3) of their boxes."""

    poses: FloatArray
    points: FloatArray
    lengths: FloatArray
    covariances: FloatArray
    of_points: FloatArray
    of_seen: FloatArray


@kernel
def posterior_of(
    mixture: Mixture, component: int, seen: Seen, state: FloatArray, inflation: float
) -> Posterior:
    """The posterior under a prior whose deviations are widened by a factor.

    Infinite where the pose is not determined.
    """
    points = shape_at(mixture, component, seen, force_of(state))
    m = points.shape[0]
    target = target_of(mixture, component, seen)
    square = inflation * inflation
    wide = Posed(GaussianTarget(target.mean, square * target.covariance), seen, False)
    room = posed_room(wide)
    cost = evaluate_posed(wide, state, room)
    factor = room.normal.hessian
    if not cost < np.inf or not cholesky(factor, POSE_UNKNOWNS, 0.0):
        unknown = np.full((m, 3, 3), np.inf)
        return Posterior(points, np.full((9, 9), np.inf), unknown, unknown.copy())
    pose = np.eye(POSE_UNKNOWNS)
    for k in range(POSE_UNKNOWNS):
        solve_cholesky(factor, POSE_UNKNOWNS, pose[k])
    whole = mixture.covariances[component]
    told = _whitened_by_points(whole, seen, room, square)
    by_pose = _points_by_pose(told, room.rows)
    rotation = state[:9].copy().reshape((3, 3))
    turned_back = rotation.T.copy()
    of_points, of_seen = np.empty((m, 3, 3)), np.empty((m, 3, 3))
    for i in range(m):
        rows = by_pose[3 * i : 3 * i + 3]
        rest = _block(whole, told, square, i, i)
        of_points[i] = rest
        _add_pose(rows, pose, of_points[i])
        of_seen[i] = multiply_3(multiply_3(rotation, rest), turned_back)
        _add_pose(_moved(state, points[i], rows), pose, of_seen[i])
    low, high = m - 2, m - 1
    covariance = np.zeros((9, 9))
    covariance[:6, :6] = pose
    inverse = np.zeros(3)
    for a in range(3):
        extent = points[high, a] - points[low, a]
        inverse[a] = 1.0 / extent if extent > 0 else 0.0
    lengths = by_pose[3 * high : 3 * high + 3] - by_pose[3 * low : 3 * low + 3]
    block = (
        _block(whole, told, square, high, high)
        + _block(whole, told, square, low, low)
        - _block(whole, told, square, high, low)
        - _block(whole, told, square, low, high)
    )
    _add_pose(lengths, pose, block)
    by_lengths = np.zeros((3, POSE_UNKNOWNS))
    for a in range(3):
        for k in range(POSE_UNKNOWNS):
            for p in range(POSE_UNKNOWNS):
                by_lengths[a, k] += lengths[a, p] * pose[p, k]
    for a in range(3):
        for k in range(6):
            covariance[6 + a, k] = covariance[k, 6 + a] = inverse[a] * by_lengths[a, k]
        for b in range(3):
            covariance[6 + a, 6 + b] = inverse[a] * inverse[b] * block[a, b]
    return Posterior(points, covariance, of_points, of_seen)


@kernel
def _moved(pose: FloatArray, point: FloatArray, rows: FloatArray) -> FloatArray:
    """Derivatives (3, 6) by the pose of a point in the camera, from those in the model's frame."""
    moved, turned = np.zeros((3, POSE_UNKNOWNS)), np.zeros(3)
    for a in range(3):
        moved[a, 3 + a] = 1.0
        for b in range(3):
            turned[a] += pose[3 * a + b] * point[b]
            for k in range(POSE_UNKNOWNS):
                moved[a, k] += pose[3 * a + b] * rows[b, k]
    x, y, z = turned[0], turned[1], turned[2]
    moved[0, 1] += z
    moved[0, 2] -= y
    moved[1, 0] -= z
    moved[1, 2] += x
    moved[2, 0] += y
    moved[2, 1] -= x
    return moved


@kernel
def _add_pose(rows: FloatArray, pose: FloatArray, covariance: FloatArray) -> None:
    """Add the part of the pose to the covariance (3, 3) of a point with derivatives (3, 6)."""
    for k in range(POSE_UNKNOWNS):
        for m in range(POSE_UNKNOWNS):
            for a in range(3):
                for b in range(3):
                    covariance[a, b] += rows[a, k] * pose[k, m] * rows[b, m]


@kernel
def posteriors_of(
    mixture: Mixture, seen: Seen, minima: Minima, count: int, inflation: float
) -> Likely:
    """The posteriors of the first minima. The box holds the keypoints that are seen."""
    m = mixture.means.shape[1]
    likely = Likely(
        minima.states[:count, :POSE].copy(),
        np.empty((count, m, 3)),
        np.empty((count, 3)),
        np.empty((count, 9, 9)),
        np.empty((count, m, 3, 3)),
        np.empty((count, m, 3, 3)),
    )
    for k in range(count):
        found = posterior_of(mixture, minima.label[k], seen, minima.states[k], inflation)
        likely.points[k] = found.points
        for a in range(3):
            for i in seen.points:
                likely.points[k, m - 2, a] = min(likely.points[k, m - 2, a], found.points[i, a])
                likely.points[k, m - 1, a] = max(likely.points[k, m - 1, a], found.points[i, a])
            likely.lengths[k, a] = likely.points[k, m - 1, a] - likely.points[k, m - 2, a]
        likely.covariances[k] = found.covariance
        likely.of_points[k], likely.of_seen[k] = found.of_points, found.of_seen
    return likely


@fast_sums
def _whitened_by_points(
    whole: FloatArray, seen: Seen, equations: PosedEquations, square: float
) -> FloatArray:
    """Whitened covariance (3 m, 2 n) of all points with the keypoints' residuals."""
    by_shape, count = equations.by_shape, whole.shape[0]
    size = by_shape.shape[0]
    told = np.empty((count, size))
    for p in range(count):
        for c in range(size):
            first = 3 * seen.points[c // 2]
            told[p, c] = square * (
                by_shape[c, 0] * whole[p, first]
                + by_shape[c, 1] * whole[p, first + 1]
                + by_shape[c, 2] * whole[p, first + 2]
            )
    whiten(equations.factor, told)
    return told


@fast_sums
def _points_by_pose(told: FloatArray, rows: FloatArray) -> FloatArray:
    """Derivatives (3 m, 6) of the likeliest points by the pose."""
    found = np.empty((told.shape[0], POSE_UNKNOWNS))
    for p in range(told.shape[0]):
        for k in range(POSE_UNKNOWNS):
            total = 0.0
            for c in range(told.shape[1]):
                total -= told[p, c] * rows[k, c]
            found[p, k] = total
    return found


@fast_sums
def _block(whole: FloatArray, told: FloatArray, square: float, i: int, j: int) -> FloatArray:
    """Covariance (3, 3) of points i and j, given the pose."""
    found = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            total = square * whole[3 * i + a, 3 * j + b]
            for c in range(told.shape[1]):
                total -= told[3 * i + a, c] * told[3 * j + b, c]
            found[a, b] = total
    return found
