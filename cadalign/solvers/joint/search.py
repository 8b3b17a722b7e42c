"""Starts, search and refinement of joint estimates, in the modes that the evidence tells apart."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.compile import fast_sums, kernel
from cadalign.solvers.constants import LEAST_POINTS, LINEAR, UNKNOWNS, ScalePrior
from cadalign.solvers.evidence import KeypointEvidence
from cadalign.solvers.joint.evidence import Evidence, Shape, State, packed, unpacked
from cadalign.solvers.joint.system import Joint, joint_cost, joint_score
from cadalign.solvers.optimal import optimal_batch
from cadalign.solvers.search import Effort, cost_at, descend, refine, room_for_minima, search
from cadalign.solvers.starts import widen_by_shape

_PROBE_ITERATIONS = 8
_MAX_ITERATIONS = 200
_FEW_ITERATIONS = 3  # of a start, before the shape is integrated out
_LESS_LIKELY = 20.0  # excess score of a start that is refined no further
_UNLIKELY = 40.0  # excess cost, after the probe, at which a start is given up
MOST_PER_VIEW = 8
_UNLIKELY_POSE = 60.0  # excess cost of a pose of the mean shape that is still a start


class JointMinima(NamedTuple):
    """Minima of a joint estimate, the best score first: their states, costs and scores (M,)."""

    states: list[State]
    costs: FloatArray
    scores: FloatArray


def search_joint(
    evidence: Evidence, poses: FloatArray, log_focals: FloatArray, log_scales: FloatArray
) -> tuple[JointMinima, int]:
    """Refine starts ``poses`` (S, P, 12), (S, F), (S, 3) to distinct minima.

    Returns them and the number of iterations.
    """
    reduction = reduce_modes(evidence)
    fewer, count = reduction.evidence, len(poses)
    system, starts = Joint(fewer, False), _mean_rows(fewer, poses, log_focals, log_scales)
    minima = room_for_minima(max(count, 1), starts.shape[1])
    if _has_latent(fewer):
        effort = Effort(count, _FEW_ITERATIONS, 0, _UNLIKELY)
        likely = room_for_minima(max(count, 1), starts.shape[1])
        search(system, starts, effort, 0, 0.0, likely)
        minima.counts[1] = likely.counts[1]
        descend(system, likely, _MAX_ITERATIONS, _LESS_LIKELY, 0, 0.0, minima)
    else:
        effort = Effort(count, _PROBE_ITERATIONS, _MAX_ITERATIONS, _excess(system, starts))
        search(system, starts, effort, 0, 0.0, minima)
    found = int(minima.counts[0])
    states = [
        whole_state(reduction, evidence.shape, unpacked(fewer, row))
        for row in minima.states[:found]
    ]
    costs, scores = minima.costs[:found], minima.scores[:found]
    return JointMinima(states, costs, scores), int(minima.counts[1])


def _mean_rows(
    evidence: Evidence, poses: FloatArray, log_focals: FloatArray, log_scales: FloatArray
) -> FloatArray:
    """States (S, D) of the mean shape."""
    count = len(poses)
    unmoved = np.zeros((count, len(evidence.shape.modes) + evidence.shape.mean.size))
    rows = poses.reshape(count, 12 * poses.shape[1])
    return np.concatenate([rows, log_focals, log_scales, unmoved], axis=1)


def costs_at(
    evidence: Evidence, poses: FloatArray, log_focals: FloatArray, log_scales: FloatArray
) -> FloatArray:
    """Costs (S,) of the mean shape at starts as those of `search_joint`."""
    rows = _mean_rows(evidence, poses, log_focals, log_scales)
    return _costs_of(Joint(evidence, False), rows)


@kernel
def _costs_of(system: Joint, rows: FloatArray) -> FloatArray:
    costs = np.empty(rows.shape[0])
    for s in range(rows.shape[0]):
        costs[s] = cost_at(system, rows[s])
    return costs


def _excess(system: Joint, starts: FloatArray) -> float:
    """Excess cost at which starts (S, D), the best first, are given up.

    It grows with the residuals, since a wrong sigma should not make every other minimum unlikely.
    """
    cost = joint_cost(system, starts[0]) if len(starts) else np.inf
    variance = cost / max(2 * len(system.evidence.sightings.point), 1)
    return _UNLIKELY * max(1.0, float(variance)) if np.isfinite(variance) else _UNLIKELY


def _has_latent(evidence: Evidence) -> bool:
    """True if the evidence rests on a shape that may vary."""
    sighted = evidence.shape.spread[evidence.sightings.point]
    return bool(len(evidence.shape.modes) or sighted.any())


def refine_joint(
    evidence: Evidence, max_iterations: int, state: State
) -> tuple[float, State, int, bool]:
    """Improve a state; returns the cost, the state, the iterations, and if they converged.

    The cost is infinite if a point lies behind a camera at the start.
    """
    reduction, row = reduced_row(evidence, state)
    system = Joint(reduction.evidence, _has_latent(reduction.evidence))
    cost, iterations, converged = refine(system, max_iterations, row)
    if system.integrates and cost < np.inf:
        cost = joint_cost(Joint(reduction.evidence, False), row)
    found = whole_state(reduction, evidence.shape, unpacked(reduction.evidence, row))
    return cost, found, iterations, converged


def objective_of(evidence: Evidence, state: State) -> float:
    """Objective of `refine_joint`: the cost, with the log determinant of what is integrated out."""
    reduction, row = reduced_row(evidence, state)
    return float(joint_cost(Joint(reduction.evidence, _has_latent(reduction.evidence)), row))


def score_state(evidence: Evidence, state: State) -> float:
    """-2 log of the evidence by Laplace's approximation; infinite where it is not determined."""
    reduction, row = reduced_row(evidence, state)
    return float(joint_score(reduction.evidence, row))


def keypoints_of(evidence: Evidence, view: int) -> KeypointEvidence:
    """One view's keypoints of the mean shape, whose uncertainty is in their whitening."""
    sightings, shape = evidence.sightings, evidence.shape
    rows = np.flatnonzero((sightings.image == view) & (sightings.whitening[:, 2] > 0))
    point = sightings.point[rows]
    points, rays, whitening = shape.mean[point], sightings.rays[rows], sightings.whitening[rows]
    if not len(rows):
        return KeypointEvidence(points, rays, whitening, LINEAR, 1.0)
    variances = shape.spread[point] ** 2 + (shape.modes[:, point] ** 2).sum(axis=(0, 2)) / 3
    widen_by_shape(points, rays, variances, whitening)
    loss, loss_scale = int(sightings.loss[rows[0]]), float(sightings.loss_scale[rows[0]])
    return KeypointEvidence(points, rays, whitening, loss, loss_scale)


def view_starts(evidence: Evidence, view: int) -> tuple[FloatArray, FloatArray]:
    """Camera poses (S, 12) and log scales (S, 3) from one view's keypoints, the likeliest first."""
    given, scales = keypoints_of(evidence, view), evidence.scales
    if len(given.points) < LEAST_POINTS:
        return np.empty((0, 12)), np.empty((0, 3))
    # The solvers' first axis is one whose scale is known; the order of the others is cyclic, since
    # it must not be a reflection.
    order = (np.argmin(scales.free) + np.arange(3)) % 3
    weight = scales.precision[order[1], order[1]]
    prior = ScalePrior(weight, 0.0) if weight > 0 else scales.bound
    found, costs, _, _, info = optimal_batch(
        np.ascontiguousarray(given.points[:, order]),
        given.rays,
        given.whitening,
        np.array([0, len(given.points)]),
        given.loss,
        np.array([given.loss_scale]),
        np.array([prior.weight]),
        float(prior.width),
        np.append(np.ones(UNKNOWNS - 2), scales.free[order[1:]]),
        LEAST_POINTS,
    )
    own = costs[0, : min(info[0, 0], MOST_PER_VIEW)]
    variance = max(1.0, costs[0, 0] / (2 * len(given.points)))
    poses = found[0, : int((own < costs[0, 0] + _UNLIKELY_POSE * variance).sum())]
    place = np.argsort(order)
    rotations = poses[:, :9].reshape(-1, 3, 3)[:, :, place].reshape(-1, 9)
    return np.concatenate([rotations, poses[:, 9:12]], axis=1), np.log(poses[:, 12 + place])


_LEAST_SQUARE = 1e-14  # of a direction's rest, over the largest
_LOST = 0.01  # of a direction's square: less asks for a second pass


class Reduction(NamedTuple):
    """Evidence with fewer modes, those that it tells apart, and their basis in its own.

    Modes move the s points that the evidence names in at most 3 s directions. In an orthonormal
    ``basis`` (K + 3 u, r) of these, coefficients ``c = basis @ reduced`` plus a rest that moves no
    such point: the rest keeps its standard normal prior, and the reduced coefficients have one,
    too. Estimates, costs and determinants are those of all modes. With several poses, the
    displacements of sighted points are modes as well, before the basis is chosen: rows K + 3 j + a
    belong to that along axis a of point ``displaced[j]`` (u,).
    """

    evidence: Evidence
    basis: FloatArray
    displaced: IntArray


def reduce_modes(evidence: Evidence) -> Reduction:
    """The evidence with modes in the directions that it tells apart."""
    shape, modes = evidence.shape, len(evidence.shape.modes)
    sighted = sighted_points(evidence)
    displaced = np.empty(0, dtype=np.int64)
    if evidence.rig.pose.max() > 0:
        displaced = np.flatnonzero(sighted & (shape.spread > 0))
    size = modes + 3 * len(displaced)
    used = used_points(evidence)
    is_small = size <= 3 * used.sum()
    if is_small and not len(displaced):
        return Reduction(evidence, np.eye(modes), displaced)
    whole, spread = displaced_modes(shape, displaced), shape.spread.copy()
    spread[displaced] = 0.0
    basis = np.eye(size)
    if not is_small:
        directions = np.ascontiguousarray(whole[:, used].reshape(size, -1).T)
        basis = directions[: _orthonormalize(directions)]
        whole = (basis @ whole.reshape(size, -1)).reshape(-1, *shape.mean.shape)
    reduced = evidence._replace(shape=Shape(shape.mean, whole, spread))
    return Reduction(reduced, np.ascontiguousarray(basis.T), displaced)


def displaced_modes(shape: Shape, displaced: IntArray) -> FloatArray:
    """Modes (K + 3 u, m, 3): those of the shape, then displacements of some points (u,) by axes."""
    rows, axes = np.repeat(displaced, 3), np.tile(np.arange(3), len(displaced))
    own = np.zeros((len(rows), *shape.mean.shape))
    own[np.arange(len(rows)), rows, axes] = shape.spread[rows]
    return np.concatenate([shape.modes, own])


def reduced_state(reduction: Reduction, whole: Shape, state: State) -> State:
    """A state in reduced coefficients; ``whole`` is the shape that was reduced."""
    displaced = reduction.displaced
    moved = state.displacements[displaced] / whole.spread[displaced, None]
    displacements = state.displacements.copy()
    displacements[displaced] = 0.0
    given = np.concatenate([state.coefficients, moved.ravel()])
    return state._replace(
        coefficients=given @ reduction.basis,
        displacements=displacements,
    )


def reduced(evidence: Evidence, state: State) -> tuple[Evidence, State]:
    """The evidence in reduced modes, and a state of it."""
    reduction = reduce_modes(evidence)
    return reduction.evidence, reduced_state(reduction, evidence.shape, state)


def reduced_row(evidence: Evidence, state: State) -> tuple[Reduction, FloatArray]:
    """The reduction of evidence, and a state in it as a row of numbers."""
    reduction = reduce_modes(evidence)
    return reduction, packed(reduced_state(reduction, evidence.shape, state))


def whole_state(reduction: Reduction, whole: Shape, state: State) -> State:
    """The state in the coefficients and displacements of the shape that was reduced."""
    modes, displaced = len(whole.modes), reduction.displaced
    given = reduction.basis @ state.coefficients
    displacements = state.displacements.copy()
    displacements[displaced] = given[modes:].reshape(-1, 3) * whole.spread[displaced, None]
    return state._replace(coefficients=given[:modes], displacements=displacements)


def used_points(evidence: Evidence) -> BoolArray:
    """True for the points (m,) that a piece of evidence names."""
    used, ends = sighted_points(evidence), evidence.offsets.ends
    used[evidence.image_depths.point] = used[ends[ends >= 0]] = True
    return used


def sighted_points(evidence: Evidence) -> BoolArray:
    """True for the points (m,) that are sighted."""
    sighted = np.zeros(len(evidence.shape.mean), dtype=bool)
    sighted[evidence.sightings.point] = True
    return sighted


@fast_sums
def _squared(row: FloatArray) -> float:
    total = 0.0
    for k in range(row.shape[0]):
        total += row[k] * row[k]
    return total


@fast_sums
def _subtract(unit: FloatArray, row: FloatArray) -> float:
    """Take the part along a unit vector off a row; returns its length."""
    product = 0.0
    for k in range(row.shape[0]):
        product += unit[k] * row[k]
    for k in range(row.shape[0]):
        row[k] -= product * unit[k]
    return product


@fast_sums
def _orthonormalize(rows: FloatArray) -> int:
    """Turn the first rows of a matrix into an orthonormal basis of them all; returns its rank.

    Gram and Schmidt's method, the longest rest first, with a second pass for rows that lost most of
    their length.
    """
    count, size = rows.shape
    squares = np.empty(count)
    for i in range(count):
        squares[i] = _squared(rows[i])
    wholes = squares.copy()
    least = _LEAST_SQUARE * squares.max() if count else 0.0
    for rank in range(count):
        best = rank
        for i in range(rank + 1, count):
            if squares[i] > squares[best]:
                best = i
        if not squares[best] > least:
            return rank
        for k in range(size):
            rows[rank, k], rows[best, k] = rows[best, k], rows[rank, k]
        whole = wholes[best]
        squares[best], wholes[best] = squares[rank], wholes[rank]
        square = _squared(rows[rank])
        if square < _LOST * whole:
            for i in range(rank):
                _subtract(rows[i], rows[rank])
            square = _squared(rows[rank])
        factor = 1.0 / np.sqrt(square)
        for k in range(size):
            rows[rank, k] *= factor
        for i in range(rank + 1, count):
            squares[i] -= _subtract(rows[rank], rows[i]) ** 2
    return int(count)
