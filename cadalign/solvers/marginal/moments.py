"""Second moments of a mixture of likely estimates about the best of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.solvers.linalg import cholesky, solve_cholesky


class Likely(NamedTuple):
    """Estimates, the best first, with their ``likelihoods`` (L,) relative to it.

    ``poses`` (L, 12) in the camera, stretched ``points`` (L, m, 3), ``lengths`` (L, 3) of the box
    or (L, 4) with the focal length, ``covariances`` (L, 9, 9) or (L, 10, 10) of pose and their
    logarithms, and those of the points in the model's frame and in the camera's (L, m, 3, 3).
    """

    poses: FloatArray
    points: FloatArray
    lengths: FloatArray
    covariances: FloatArray
    of_points: FloatArray
    of_seen: FloatArray
    likelihoods: FloatArray


class Moments(NamedTuple):
    """Second moments (9, 9) or (10, 10), and (m, 3, 3), about the best estimate.

    ``distances`` (L,) are the squared distances of the rotations from the best one's, in its
    deviations; infinite where these are none.
    """

    covariance: FloatArray
    of_points: FloatArray
    of_seen: FloatArray
    distances: FloatArray


@kernel
def moments_of(likely: Likely) -> Moments:
    """The moments of a mixture of Gaussians, weighted by their likelihoods."""
    count, m = likely.points.shape[0], likely.points.shape[1]
    share = 1.0 / likely.likelihoods.sum()
    found = Moments(
        share * likely.covariances[0],
        share * likely.of_points[0],
        share * likely.of_seen[0],
        np.zeros(count),
    )
    factor = likely.covariances[0, :3, :3].copy()
    is_determined = cholesky(factor, 3, 0.0)
    first = np.empty((m, 3))
    _place(likely.poses[0], likely.points[0], first)
    size = likely.covariances.shape[1]
    placed, step = np.empty((m, 3)), np.empty(size)
    for k in range(1, count):
        weight = share * likely.likelihoods[k]
        _write_step(likely, k, step)
        for p in range(size):
            for q in range(size):
                found.covariance[p, q] += weight * (likely.covariances[k, p, q] + step[p] * step[q])
        _place(likely.poses[k], likely.points[k], placed)
        for i in range(m):
            for a in range(3):
                for b in range(3):
                    moved = (likely.points[k, i, a] - likely.points[0, i, a]) * (
                        likely.points[k, i, b] - likely.points[0, i, b]
                    )
                    found.of_points[i, a, b] += weight * (likely.of_points[k, i, a, b] + moved)
                    moved = (placed[i, a] - first[i, a]) * (placed[i, b] - first[i, b])
                    found.of_seen[i, a, b] += weight * (likely.of_seen[k, i, a, b] + moved)
        solved = step[:3].copy()
        if is_determined:
            solve_cholesky(factor, 3, solved)
            for a in range(3):
                found.distances[k] += step[a] * solved[a]
        else:
            found.distances[k] = np.inf
    return found


@kernel
def _place(pose: FloatArray, points: FloatArray, placed: FloatArray) -> None:
    """Write points (m, 3) at a pose."""
    for i in range(points.shape[0]):
        for a in range(3):
            placed[i, a] = pose[9 + a]
            for b in range(3):
                placed[i, a] += pose[3 * a + b] * points[i, b]


@kernel
def _write_step(likely: Likely, k: int, step: FloatArray) -> None:
    """Write rotation vector, translation and log lengths from the best estimate to another."""
    turn = np.empty((3, 3))
    for a in range(likely.lengths.shape[1]):
        before, after = likely.lengths[0, a], likely.lengths[k, a]
        step[6 + a] = np.log(after / before) if before > 0 and after > 0 else 0.0
    for a in range(3):
        step[3 + a] = likely.poses[k, 9 + a] - likely.poses[0, 9 + a]
        for b in range(3):
            turn[a, b] = 0.0
            for c in range(3):
                turn[a, b] += likely.poses[k, 3 * a + c] * likely.poses[0, 3 * b + c]
    _write_rotation_vector(turn, step)


@kernel
def _write_rotation_vector(rotation: FloatArray, vector: FloatArray) -> None:
    """Write the rotation vector of a rotation (3, 3), by way of its quaternion."""
    quaternion = np.empty(4)  # w, x, y, z
    trace = rotation[0, 0] + rotation[1, 1] + rotation[2, 2]
    largest = 0
    for a in range(3):
        if rotation[a, a] > (trace if largest == 0 else rotation[largest - 1, largest - 1]):
            largest = a + 1
    if largest == 0:
        quaternion[0] = 1.0 + trace
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            quaternion[1 + a] = rotation[c, b] - rotation[b, c]
    else:
        a = largest - 1
        b, c = (a + 1) % 3, (a + 2) % 3
        quaternion[0] = rotation[c, b] - rotation[b, c]
        quaternion[1 + a] = 1.0 + 2.0 * rotation[a, a] - trace
        quaternion[1 + b] = rotation[b, a] + rotation[a, b]
        quaternion[1 + c] = rotation[c, a] + rotation[a, c]
    sign = -1.0 if quaternion[0] < 0 else 1.0
    length = np.sqrt(quaternion[1] ** 2 + quaternion[2] ** 2 + quaternion[3] ** 2)
    norm = np.sqrt(length * length + quaternion[0] ** 2)
    factor = 2.0 / norm
    if length > 1e-9 * norm:
        factor = 2.0 * np.arctan2(length, sign * quaternion[0]) / length
    for a in range(3):
        vector[a] = sign * factor * quaternion[1 + a]
