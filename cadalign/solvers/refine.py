"""Non-linear refinement by Levenberg-Marquardt."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.solvers.constants import UNKNOWNS
from cadalign.solvers.evidence import BLOCK
from cadalign.solvers.linalg import cholesky, copy_into, solve_cholesky
from cadalign.solvers.objective import Objective, evaluate
from cadalign.solvers.unknowns import move_pose

_RELATIVE_DECREASE = 1e-12
_ABSOLUTE_DECREASE = 1e-16
_FIRST_DAMPING = 1e-4
_LARGEST_DAMPING = 1e12
_LEAST_INFORMATION = 1e-15  # about an unknown, over that about the best known one


@kernel
def least_information(hessian: FloatArray) -> float:
    """Addition to the diagonal that holds unknowns without evidence where they are."""
    least = 1e-300
    for k in range(UNKNOWNS):
        least = max(least, _LEAST_INFORMATION * hessian[k, k])
    return least


@kernel
def refine(objective: Objective, max_iterations: int, pose: FloatArray) -> tuple[float, int, bool]:
    """Improve ``pose`` (15,) in place; returns the cost, the iterations, and if they converged.

    The cost is infinite if a point lies behind the camera at the start.
    """
    hessian = np.empty((UNKNOWNS, UNKNOWNS))
    gradient = np.empty(UNKNOWNS)
    next_hessian = np.empty((UNKNOWNS, UNKNOWNS))
    next_gradient = np.empty(UNKNOWNS)
    factor = np.empty((UNKNOWNS, UNKNOWNS))
    step = np.zeros(UNKNOWNS)
    rows = np.empty((UNKNOWNS + 1, 2 * BLOCK))
    trial = pose.copy()
    cost = np.inf
    damping = _FIRST_DAMPING
    growth = 4.0
    expected = 0.0  # decrease of the cost by the step, on the quadratic model
    done = False
    iterations = 0
    while True:
        trial_cost = evaluate(objective, trial, rows, next_hessian, next_gradient)
        accepted = trial_cost <= cost or (done and trial_cost <= cost * (1 + 1e-9))
        if accepted and trial_cost < np.inf:
            copy_into(pose, trial)
            hessian, next_hessian = next_hessian, hessian
            gradient, next_gradient = next_gradient, gradient
            if cost < np.inf:
                iterations += 1
                gain = (cost - trial_cost) / expected if expected > 0 else 1.0
                damping = max(damping * (0.1 if gain > 0.5 else 0.5 if gain > 0.1 else 2.0), 1e-12)
            growth = 4.0
            cost = trial_cost
        else:
            damping *= growth
            growth *= 2.0
        if not cost < np.inf or done or iterations >= max_iterations:
            return cost, iterations, done
        floor = least_information(hessian)
        solved = False
        while not solved:
            if damping > _LARGEST_DAMPING:
                return cost, iterations, False
            for k in range(UNKNOWNS):
                step[k] = -gradient[k]
                for m in range(k + 1):
                    factor[k, m] = hessian[k, m]
                factor[k, k] += damping * hessian[k, k] + floor
            solved = cholesky(factor, UNKNOWNS, 0.0)
            if not solved:
                damping *= growth
                growth *= 2.0
        solve_cholesky(factor, UNKNOWNS, step)
        expected = 0.0
        for k in range(UNKNOWNS):
            expected -= gradient[k] * step[k]
        # A small step counts as the end only where it is not the damping that made it small.
        done = damping < 1e-2 and expected <= _ABSOLUTE_DECREASE + _RELATIVE_DECREASE * cost
        move_pose(pose, step, trial)
