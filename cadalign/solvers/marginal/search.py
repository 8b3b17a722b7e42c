"""Search for the minima of one view's keypoints under a mixture of Gaussian shapes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import kernel
from cadalign.solvers.marginal.problem import (
    Guess,
    Mixture,
    Seen,
    Target,
    guess_at,
    target_of,
)
from cadalign.solvers.marginal.refine import refine_pose
from cadalign.solvers.marginal.starts import after_motion, half_turns, is_among, mean_starts

_PROBE_ITERATIONS = 3
_MAX_ITERATIONS = 200
_SAME_START = 0.45  # chord of rotations of starts that lead to one minimum
_SAME_CHORD = 1e-3
_UNLIKELY = 40.0  # excess score, after the probe, at which a start is given up
_MOST_STARTS = 64
_MOST = 32


class ViewMinima(NamedTuple):
    """Minima, the best score first.

    Their ``component`` (M,), ``poses`` (M, 12), ``forces`` (M, n, 3) on the keypoints (see `Guess`)
    and their ``offsets`` (M, n, 3). The ``costs`` (M,) are the whitened squared residuals and the
    prior of the shape; the ``scores`` (M,) are -2 log of the probability by Laplace's
    approximation, up to a constant.
    """

    component: IntArray
    poses: FloatArray
    offsets: FloatArray
    forces: FloatArray
    costs: FloatArray
    scores: FloatArray


@kernel
def search_view(
    mixture: Mixture, seen: Seen, given: FloatArray
) -> tuple[ViewMinima, int, int, int]:
    """Search from all starts, ``given`` poses (k, 12) among them.

    Returns the minima, their number, and the numbers of iterations and of starts. The components
    share their starts: what the mean of one suggests may be the best of another.
    """
    components, n = mixture.means.shape[0], seen.points.shape[0]
    targets = [target_of(mixture, g, seen) for g in range(components)]
    starts = np.empty((_MOST_STARTS, 12))
    firsts = np.zeros(components + 1, dtype=np.int64)
    count = min(given.shape[0], _MOST_STARTS)
    starts[:count] = given[:count]
    for g in range(components):
        firsts[g] = count
        count = _add_starts(targets[g], seen, starts, count)
    firsts[components] = count
    component = np.empty(components * count, dtype=np.int64)
    guesses = [guess_at(starts[0], n) for _ in range(0)]
    for g in range(components):
        for s in _chosen(starts[:count], given.shape[0], firsts[g], firsts[g + 1]):
            component[len(guesses)] = g
            guesses.append(guess_at(starts[s], n))
    minima = ViewMinima(
        np.zeros(_MOST, dtype=np.int64),
        np.empty((_MOST, 12)),
        np.empty((_MOST, n, 3)),
        np.empty((_MOST, n, 3)),
        np.full(_MOST, np.inf),
        np.full(_MOST, np.inf),
    )
    found, iterations = _descend(targets, mixture.penalties, seen, guesses, component, minima)
    return minima, found, iterations, count


@kernel
def _add_starts(target: Target, seen: Seen, starts: FloatArray, count: int) -> int:
    """Append the starts of one component, and those half a turn away; returns the new number."""
    own = mean_starts(target, seen)
    motions = half_turns(target)
    for m in range(motions.shape[0] + 1):
        for k in range(own.shape[0]):
            if count == starts.shape[0]:
                return count
            starts[count] = own[k] if m == 0 else after_motion(own[k], motions[m - 1])
            count += 1
    return count


@kernel
def _chosen(starts: FloatArray, given: int, first: int, end: int) -> IntArray:
    """Numbers of a component's starts: given ones, its own, and of the others what these lack."""
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
            kept[found] = starts[s]
            found += 1
    return chosen[:found].copy()


@kernel
def _descend(
    targets: list[Target],
    penalties: FloatArray,
    seen: Seen,
    guesses: list[Guess],
    component: IntArray,
    minima: ViewMinima,
) -> tuple[int, int]:
    """Refine guesses, the most promising first; returns the number of minima and iterations."""
    count = len(guesses)
    probed, converged = np.full(count, np.inf), np.zeros(count, dtype=np.bool_)
    costs = np.full(count, np.inf)
    iterations = 0
    for s in range(count):
        g = component[s]
        costs[s], score, used, converged[s] = refine_pose(
            targets[g], seen, _PROBE_ITERATIONS, guesses[s]
        )
        probed[s] = score + penalties[g]
        iterations += used
    found = 0
    best = np.inf
    for s in np.argsort(probed):
        guess, g = guesses[s], component[s]
        if not probed[s] < min(best, probed.min()) + _UNLIKELY or found == _MOST:
            break
        if _is_found(guess, g, minima, found):
            continue
        cost, score = costs[s], probed[s]
        if not converged[s]:
            cost, score, used, _ = refine_pose(targets[g], seen, _MAX_ITERATIONS, guess)
            score += penalties[g]
            iterations += used
        if not score < np.inf or _is_found(guess, g, minima, found):
            continue
        best = min(best, score)
        _insert(guess, g, cost, score, minima, found)
        found += 1
    return found, iterations


@kernel
def _is_found(guess: Guess, component: int, minima: ViewMinima, found: int) -> bool:
    """True if a guess coincides with a minimum of its component."""
    for k in range(found):
        if minima.component[k] == component and is_among(
            guess.pose, minima.poses[k : k + 1], _SAME_CHORD
        ):
            return True
    return False


@kernel
def _insert(
    guess: Guess, component: int, cost: float, score: float, minima: ViewMinima, found: int
) -> None:
    """Insert a minimum by its score."""
    row = found
    while row > 0 and minima.scores[row - 1] > score:
        minima.component[row] = minima.component[row - 1]
        minima.poses[row] = minima.poses[row - 1]
        minima.offsets[row] = minima.offsets[row - 1]
        minima.forces[row] = minima.forces[row - 1]
        minima.costs[row] = minima.costs[row - 1]
        minima.scores[row] = minima.scores[row - 1]
        row -= 1
    minima.component[row] = component
    minima.poses[row] = guess.pose
    minima.offsets[row] = guess.offset
    minima.forces[row] = guess.force
    minima.costs[row] = cost
    minima.scores[row] = score
