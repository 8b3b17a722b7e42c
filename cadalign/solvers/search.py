"""The one search for minima: probe starts, refine the promising ones, tell minima apart."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import kernel
from cadalign.solvers.linalg import copy_into
from cadalign.solvers.refine import refine
from cadalign.solvers.system import (
    are_same,
    cost_at,
    integrating,
    is_estimate,
    score_of,
)


class Effort(NamedTuple):
    """Effort of a search.

    At most ``starts`` of those of the lowest cost are refined by ``probe`` iterations, then by up
    to ``iterations`` until none that is left lies within ``unlikely`` of the best cost.
    """

    starts: int
    probe: int
    iterations: int
    unlikely: float


class Minima(NamedTuple):
    """Distinct minima, the best score first, and how many there are.

    ``states`` (M, D), ``costs`` (M,), ``scores`` (M,), see `cadalign.solvers.system.score_of`, and
    the ``label`` (M,) of the system that each is of. ``counts`` (2,) are the number of minima, and
    of iterations that were spent.
    """

    states: FloatArray
    costs: FloatArray
    scores: FloatArray
    label: IntArray
    counts: IntArray


@kernel
def room_for_minima(most: int, size: int) -> Minima:
    """Room for so many minima of states of a size."""
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
    """Add the minima that ``starts`` (S, D) lead to.

    Minima of other labels may be there already; ``penalty`` adds to the scores of these.
    """
    count = starts.shape[0]
    scores = np.empty(count)
    for s in range(count):  # a single one has no rank
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
        if not is_estimate(system, state) or _find(system, state, cost, label, minima) >= 0:
            continue
        if not converged[best] and effort.iterations > 0:
            cost, used, _ = refine(system, effort.iterations, state)
            minima.counts[1] += used
        least = min(least, cost)
        add_minimum(system, state, cost, label, penalty, minima)


@kernel
def descend(
    system: Any,
    likely: Minima,
    max_iterations: int,
    unlikely: float,
    label: int,
    penalty: float,
    minima: Minima,
) -> None:
    """Add the minima with the shape integrated out that states of a low cost lead to.

    The most promising of the ``likely`` states of this label is refined first, none whose score
    exceeds the best one by ``unlikely``. Minima of the cost are no starts: some lie so near the
    camera that the descent ends in another minimum. The ``costs`` are without what is integrated.
    """
    whole = integrating(system, True)
    count = likely.counts[0]
    scores = np.full(count, np.inf)
    for k in range(count):
        if likely.label[k] == label:
            scores[k] = score_of(whole, likely.states[k], likely.costs[k]) + penalty
    for k in np.argsort(scores):
        if not scores[k] < minima.scores[0] + unlikely:
            break
        state = likely.states[k]
        if _find(whole, state, np.inf, label, minima) >= 0:
            continue
        cost, used, _ = refine(whole, max_iterations, state)
        minima.counts[1] += used
        add_minimum(whole, state, cost, label, penalty, minima)
    for k in range(minima.counts[0]):
        if minima.label[k] == label:
            minima.costs[k] = cost_at(integrating(system, False), minima.states[k])


@kernel
def add_minimum(
    system: Any, state: FloatArray, cost: float, label: int, penalty: float, minima: Minima
) -> None:
    """Insert a state by its score, unless it is found already or no estimate."""
    if not cost < np.inf or not is_estimate(system, state):
        return
    if _find(system, state, cost, label, minima) >= 0:
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
    """Row of the minimum that a state coincides with, which takes the better of both; or -1."""
    for k in range(minima.counts[0]):
        if minima.label[k] == label and are_same(system, state, minima.states[k]):
            if cost < minima.costs[k]:
                minima.scores[k] += cost - minima.costs[k]
                minima.costs[k] = cost
                copy_into(minima.states[k], state)
            return k
    return -1
