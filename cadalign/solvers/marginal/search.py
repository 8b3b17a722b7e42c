"""Search for the poses of one view's keypoints under a mixture of Gaussian shapes.

Starts are poses of the mean shapes. A few steps on the plain cost select promising starts, which
are then refined on the objective with the shape integrated out.
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import kernel
from cadalign.solvers.alignment import Objective, center_and_unit
from cadalign.solvers.constants import POSE_SIZE, UNKNOWNS, ScalePrior
from cadalign.solvers.evidence import KeypointEvidence
from cadalign.solvers.linalg import copy_into, eigenvectors_4, factorize, solve_factor
from cadalign.solvers.marginal.equations import POSE, Marginal
from cadalign.solvers.marginal.problem import GaussianTarget, Mixture, Seen, mixture_at, target_of
from cadalign.solvers.search import Effort, Minima, empty_minima, refine_integrated, search
from cadalign.solvers.starts import rotation_starts, widen_by_shape
from cadalign.solvers.unknowns import orthonormalize, uncenter

_PROBE_ITERATIONS = 2
_MAX_ITERATIONS = 120
_SAME_START = 0.45  # distance of rotation matrices below which starts are equal
_UNLIKELY = 40.0  # excess cost, after the probe, at which a start is dropped
_LESS_LIKELY = 20.0  # excess score at which a start is dropped
_MOST_STARTS = 64
_MOST = 32
_ROTATIONS = 96
_REFINED = 16
_ITERATIONS = 4
_SAME_CHORD = 0.3
_UNLIKELY_SHAPE = 60.0  # squared Mahalanobis distance at which a half turn is dropped
_FLATNESS = 0.01  # tolerated displacement, relative to the extent


def search_view(mixture: Mixture, seen: Seen, given: FloatArray) -> tuple[Minima, int]:
    """Minima of F from all starts, including ``given`` poses (k, 12); and the number of starts.

    ``label`` is the component, ``costs`` omit log det M. Components share their starts, since a
    start from one mean may be the best for another component.
    """
    own = mixture_at(mixture, seen)
    variances = own.covariances.diagonal(axis1=1, axis2=2).reshape(own.means.shape).mean(axis=2)
    widened = widen_by_shape(own.means, seen.rays, variances, seen.whitening)
    return _search_mixture(own, seen, widened, given)


@kernel
def _search_mixture(
    mixture: Mixture, seen: Seen, widened: FloatArray, given: FloatArray
) -> tuple[Minima, int]:
    """`search_view` for a mixture at the keypoints; ``widened`` is the whitening (G, n, 3)."""
    components, n = mixture.means.shape[0], mixture.means.shape[1]
    starts = np.empty((_MOST_STARTS, POSE))
    firsts = np.zeros(components + 1, dtype=np.int64)
    count = min(given.shape[0], _MOST_STARTS)
    for k in range(count):
        copy_into(starts[k], given[k])
    for g in range(components):
        firsts[g] = count
        count = _add_starts(target_of(mixture, g), seen, widened[g], starts, count)
    firsts[components] = count
    likely = empty_minima(_MOST, POSE + 6 * n)
    for g in range(components):
        chosen = _select_starts(starts[:count], given.shape[0], firsts[g], firsts[g + 1])
        states = np.zeros((chosen.shape[0], POSE + 6 * n))
        for s in range(chosen.shape[0]):
            copy_into(states[s, :POSE], starts[chosen[s]])
        effort = Effort(chosen.shape[0], _PROBE_ITERATIONS, 0, _UNLIKELY)
        plain = Marginal(target_of(mixture, g), seen, False)
        search(plain, states, effort, g, mixture.penalties[g], likely)
    found = likely.counts[0]
    minima = empty_minima(max(found, 1), POSE + 6 * n)
    minima.counts[1] = likely.counts[1]
    is_left = np.ones(components, dtype=np.bool_)
    for k in range(found):  # the most promising component first
        g = likely.label[k]
        if is_left[g]:
            is_left[g] = False
            target, penalty = target_of(mixture, g), mixture.penalties[g]
            plain, whole = Marginal(target, seen, False), Marginal(target, seen, True)
            refine_integrated(
                plain, whole, likely, _MAX_ITERATIONS, _LESS_LIKELY, g, penalty, minima
            )
    return minima, count


@kernel
def _add_starts(
    target: GaussianTarget, seen: Seen, whitening: FloatArray, starts: FloatArray, count: int
) -> int:
    """Append starts of one component, and their half turns; returns the new number."""
    own = _mean_starts(target, seen, whitening)
    motions = half_turns(target)
    for m in range(motions.shape[0] + 1):
        for k in range(own.shape[0]):
            if count == starts.shape[0]:
                return count
            moved = own[k] if m == 0 else after_motion(own[k], motions[m - 1])
            copy_into(starts[count], moved)
            count += 1
    return count


@kernel
def _select_starts(starts: FloatArray, given: int, first: int, end: int) -> IntArray:
    """Indices of a component's starts: given ones, its own, and distinct ones of the others."""
    count = starts.shape[0]
    chosen = np.empty(count, dtype=np.int64)
    kept = np.empty((count, 12))
    found = 0
    for turn in range(3):
        for s in range(count):
            is_own = first <= s < end
            kind = 0 if s < given else 1 if is_own else 2
            if kind != turn or (turn == 2 and is_among(starts[s], kept[:found], _SAME_START)):
                continue
            chosen[found] = s
            copy_into(kept[found], starts[s])
            found += 1
    return chosen[:found].copy()


@kernel
def _mean_starts(target: GaussianTarget, seen: Seen, whitening: FloatArray) -> FloatArray:
    """Poses (S, 12) of the mean, likeliest first, from a grid of rotations and a few steps."""
    center, unit = center_and_unit(target.mean)
    if not unit > 0:
        return np.empty((0, 12))
    points = (target.mean - center) / unit
    free = np.ones(UNKNOWNS)
    free[6:] = 0.0
    keypoints = KeypointEvidence(points, seen.rays, whitening, seen.loss, seen.loss_scale)
    objective = Objective(free, keypoints, ScalePrior(0.0, 0.0))
    grid = np.empty((_ROTATIONS, POSE_SIZE))
    count = rotation_starts(points, seen.rays, grid)
    minima = empty_minima(_REFINED, POSE_SIZE)
    search(objective, grid[:count], Effort(_REFINED, _ITERATIONS, 0, np.inf), 0, 0.0, minima)
    poses = np.empty((_REFINED, 12))
    found = 0
    for k in range(minima.counts[0]):
        pose = minima.states[k]
        if not is_among(pose, poses[:found], _SAME_CHORD):
            orthonormalize(pose)
            uncenter(pose, center, unit)
            copy_into(poses[found], pose[:POSE])
            found += 1
    return poses[:found].copy()


@kernel
def is_among(pose: FloatArray, poses: FloatArray, chord: float) -> bool:
    """True if the rotation of a pose is close to a rotation of ``poses`` (k, 12)."""
    for k in range(poses.shape[0]):
        square = 0.0
        for i in range(9):
            square += (poses[k, i] - pose[i]) ** 2
        if square < chord * chord:
            return True
    return False


@kernel
def half_turns(target: GaussianTarget) -> FloatArray:
    """Half turns (T, 12) of the model after which the keypoints are still a likely shape.

    The mean shape does not show this ambiguity. Example: a blade whose width varies by more than
    its mean looks similar from behind, with edge and back exchanged.
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
        copy_into(solved, moved)
        solve_factor(factor, solved)
        square = 0.0
        distance = 0.0
        for k in range(3 * n):
            square += moved[k] * moved[k]
            distance += moved[k] * solved[k]
        if not (square > 0.0 and distance < _UNLIKELY_SHAPE):
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
    """Compose a pose (12,) with a motion of the model that comes first."""
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
