"""Levenberg-Marquardt over a pose; the shape follows."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.solvers.constants import POSE_SIZE
from cadalign.solvers.linalg import cholesky, solve_cholesky
from cadalign.solvers.marginal.equations import (
    POSE_UNKNOWNS,
    Equations,
    empty_equations,
    evaluate,
    follow,
)
from cadalign.solvers.marginal.problem import Guess, Seen, Target, guess_at
from cadalign.solvers.unknowns import move_pose, orthonormalize

_FIRST_DAMPING = 1e-4
_LARGEST_DAMPING = 1e12
_LEAST_INFORMATION = 1e-15  # about an unknown, over that about the best known one
_RELATIVE_DECREASE = 1e-11
_ABSOLUTE_DECREASE = 1e-13


@kernel
def refine_pose(
    target: Target, seen: Seen, max_iterations: int, guess: Guess
) -> tuple[float, float, int, bool]:
    """Improve a guess in place.

    Returns the cost, infinite if a point lies behind the camera at the start; the score, which is
    -2 log of the evidence by Laplace's approximation, infinite where the pose is not determined;
    the number of iterations, and if they converged.
    """
    n = seen.points.shape[0]
    current, proposed = empty_equations(n), empty_equations(n)
    factor = np.empty((POSE_UNKNOWNS, POSE_UNKNOWNS))
    step, trial = np.zeros(8), guess_at(guess.pose, n)
    from_pose, to_pose = np.ones(POSE_SIZE), np.ones(POSE_SIZE)
    cost = evaluate(target, seen, guess, current)
    damping, growth = _FIRST_DAMPING, 4.0
    iterations = 0
    converged = False
    while cost < np.inf and iterations < max_iterations and damping <= _LARGEST_DAMPING:
        accepted = False
        expected = 0.0
        if _solve(current, damping, factor, step):
            share = 1.0 / (1.0 + damping)
            expected = current.sums[0] - follow(target, current, step, share, guess, trial)
            from_pose[:12] = guess.pose
            move_pose(from_pose, step, to_pose)
            trial.pose[:] = to_pose[:12]
            trial_cost = evaluate(target, seen, trial, proposed)
            accepted = trial_cost <= cost * (1.0 + 1e-12)
        is_small = expected <= _ABSOLUTE_DECREASE + _RELATIVE_DECREASE * cost and damping < 1e-2
        if not accepted:
            if is_small and expected > 0.0:
                converged = True
                break
            damping *= growth
            growth *= 2.0
            continue
        iterations += 1
        gain = (cost - trial_cost) / expected if expected > 0 else 1.0
        damping = max(damping * (0.1 if gain > 0.5 else 0.5 if gain > 0.1 else 2.0), 1e-12)
        growth = 4.0
        cost = trial_cost
        guess.pose[:], guess.offset[:], guess.force[:] = trial.pose, trial.offset, trial.force
        orthonormalize(guess.pose)
        current, proposed = proposed, current
        if is_small:
            converged = True
            break
    return cost, score_of(cost, current), iterations, converged


@kernel
def score_of(cost: float, equations: Equations) -> float:
    """-2 log of the evidence by Laplace's approximation, up to a constant."""
    factor = equations.hessian.copy()
    if not cost < np.inf or not cholesky(factor, POSE_UNKNOWNS, 0.0):
        return np.inf
    score: float = cost + equations.sums[1]
    for k in range(POSE_UNKNOWNS):
        score += 2.0 * np.log(factor[k, k])
    return score


@kernel
def _solve(equations: Equations, damping: float, factor: FloatArray, step: FloatArray) -> bool:
    """Write the damped step of the pose; False where the equations don't determine it."""
    least = 1e-300
    for k in range(POSE_UNKNOWNS):
        least = max(least, _LEAST_INFORMATION * equations.hessian[k, k])
    for k in range(POSE_UNKNOWNS):
        step[k] = -equations.gradient[k]
        for m in range(k + 1):
            factor[k, m] = equations.hessian[k, m]
        factor[k, k] += damping * equations.hessian[k, k] + least
    if not cholesky(factor, POSE_UNKNOWNS, 0.0):
        return False
    solve_cholesky(factor, POSE_UNKNOWNS, step)
    return True
