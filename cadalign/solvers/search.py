"""Levenberg-Marquardt refinement and search for minima, generic over systems of unknowns.

A system is a NamedTuple of the evidence and priors of one object. Its state is a row of numbers
(D,) in a layout of its own; a step is a vector of its unknowns (U,). The families of kernels below
have one member for each system, in the module of that system:

=============================  ====================================================================
`alignment.Objective`          pose and stretch from the keypoints of one view
`marginal.equations.Marginal`  a pose, the shape integrated out
`joint.system.Joint`           poses, scales, focal lengths and shape from all evidence
=============================  ====================================================================

A cost is -2 log (likelihood times prior), up to a constant, and infinite behind a camera. Equations
hold half the gradient of the cost, J' W r, and its Gauss-Newton matrix, J' W J.

`refine` is the Levenberg-Marquardt loop. `search` probes starts, refines the promising ones and
keeps distinct minima.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import borrow, kernel, kernel_family
from cadalign.solvers.linalg import copy_into

allocate = kernel_family("allocate")
"""``(system)``: allocate two sets of equations, for the current state and for a trial.

Their ``gradient`` has one entry for each unknown.
"""
evaluate = kernel_family("evaluate")
"""``(system, state, equations)``: write the normal equations at a state; returns the cost."""
cost_at = kernel_family("cost_at")
"""``(system, state)``: the cost at a state, without derivatives."""
solve = kernel_family("solve")
"""``(system, equations, damping, step)``: write the damped Gauss-Newton step.

Returns the decrease of the cost that the equations predict for it, NaN where they have no solution.
"""
move = kernel_family("move")
"""``(system, state, equations, damping, step, moved)``: write the state after a step.

Unknowns that the equations eliminate are set to their optimum.
"""
score_of = kernel_family("score_of")
"""``(system, state, cost)``: -2 log evidence by Laplace's approximation, up to a constant.

Infinite if the unknowns are not determined. A system that ranks by cost returns ``cost``.
"""
are_same = kernel_family("are_same")
"""``(system, first, second)``: True if two states belong to the same minimum."""

_RELATIVE_DECREASE = 1e-12
_ABSOLUTE_DECREASE = 1e-16
_FIRST_DAMPING = 1e-4
_LARGEST_DAMPING = 1e12
_LEAST_DAMPING = 1e-12


@kernel
def refine(system: Any, max_iterations: int, state: FloatArray) -> tuple[float, int, bool]:
    """Improve ``state`` in place; returns cost, number of iterations, and True if converged."""
    current, new = allocate(system)
    step = np.zeros(current.gradient.shape[0])
    return _levenberg_marquardt(system, max_iterations, state, state.copy(), step, current, new)


@borrow
def _levenberg_marquardt(
    system: Any,
    max_iterations: int,
    state: FloatArray,
    trial: FloatArray,
    step: FloatArray,
    current: Any,
    new: Any,
) -> tuple[float, int, bool]:
    """Improve ``state``; ``trial`` is a copy of it, the other arrays are scratch space."""
    cost = np.inf
    damping = _FIRST_DAMPING
    growth = 4.0
    expected = 0.0  # decrease of the cost that the quadratic model predicts
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
        # A small step means convergence only if damping did not cause it.
        done = damping < 1e-2 and expected <= _ABSOLUTE_DECREASE + _RELATIVE_DECREASE * cost
        move(system, state, current, damping, step, trial)


class Effort(NamedTuple):
    """Limits of a search: number of starts, iterations of the probe, iterations afterwards.

    A probed start whose cost exceeds the best by ``unlikely`` is dropped.
    """

    starts: int
    probe: int
    iterations: int
    unlikely: float


class Minima(NamedTuple):
    """Distinct minima, the best score first: ``states`` (M, D), ``costs`` (M,), ``scores`` (M,).

    ``label`` (M,) tells which system each belongs to. ``counts`` (2,) are the numbers of minima
    and of iterations.
    """

    states: FloatArray
    costs: FloatArray
    scores: FloatArray
    label: IntArray
    counts: IntArray


@kernel
def empty_minima(most: int, size: int) -> Minima:
    return Minima(
        np.zeros((most, size)),
        np.full(most, np.inf),
        np.full(most, np.inf),
        np.zeros(most, dtype=np.int64),
        np.zeros(2, dtype=np.int64),
    )


@kernel
def search(
    system: Any, starts: FloatArray, effort: Effort, label: int, penalty: float, minima: Minima
) -> None:
    """Add the minima reached from ``starts`` (S, D); ``penalty`` is added to their scores."""
    count = starts.shape[0]
    scores = np.empty(count)
    for s in range(count):  # a single start needs no rank
        scores[s] = cost_at(system, starts[s]) if count > 1 else 0.0
    most = min(effort.starts, count)
    probed, converged = np.full(most, np.inf), np.zeros(most, dtype=np.bool_)
    states = np.empty((most, starts.shape[1]))
    tried = 0
    least = minima.scores[0] - penalty if minima.counts[0] > 0 else np.inf
    for _ in range(most):
        best = 0
        for s in range(1, count):
            if scores[s] < scores[best]:
                best = s
        if not scores[best] < np.inf:
            break
        scores[best] = np.inf
        copy_into(states[tried], starts[best])
        probed[tried], used, converged[tried] = refine(system, effort.probe, states[tried])
        least = min(least, probed[tried])
        minima.counts[1] += used
        tried += 1
    for _ in range(tried):
        best = 0
        for s in range(1, tried):
            if probed[s] < probed[best]:
                best = s
        cost = probed[best]
        if not cost < least + effort.unlikely:
            break
        probed[best] = np.inf
        state = states[best]
        if _find(system, state, cost, label, minima) >= 0:
            continue
        if not converged[best] and effort.iterations > 0:
            cost, used, _ = refine(system, effort.iterations, state)
            minima.counts[1] += used
        least = min(least, cost)
        add_minimum(system, state, cost, label, penalty, minima)


@kernel
def refine_integrated(
    plain: Any,
    whole: Any,
    likely: Minima,
    max_iterations: int,
    unlikely: float,
    label: int,
    penalty: float,
    minima: Minima,
) -> None:
    """Refine ``likely`` states of a ``plain`` objective on the ``whole`` one; add the minima.

    The whole objective has the shape integrated out. The most promising state is refined first; a
    state whose score exceeds the best by ``unlikely`` is dropped. ``likely`` states should not be
    converged on the plain objective: some of its minima lie so near the camera that refinement
    ends in another minimum. ``costs`` of the result are plain ones.
    """
    count = likely.counts[0]
    scores = np.full(count, np.inf)
    for k in range(count):
        if likely.label[k] == label:
            scores[k] = score_of(whole, likely.states[k], likely.costs[k]) + penalty
    for _ in range(count):
        best = 0
        for k in range(1, count):
            if scores[k] < scores[best]:
                best = k
        if not scores[best] < minima.scores[0] + unlikely:
            break
        scores[best] = np.inf
        state = likely.states[best]
        if _find(whole, state, np.inf, label, minima) >= 0:
            continue
        cost, used, _ = refine(whole, max_iterations, state)
        minima.counts[1] += used
        add_minimum(whole, state, cost, label, penalty, minima)
    for k in range(minima.counts[0]):
        if minima.label[k] == label:
            minima.costs[k] = cost_at(plain, minima.states[k])


@kernel
def add_minimum(
    system: Any, state: FloatArray, cost: float, label: int, penalty: float, minima: Minima
) -> None:
    """Insert a state by its score, unless its minimum is known already."""
    if not cost < np.inf or _find(system, state, cost, label, minima) >= 0:
        return
    score = score_of(system, state, cost) + penalty
    found = minima.counts[0]
    if found == minima.scores.shape[0]:
        if score >= minima.scores[found - 1]:
            return
        found -= 1
    row = found
    while row > 0 and minima.scores[row - 1] > score:
        copy_into(minima.states[row], minima.states[row - 1])
        minima.costs[row] = minima.costs[row - 1]
        minima.scores[row] = minima.scores[row - 1]
        minima.label[row] = minima.label[row - 1]
        row -= 1
    copy_into(minima.states[row], state)
    minima.costs[row], minima.scores[row], minima.label[row] = cost, score, label
    minima.counts[0] = found + 1


@kernel
def _find(system: Any, state: FloatArray, cost: float, label: int, minima: Minima) -> int:
    """Row of the minimum that a state belongs to, or -1; the row keeps the better state."""
    for k in range(minima.counts[0]):
        if minima.label[k] == label and are_same(system, state, minima.states[k]):
            if cost < minima.costs[k]:
                minima.scores[k] += cost - minima.costs[k]
                minima.costs[k] = cost
                copy_into(minima.states[k], state)
            return k
    return -1
