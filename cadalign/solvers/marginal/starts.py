"""Starts of a search: poses that one view's keypoints suggest for the mean of a Gaussian shape."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.solvers.alignment import Objective, evaluate_cost
from cadalign.solvers.constants import POSE_SIZE, UNKNOWNS
from cadalign.solvers.covariance import center_and_unit
from cadalign.solvers.evidence import Keypoints, ScalePrior
from cadalign.solvers.linalg import eigenvectors_4, factorize, solve_factor
from cadalign.solvers.marginal.problem import Seen, Target
from cadalign.solvers.refine import refine
from cadalign.solvers.starts import rotation_starts
from cadalign.solvers.unknowns import orthonormalize, uncenter

_ROTATIONS = 96
_REFINED = 16
_ITERATIONS = 4
_SAME_CHORD = 0.3
_LEAST_DEPTH = 1e-9
_UNLIKELY = 60.0  # squared distance from the mean, in deviations, of a shape that is still a start
_FLATNESS = 0.01  # displacement that no image shows, relative to the extent


@kernel
def mean_starts(target: Target, seen: Seen) -> FloatArray:
    """Poses (S, 12) of the mean, the likeliest first.

    Of poses at evenly spread rotations the best are improved by a few steps. The shape's
    uncertainty, seen from the distance at which the mean has the size of its image, widens the
    keypoints' own.
    """
    center, unit = center_and_unit(target.mean)
    if not unit > 0:
        return np.empty((0, 12))
    points = (target.mean - center) / unit
    free = np.ones(UNKNOWNS)
    free[6:] = 0.0
    whitening = _widened(target, seen)
    keypoints = Keypoints(points, seen.rays, whitening, seen.loss, seen.loss_scale)
    objective = Objective(free, keypoints, ScalePrior(0.0))
    grid = np.empty((_ROTATIONS, POSE_SIZE))
    count = rotation_starts(points, seen.rays, grid)
    costs = np.empty(count)
    for k in range(count):
        costs[k] = evaluate_cost(objective, grid[k])
    order = np.argsort(costs)[: min(count, _REFINED)]
    refined = np.full(len(order), np.inf)
    for r in range(len(order)):
        if costs[order[r]] < np.inf:
            refined[r], _, _ = refine(objective, _ITERATIONS, grid[order[r]])
    poses = np.empty((len(order), 12))
    found = 0
    for r in np.argsort(refined):
        if refined[r] < np.inf and not is_among(grid[order[r]], poses[:found], _SAME_CHORD):
            pose = grid[order[r]]
            orthonormalize(pose)
            uncenter(pose, center, unit)
            poses[found] = pose[:12]
            found += 1
    return poses[:found].copy()


@kernel
def is_among(pose: FloatArray, poses: FloatArray, chord: float) -> bool:
    """True if the rotation of a pose is close to that of one of some poses (k, 12)."""
    for k in range(poses.shape[0]):
        square = 0.0
        for i in range(9):
            square += (poses[k, i] - pose[i]) ** 2
        if square < chord * chord:
            return True
    return False


@kernel
def _widened(target: Target, seen: Seen) -> FloatArray:
    """Whitening (n, 3) of the keypoints about the mean's projection."""
    n = seen.points.shape[0]
    whitening = np.empty((n, 3))
    extent, size = _square_spread(target.mean), _square_spread(seen.rays)
    depth = max(np.sqrt(extent * 2.0 / 3.0 / max(size, 1e-30)), _LEAST_DEPTH)
    for i in range(n):
        variance = 0.0
        for a in range(3):
            variance += target.covariance[3 * i + a, 3 * i + a] / 3.0
        # The variances add up for a whitening (a, b, c) whose b is small beside a and c.
        information = (seen.whitening[i, 0] ** 2 + seen.whitening[i, 2] ** 2) / 2.0
        whitening[i] = seen.whitening[i] / np.sqrt(1.0 + variance / depth**2 * information)
    return whitening


@kernel
def _square_spread(rows: FloatArray) -> float:
    """Sum of the variances of the columns of a matrix."""
    total = 0.0
    for a in range(rows.shape[1]):
        mean = 0.0
        for n in range(rows.shape[0]):
            mean += rows[n, a] / rows.shape[0]
        for n in range(rows.shape[0]):
            total += (rows[n, a] - mean) ** 2 / rows.shape[0]
    return total


@kernel
def half_turns(target: Target) -> FloatArray:
    """Motions (T, 12) of the model by half a turn that leave the keypoints a likely shape.

    The mean does not show such an ambiguity: a blade whose width varies more than it measures looks
    much the same from behind, with its edge and its back exchanged.
    """
    n = target.mean.shape[0]
    center = np.zeros(3)
    for i in range(n):
        center += target.mean[i] / n
    offsets = target.mean - center
    scatter, axes = np.zeros((4, 4)), np.empty((4, 4))
    extent = 0.0
    for i in range(n):
        square = 0.0
        for a in range(3):
            square += offsets[i, a] ** 2
            for b in range(3):
                scatter[a, b] += offsets[i, a] * offsets[i, b]
        extent = max(extent, square)
    eigenvectors_4(scatter, axes)
    factor = target.covariance.copy()
    for k in range(3 * n):
        factor[k, k] += _FLATNESS**2 * extent
    if not factorize(factor):
        return np.empty((0, 12))
    motions = np.empty((3, 12))
    found = 0
    for column in range(3):
        axis = axes[:3, column].copy()
        moved, solved = np.empty(3 * n), np.empty(3 * n)
        for i in range(n):
            along = 2.0 * (
                axis[0] * offsets[i, 0] + axis[1] * offsets[i, 1] + axis[2] * offsets[i, 2]
            )
            for a in range(3):
                moved[3 * i + a] = along * axis[a] - 2.0 * offsets[i, a]
        solved[:] = moved
        solve_factor(factor, solved)
        square = 0.0
        distance = 0.0
        for k in range(3 * n):
            square += moved[k] * moved[k]
            distance += moved[k] * solved[k]
        if not (square > 0.0 and distance < _UNLIKELY):
            continue
        for a in range(3):
            motions[found, 9 + a] = center[a]
            for b in range(3):
                turn = 2.0 * axis[a] * axis[b] - (1.0 if a == b else 0.0)
                motions[found, 3 * a + b] = turn
                motions[found, 9 + a] -= turn * center[b]
        found += 1
    return motions[:found].copy()


@kernel
def after_motion(pose: FloatArray, motion: FloatArray) -> FloatArray:
    """The pose (12,) of a model that was moved first."""
    moved = np.empty(12)
    for a in range(3):
        moved[9 + a] = pose[9 + a]
        for b in range(3):
            moved[9 + a] += pose[3 * a + b] * motion[9 + b]
            moved[3 * a + b] = (
                pose[3 * a] * motion[b]
                + pose[3 * a + 1] * motion[3 + b]
                + pose[3 * a + 2] * motion[6 + b]
            )
    return moved
