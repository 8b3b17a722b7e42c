"""Search for the minima of a joint estimate from several starts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.solvers.joint.evidence import Evidence, State
from cadalign.solvers.joint.factor import decide_on_undetermined, factorize
from cadalign.solvers.joint.reduction import reduce_modes
from cadalign.solvers.joint.refine import refine_joint
from cadalign.solvers.joint.system import System, empty_system, evaluate_joint

_PROBE_ITERATIONS = 8
_MAX_ITERATIONS = 200
_SAME_CHORD = 1e-3
_UNLIKELY = 40.0  # excess cost, after the probe, at which a start is given up


class Minima(NamedTuple):
    """Minima of a joint estimate, the best score first.

    ``poses`` (M, P, 12), ``log_scales`` (M, 3), ``coefficients`` (M, K), ``displacements``
    (M, m, 3). The ``costs`` (M,) are the whitened squared residuals and priors; the ``scores`` (M,)
    are -2 log of the evidence by Laplace's approximation, up to a constant.
    """

    poses: FloatArray
    log_scales: FloatArray
    coefficients: FloatArray
    displacements: FloatArray
    costs: FloatArray
    scores: FloatArray


@kernel
def search_joint(
    evidence: Evidence, poses: FloatArray, log_scales: FloatArray
) -> tuple[Minima, int, int]:
    """Refine starts ``poses`` (S, P, 12) with ``log_scales`` (S, 3) to distinct minima.

    Returns the minima, their number, and the number of iterations.
    """
    reduced, basis = reduce_modes(evidence)
    minima, found, iterations = _search(reduced, poses, log_scales)
    whole = Minima(
        minima.poses,
        minima.log_scales,
        minima.coefficients @ basis.T,
        minima.displacements,
        minima.costs,
        minima.scores,
    )
    return whole, found, iterations


@kernel
def _search(
    evidence: Evidence, poses: FloatArray, log_scales: FloatArray
) -> tuple[Minima, int, int]:
    starts, points = poses.shape[0], evidence.shape.mean.shape[0]
    modes = evidence.shape.modes.shape[0]
    minima = Minima(
        np.empty((starts, poses.shape[1], 12)),
        np.empty((starts, 3)),
        np.zeros((starts, modes)),
        np.empty((starts, points, 3)),
        np.full(starts, np.inf),
        np.full(starts, np.inf),
    )
    found = 0
    iterations = 0
    system = empty_system(evidence)
    probed, converged = np.full(starts, np.inf), np.zeros(starts, dtype=np.bool_)
    states = [_start(poses[s], log_scales[s], modes, points) for s in range(starts)]
    for s in range(starts):
        probed[s], used, converged[s] = refine_joint(evidence, _PROBE_ITERATIONS, states[s])
        iterations += used
    best = np.inf
    for s in np.argsort(probed):
        if not probed[s] < min(best, probed.min()) + _UNLIKELY:
            break
        state = states[s]
        if _find(state, minima, found) >= 0:
            continue
        cost = probed[s]
        if not converged[s]:
            cost, used, _ = refine_joint(evidence, _MAX_ITERATIONS, state)
            iterations += used
        if not cost < np.inf or _find(state, minima, found) >= 0:
            continue
        best = min(best, cost)
        _insert(state, cost, score_of(evidence, state, system), minima, found)
        found += 1
    return minima, found, iterations


@kernel
def _start(poses: FloatArray, log_scales: FloatArray, modes: int, points: int) -> State:
    return State(poses.copy(), log_scales.copy(), np.zeros(modes), np.zeros((points, 3)))


@kernel
def _find(state: State, minima: Minima, found: int) -> int:
    """Row of the minimum that a state coincides with, or -1."""
    for k in range(found):
        square = 0.0
        for p in range(state.poses.shape[0]):
            for i in range(9):
                square += (minima.poses[k, p, i] - state.poses[p, i]) ** 2
        for a in range(3):
            square += (minima.log_scales[k, a] - state.log_scales[a]) ** 2
        if square < _SAME_CHORD * _SAME_CHORD:
            return k
    return -1


@kernel
def _insert(state: State, cost: float, score: float, minima: Minima, found: int) -> None:
    """Insert a minimum by its score."""
    row = found
    while row > 0 and minima.scores[row - 1] > score:
        minima.poses[row] = minima.poses[row - 1]
        minima.log_scales[row] = minima.log_scales[row - 1]
        minima.coefficients[row] = minima.coefficients[row - 1]
        minima.displacements[row] = minima.displacements[row - 1]
        minima.costs[row] = minima.costs[row - 1]
        minima.scores[row] = minima.scores[row - 1]
        row -= 1
    minima.poses[row] = state.poses
    minima.log_scales[row] = state.log_scales
    minima.coefficients[row] = state.coefficients
    minima.displacements[row] = state.displacements
    minima.costs[row] = cost
    minima.scores[row] = score


@kernel
def score_of(evidence: Evidence, state: State, system: System) -> float:
    """-2 log of the evidence by Laplace's approximation; infinite where it is not determined."""
    cost = evaluate_joint(evidence, state, system)
    if not cost < np.inf:
        return np.inf
    factor = system.hessian.copy()
    decide_on_undetermined(factor, state.poses.shape[0])
    if not factorize(factor):
        return np.inf
    score = cost
    for k in range(factor.shape[0]):
        score += 2.0 * np.log(factor[k, k])
    score += system.log_determinant[0]
    return float(score)
