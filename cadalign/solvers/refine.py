"""Non-linear refinement: the one Levenberg-Marquardt loop, over any system of unknowns."""

from __future__ import annotations

from typing import Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import borrowing, kernel
from cadalign.solvers.linalg import copy_into
from cadalign.solvers.system import evaluate, move, room_of, solve

_RELATIVE_DECREASE = 1e-12
_ABSOLUTE_DECREASE = 1e-16
_FIRST_DAMPING = 1e-4
_LARGEST_DAMPING = 1e12
_LEAST_DAMPING = 1e-12


@kernel
def refine(system: Any, max_iterations: int, state: FloatArray) -> tuple[float, int, bool]:
    """Improve ``state`` in place; returns the cost, the iterations, and if they converged.

    The cost is infinite if a point lies behind a camera at the start.
    """
    current, new = room_of(system)
    step = np.zeros(current.gradient.shape[0])
    return _descend(system, max_iterations, state, state.copy(), step, current, new)


@borrowing
def _descend(
    system: Any,
    max_iterations: int,
    state: FloatArray,
    trial: FloatArray,
    step: FloatArray,
    current: Any,
    new: Any,
) -> tuple[float, int, bool]:
    """Improve ``state``; ``trial`` is a copy of it, the others are room for equations and step."""
    cost = np.inf
    damping = _FIRST_DAMPING
    growth = 4.0
    expected = 0.0  # decrease of the cost by the step, on the quadratic model
    done = False
    iterations = 0
    while True:
        trial_cost = evaluate(system, trial, new)
        accepted = trial_cost <= cost or (done and trial_cost <= cost * (1 + 1e-9))
        if accepted and trial_cost < np.inf:
            copy_into(state, trial)
            current, new = new, current
            if cost < np.inf:
                iterations += 1
                gain = (cost - trial_cost) / expected if expected > 0 else 1.0
                change = 0.1 if gain > 0.5 else 0.5 if gain > 0.1 else 2.0
                damping = max(damping * change, _LEAST_DAMPING)
            growth = 4.0
            cost = trial_cost
        else:
            damping *= growth
            growth *= 2.0
        if not cost < np.inf or done or iterations >= max_iterations:
            return cost, iterations, done
        while True:
            if damping > _LARGEST_DAMPING:
                return cost, iterations, False
            expected = solve(system, current, damping, step)
            if expected == expected:
                break
            damping *= growth
            growth *= 2.0
        # A small step counts as the end only where it is not the damping that made it small.
        done = damping < 1e-2 and expected <= _ABSOLUTE_DECREASE + _RELATIVE_DECREASE * cost
        move(system, state, current, damping, step, trial)
