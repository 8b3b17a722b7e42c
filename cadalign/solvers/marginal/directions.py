"""Modes of the posterior of the view direction, where minima of the cost are no estimates.

The view direction is where the camera lies from the object, the third row of the rotation; the
turn within the image and the translation are the other four unknowns of a pose. With these and the
shape integrated out by Laplace's approximation, -2 log of the posterior density over the sphere of
directions is, up to a constant,

    F = cost + log det M + log det H,

where cost is the least one for the direction, M = I + A S A' as in
`cadalign.solvers.marginal.equations`, and H (4, 4) the information about the four unknowns. Minima
of the cost neglect how the determinants depend on the direction, which matters as soon as the
direction has deviations of tenths of a radian, and there a Gaussian about a minimum does not tell
its probability either. A knife's keypoints lie near one line and tell next to nothing about the
turn about it: cost and volume then favour directions at which no width is seen.
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.solvers.linalg import cholesky, solve_cholesky
from cadalign.solvers.marginal.equations import (
    POSE_UNKNOWNS,
    Equations,
    empty_equations,
    evaluate,
    follow,
)
from cadalign.solvers.marginal.problem import Guess, Mixture, Seen, Target, guess_at, target_of
from cadalign.solvers.marginal.search import ViewMinima
from cadalign.solvers.marginal.starts import is_among

_DIRECTION = 2  # unknowns that move the direction: turns about the camera's x and y
_REST = POSE_UNKNOWNS - _DIRECTION
_LARGEST_DEVIATION = 0.2  # of a direction whose minimum is an estimate [rad]
_UNLIKELY = 12.0  # excess score at which a minimum is given up
_FIRST_STEP, _LAST_STEP = np.radians(8.0), np.radians(1.0)
_MOST_TRIALS = 150
_ITERATIONS = 8
_FIRST_DAMPING, _LARGEST_DAMPING = 1e-4, 1e8
_DECREASE = 1e-2
_GAIN = 1e-3
_SAME_CHORD = 0.1


@kernel
def find_directions(
    mixture: Mixture, seen: Seen, minima: ViewMinima, count: int
) -> tuple[ViewMinima, int]:
    """Modes of the posterior of the view direction, from minima of the cost.

    Returns the modes, the best score F first, and their number; the minima as they are where every
    likely one tells its direction.
    """
    likely = 0
    while likely < count and minima.scores[likely] < minima.scores[0] + _UNLIKELY:
        likely += 1
    is_any_uncertain = False
    for k in range(likely):
        is_any_uncertain = is_any_uncertain or _is_uncertain(mixture, seen, minima, k)
    if not is_any_uncertain:
        return minima, count
    moved = _like(minima)
    for k in range(likely):
        guess, cost, score = _mode_at(mixture, seen, minima, k)
        moved.component[k] = minima.component[k]
        moved.poses[k], moved.offsets[k], moved.forces[k] = guess.pose, guess.offset, guess.force
        moved.costs[k], moved.scores[k] = cost, score + mixture.penalties[minima.component[k]]
    found = _like(minima)
    size = 0
    for k in np.argsort(moved.scores[:likely]):
        if not moved.scores[k] < np.inf or _is_found(moved, k, found, size):
            continue
        found.component[size] = moved.component[k]
        found.poses[size], found.offsets[size] = moved.poses[k], moved.offsets[k]
        found.forces[size] = moved.forces[k]
        found.costs[size], found.scores[size] = moved.costs[k], moved.scores[k]
        size += 1
    if size == 0:
        return minima, count
    return found, size


@kernel
def _like(minima: ViewMinima) -> ViewMinima:
    """Room for as many minima."""
    return ViewMinima(
        np.zeros_like(minima.component),
        np.empty_like(minima.poses),
        np.empty_like(minima.offsets),
        np.empty_like(minima.forces),
        np.full_like(minima.costs, np.inf),
        np.full_like(minima.scores, np.inf),
    )


@kernel
def _is_found(moved: ViewMinima, k: int, found: ViewMinima, size: int) -> bool:
    """True if a mode coincides with one that its component has already."""
    for j in range(size):
        if found.component[j] == moved.component[k] and is_among(
            moved.poses[k], found.poses[j : j + 1], _SAME_CHORD
        ):
            return True
    return False


@kernel
def _is_uncertain(mixture: Mixture, seen: Seen, minima: ViewMinima, k: int) -> bool:
    """True if the direction of a minimum, of a shape that may vary, has too large a deviation."""
    target = target_of(mixture, minima.component[k], seen)
    equations = empty_equations(seen.points.shape[0])
    cost = evaluate(target, seen, _guess_of(minima, k), equations)
    if not cost < np.inf or not equations.sums[1] > 0.0:
        return False
    factor = equations.hessian.copy()
    if not cholesky(factor, POSE_UNKNOWNS, 0.0):
        return True
    for a in range(_DIRECTION):
        column = np.zeros(POSE_UNKNOWNS)
        column[a] = 1.0
        solve_cholesky(factor, POSE_UNKNOWNS, column)
        if column[a] > _LARGEST_DEVIATION**2:
            return True
    return False


@kernel
def _guess_of(minima: ViewMinima, k: int) -> Guess:
    return Guess(minima.poses[k].copy(), minima.offsets[k].copy(), minima.forces[k].copy())


@kernel
def _mode_at(
    mixture: Mixture, seen: Seen, minima: ViewMinima, k: int
) -> tuple[Guess, float, float]:
    """The mode that a pattern search from a minimum leads to, its cost, and F without penalty."""
    target = target_of(mixture, minima.component[k], seen)
    best = _guess_of(minima, k)
    cost, score = _at_direction(target, seen, best)
    size = _FIRST_STEP
    trials = 0
    while size > _LAST_STEP and trials < _MOST_TRIALS:
        is_better = False
        for about_x, about_y in ((size, 0.0), (-size, 0.0), (0.0, size), (0.0, -size)):
            guess = _turned(target, best, about_x, about_y)
            trial_cost, trial_score = _at_direction(target, seen, guess)
            trials += 1
            if trial_score < score - _GAIN:
                best.pose[:], best.offset[:] = guess.pose, guess.offset
                best.force[:] = guess.force
                cost, score, is_better = trial_cost, trial_score, True
        if not is_better:
            size *= 0.5
    return best, cost, score


@kernel
def _turned(target: Target, guess: Guess, about_x: float, about_y: float) -> Guess:
    """A guess turned about the centre of its keypoints, about the camera's x or y."""
    angle = about_x + about_y
    c, s = np.cos(angle), np.sin(angle)
    first, second = (1, 2) if about_y == 0.0 else (2, 0)
    pose = guess.pose.copy()
    for b in range(3):
        p, q = guess.pose[3 * first + b], guess.pose[3 * second + b]
        pose[3 * first + b] = c * p - s * q
        pose[3 * second + b] = s * p + c * q
    n = target.mean.shape[0]
    for b in range(3):
        center = 0.0
        for i in range(n):
            center += (target.mean[i, b] + guess.offset[i, b]) / n
        for a in range(3):
            pose[9 + a] += (guess.pose[3 * a + b] - pose[3 * a + b]) * center
    return Guess(pose, guess.offset.copy(), guess.force.copy())


@kernel
def _at_direction(target: Target, seen: Seen, guess: Guess) -> tuple[float, float]:
    """Improve a guess with its direction kept, by Levenberg-Marquardt; returns its cost and F."""
    n = seen.points.shape[0]
    current, proposed = empty_equations(n), empty_equations(n)
    trial = guess_at(guess.pose, n)
    step, factor = np.zeros(8), np.empty((_REST, _REST))
    cost = evaluate(target, seen, guess, current)
    damping = _FIRST_DAMPING
    for _ in range(_ITERATIONS):
        if not (cost < np.inf and damping < _LARGEST_DAMPING):
            break
        factor[:] = current.hessian[_DIRECTION:, _DIRECTION:]
        rest = -current.gradient[_DIRECTION:]
        for k in range(_REST):
            factor[k, k] *= 1.0 + damping
        if not cholesky(factor, _REST, 0.0):
            damping = max(10.0 * damping, _DECREASE)
            continue
        solve_cholesky(factor, _REST, rest)
        step[_DIRECTION:POSE_UNKNOWNS] = rest
        follow(target, current, step, 1.0 / (1.0 + damping), guess, trial)
        _move(guess.pose, rest, trial.pose)
        trial_cost = evaluate(target, seen, trial, proposed)
        if not trial_cost <= cost * (1.0 + 1e-12):
            damping = max(10.0 * damping, _DECREASE)
            continue
        is_small = cost - trial_cost < _DECREASE and damping < 0.1
        cost = trial_cost
        guess.pose[:], guess.offset[:], guess.force[:] = trial.pose, trial.offset, trial.force
        current, proposed = proposed, current
        damping = max(0.1 * damping, 1e-9)
        if is_small:
            break
    return cost, _score(cost, current)


@kernel
def _move(pose: FloatArray, rest: FloatArray, moved: FloatArray) -> None:
    """Write a pose after a turn within the image and a shift (4,)."""
    c, s = np.cos(rest[0]), np.sin(rest[0])
    for k in range(3):
        moved[k] = c * pose[k] - s * pose[3 + k]
        moved[3 + k] = s * pose[k] + c * pose[3 + k]
        moved[6 + k] = pose[6 + k]
        moved[9 + k] = pose[9 + k] + rest[1 + k]


@kernel
def _score(cost: float, equations: Equations) -> float:
    """F, infinite where the four unknowns are not determined."""
    factor = equations.hessian[_DIRECTION:, _DIRECTION:].copy()
    if not cost < np.inf or not cholesky(factor, _REST, 0.0):
        return np.inf
    score: float = cost + equations.sums[1]
    for k in range(_REST):
        score += 2.0 * np.log(factor[k, k])
    return score
