"""Starts, search and refinement of joint estimates, in a reduced basis of modes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.solvers.constants import LEAST_POINTS, LINEAR, UNKNOWNS, ScalePrior
from cadalign.solvers.evidence import KeypointEvidence
from cadalign.solvers.joint.equations import JointEquations
from cadalign.solvers.joint.evidence import Evidence, Shape, State, pack
from cadalign.solvers.joint.system import joint_system, run_joint
from cadalign.solvers.optimal import optimal_batch, rigid_flag
from cadalign.solvers.search import Effort
from cadalign.solvers.starts import widen_by_shape

_PROBE_ITERATIONS = 8
_MAX_ITERATIONS = 200
_UNLIKELY = 40.0  # excess cost, after the probe, at which a start is dropped
MOST_PER_VIEW = 8
_EVALUATION = Effort(0, 0, 0, np.inf)
_UNLIKELY_POSE = 60.0  # largest excess cost of a start, with the mean shape
_LEAST_SHARE = 1e-7  # least relative singular value of a direction in the reduced basis


class JointMinima(NamedTuple):
    """States, costs (M,) and scores (M,) of the minima of a joint estimate, best score first."""

    states: list[State]
    costs: FloatArray
    scores: FloatArray


def search_joint(
    evidence: Evidence, poses: FloatArray, log_focals: FloatArray, log_scales: FloatArray
) -> tuple[JointMinima, int]:
    """Minima from starts (S, P, 12), (S, F), (S, 3) of the mean shape, and iterations."""
    reduction, count = reduce_modes(evidence), len(poses)
    fewer = reduction.evidence
    if not count:
        return JointMinima([], np.empty(0), np.empty(0)), 0
    starts, integrates = _mean_rows(fewer, poses, log_focals, log_scales), _has_latent(fewer)
    unlikely = _UNLIKELY if integrates else _excess(fewer, starts[0])
    effort = Effort(count, _PROBE_ITERATIONS, _MAX_ITERATIONS, unlikely)
    minima, _ = run_joint(joint_system(fewer, integrates=integrates), starts, effort)
    found, iterations = minima.counts.tolist()
    states = [reduction.expand_state(row) for row in minima.states[:found]]
    return JointMinima(states, minima.costs[:found], minima.scores[:found]), iterations


def _mean_rows(
    evidence: Evidence, poses: FloatArray, log_focals: FloatArray, log_scales: FloatArray
) -> FloatArray:
    count = len(poses)
    unmoved = np.zeros((count, len(evidence.shape.modes) + evidence.shape.mean.size))
    rows = poses.reshape(count, 12 * poses.shape[1])
    return np.concatenate([rows, log_focals, log_scales, unmoved], axis=1)


def costs_at(
    evidence: Evidence, poses: FloatArray, log_focals: FloatArray, log_scales: FloatArray
) -> FloatArray:
    """Costs (S,) of the mean shape at starts; parameters as for `search_joint`."""
    rows = _mean_rows(evidence, poses, log_focals, log_scales)
    minima, _ = run_joint(joint_system(evidence, integrates=False), rows, _EVALUATION)
    return minima.costs


def _excess(evidence: Evidence, start: FloatArray) -> float:
    """Excess cost at which starts are dropped; it grows with the residuals at ``start`` (D,)."""
    variance = equations_at(evidence, start)[0] / max(2 * len(evidence.sightings.point), 1)
    return _UNLIKELY * max(1.0, variance) if variance < np.inf else _UNLIKELY


def _has_latent(evidence: Evidence) -> bool:
    sighted = evidence.shape.spread[evidence.sightings.point]
    return bool(len(evidence.shape.modes) or sighted.any())


def refine_joint(
    evidence: Evidence, max_iterations: int, state: State
) -> tuple[float, float, State]:
    """Improve a state; returns cost, score (both infinite behind a camera) and state."""
    reduction, row = pack_reduced(evidence, state)
    fewer, effort = reduction.evidence, Effort(1, max_iterations, 0, np.inf)
    system = joint_system(fewer, integrates=_has_latent(fewer))
    minima, _ = run_joint(system, row[None], effort)
    if not minima.counts[0]:
        return np.inf, np.inf, state
    return float(minima.costs[0]), float(minima.scores[0]), reduction.expand_state(minima.states[0])


def objective_of(evidence: Evidence, state: State) -> float:
    """Objective of `refine_joint`: the cost, plus the log determinant of integrated unknowns."""
    reduction, row = pack_reduced(evidence, state)
    return equations_at(reduction.evidence, row, integrates=_has_latent(reduction.evidence))[0]


def cost_of(evidence: Evidence, state: State) -> float:
    """Cost at a state, without the log determinant of integrated unknowns."""
    return equations_at(evidence, pack(state))[0]


def score_state(evidence: Evidence, state: State) -> float:
    """-2 log evidence by Laplace's approximation; infinite if unknowns are not determined."""
    return refine_joint(evidence, 0, state)[1]


def equations_at(
    evidence: Evidence, row: FloatArray, *, integrates: bool = False
) -> tuple[float, JointEquations]:
    """Objective and normal equations at a packed state."""
    system = joint_system(evidence, integrates=integrates)
    minima, equations = run_joint(system, row[None], _EVALUATION)
    return float(minima.costs[0]), equations


def keypoints_of(evidence: Evidence, view: int) -> KeypointEvidence:
    """One view's keypoints on the mean shape; their whitening includes the shape's variance."""
    sightings, shape = evidence.sightings, evidence.shape
    rows = np.flatnonzero((sightings.image == view) & (sightings.whitening[:, 2] > 0))
    point = sightings.point[rows]
    points, rays, whitening = shape.mean[point], sightings.rays[rows], sightings.whitening[rows]
    if not len(rows):
        return KeypointEvidence(points, rays, whitening, LINEAR, 1.0)
    variances = shape.spread[point] ** 2 + (shape.modes[:, point] ** 2).sum(axis=(0, 2)) / 3
    whitening = widen_by_shape(points, rays, variances, whitening)
    loss, loss_scale = int(sightings.loss[rows[0]]), float(sightings.loss_scale[rows[0]])
    return KeypointEvidence(points, rays, whitening, loss, loss_scale)


def view_starts(evidence: Evidence, view: int) -> tuple[FloatArray, FloatArray]:
    """Camera poses (S, 12) and log scales (S, 3) from one view's keypoints, likeliest first."""
    given, scales = keypoints_of(evidence, view), evidence.scales
    if len(given.points) < LEAST_POINTS:
        return np.empty((0, 12)), np.empty((0, 3))
    # The solver needs a fixed scale of the first axis. The order is cyclic to avoid a reflection.
    order = (np.argmin(scales.free) + np.arange(3)) % 3
    weight = scales.precision[order[1], order[1]]
    prior = ScalePrior(weight, 0.0) if weight > 0 else scales.bound
    free = np.append(np.ones(UNKNOWNS - 2), scales.free[order[1:]])
    found, costs, _, _, info = optimal_batch(
        np.ascontiguousarray(given.points[:, order]),
        given.rays,
        given.whitening,
        np.array([0, len(given.points)]),
        given.loss,
        np.array([given.loss_scale]),
        np.array([prior.weight]),
        float(prior.width),
        free,
        LEAST_POINTS,
        rigid_flag(given.loss, free),
    )
    own = costs[0, : min(info[0, 0], MOST_PER_VIEW)]
    variance = max(1.0, costs[0, 0] / (2 * len(given.points)))
    poses = found[0, : int((own < costs[0, 0] + _UNLIKELY_POSE * variance).sum())]
    place = np.argsort(order)
    rotations = poses[:, :9].reshape(-1, 3, 3)[:, :, place].reshape(-1, 9)
    return np.concatenate([rotations, poses[:, 9:12]], axis=1), np.log(poses[:, 12 + place])


class Reduction(NamedTuple):
    """Evidence in a reduced basis of modes.

    Modes move the s points of the evidence in at most 3 s directions. With an orthonormal ``basis``
    (K + 3 u, r), the coefficients are ``basis @ reduced`` plus a remainder that moves none of these
    points; both keep a standard normal prior. With several poses, the displacements of sighted
    points become modes: row K + 3 j + a of the basis is axis a of point ``displaced[j]`` (u,).
    ``full_shape`` is the shape before the reduction.
    """

    evidence: Evidence
    basis: FloatArray
    displaced: IntArray
    full_shape: Shape

    def reduce_state(self, state: State) -> State:
        moved = state.displacements[self.displaced] / self.full_shape.spread[self.displaced, None]
        displacements = state.displacements.copy()
        displacements[self.displaced] = 0.0
        given = np.concatenate([state.coefficients, moved.ravel()])
        return state._replace(coefficients=given @ self.basis, displacements=displacements)

    def expand_state(self, row: FloatArray) -> State:
        """Expand a packed reduced state to all coefficients and displacements."""
        focals, reduced = len(self.evidence.focals.low), self.basis.shape[1]
        modes, points = len(self.full_shape.modes), len(self.full_shape.mean)
        sizes = focals, 3, reduced, 3 * points
        ends = np.cumsum([len(row) - sum(sizes), *sizes[:-1]])
        poses, log_focals, log_scales, fewer, moved = np.split(row, ends)
        given, displacements = self.basis @ fewer, moved.reshape(-1, 3).copy()
        own = given[modes:].reshape(-1, 3)
        displacements[self.displaced] = own * self.full_shape.spread[self.displaced, None]
        return State(poses.reshape(-1, 12), log_focals, log_scales, given[:modes], displacements)


def reduce_modes(evidence: Evidence) -> Reduction:
    """Reduce the modes of evidence to the directions that it determines."""
    shape, modes = evidence.shape, len(evidence.shape.modes)
    sighted = sighted_points(evidence)
    displaced = np.empty(0, dtype=np.int64)
    if evidence.rig.pose.max() > 0:
        displaced = np.flatnonzero(sighted & (shape.spread > 0))
    size = modes + 3 * len(displaced)
    used = used_points(evidence)
    is_small = size <= 3 * used.sum()
    if is_small and not len(displaced):
        return Reduction(evidence, np.eye(modes), displaced, shape)
    whole, spread = displaced_modes(shape, displaced), shape.spread.copy()
    spread[displaced] = 0.0
    basis = np.eye(size)
    if not is_small:
        _, lengths, basis = np.linalg.svd(whole[:, used].reshape(size, -1).T, full_matrices=False)
        basis = basis[lengths > _LEAST_SHARE * lengths.max(initial=0.0)]
        whole = (basis @ whole.reshape(size, -1)).reshape(-1, *shape.mean.shape)
    reduced = evidence._replace(shape=Shape(shape.mean, whole, spread))
    return Reduction(reduced, np.ascontiguousarray(basis.T), displaced, shape)


def displaced_modes(shape: Shape, displaced: IntArray) -> FloatArray:
    """Modes (K + 3 u, m, 3): the shape's, then displacements of points (u,) along each axis."""
    rows, axes = np.repeat(displaced, 3), np.tile(np.arange(3), len(displaced))
    own = np.zeros((len(rows), *shape.mean.shape))
    own[np.arange(len(rows)), rows, axes] = shape.spread[rows]
    return np.concatenate([shape.modes, own])


def reduce_evidence(evidence: Evidence, state: State) -> tuple[Evidence, State]:
    """Reduced evidence, and the reduced state."""
    reduction = reduce_modes(evidence)
    return reduction.evidence, reduction.reduce_state(state)


def pack_reduced(evidence: Evidence, state: State) -> tuple[Reduction, FloatArray]:
    """Reduction of evidence, and the packed reduced state."""
    reduction = reduce_modes(evidence)
    return reduction, pack(reduction.reduce_state(state))


def used_points(evidence: Evidence) -> BoolArray:
    """True for the points (m,) with any evidence."""
    used, ends = sighted_points(evidence), evidence.offsets.ends
    used[ends[ends >= 0]] = True
    return used


def sighted_points(evidence: Evidence) -> BoolArray:
    """True for the points (m,) with a sighting."""
    sighted = np.zeros(len(evidence.shape.mean), dtype=bool)
    sighted[evidence.sightings.point] = True
    return sighted
