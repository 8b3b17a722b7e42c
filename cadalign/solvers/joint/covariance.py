"""Covariance of a joint estimate: of its unknowns and of the object's points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import fast_sums, kernel
from cadalign.solvers.joint.evidence import Evidence, State
from cadalign.solvers.joint.factor import decide_on_undetermined, factorize, invert_factor
from cadalign.solvers.joint.reduction import reduce_modes
from cadalign.solvers.joint.system import System, empty_system, evaluate_joint


class JointCovariance(NamedTuple):
    """Covariances: of the ``unknowns`` (U, U), and of every point in two frames.

    ``points`` (m, 3, 3) in the model's frame are those of the shape, scales and displacements
    included; ``seen`` (m, 3, 3) in the first view's camera include the pose.
    """

    unknowns: FloatArray
    points: FloatArray
    seen: FloatArray


@kernel
def joint_covariance(evidence: Evidence, state: State) -> JointCovariance:
    """The inverse information at a state; zero for log scales that are held."""
    reduced, basis = reduce_modes(evidence)
    small = State(state.poses, state.log_scales, state.coefficients @ basis, state.displacements)
    system = empty_system(reduced)
    evaluate_joint(reduced, small, system)
    points, modes = evidence.shape.mean.shape[0], basis.shape[0]
    unknowns = system.gradient.shape[0]
    first = unknowns - basis.shape[1] - 3
    if state.poses.shape[0] > 1:
        decide_on_undetermined(system.hessian, state.poses.shape[0])
    if not factorize(system.hessian):
        size = first + 3 + modes
        return JointCovariance(
            np.full((size, size), np.inf),
            np.full((points, 3, 3), np.inf),
            np.full((points, 3, 3), np.inf),
        )
    inverse = invert_factor(system.hessian)
    covariance = inverse.T @ inverse
    for a in range(3):
        if evidence.scales.free[a] == 0.0:
            covariance[first + a, first + a] = 0.0
    by_unknowns, own = _points_by_unknowns(evidence, reduced, small, system)
    of_points = _blocks(by_unknowns, covariance) + own
    _turn_and_move(reduced, small, by_unknowns)
    of_seen = _blocks(by_unknowns, covariance)
    turn = _cam_from_model(evidence, state)
    for i in range(points):
        of_seen[i] += turn @ own[i] @ turn.T
    return JointCovariance(_of_all_modes(covariance, basis), of_points, of_seen)


@kernel
def _of_all_modes(covariance: FloatArray, basis: FloatArray) -> FloatArray:
    """Covariance of all unknowns from that with reduced modes: the rest keeps its prior."""
    modes, reduced = basis.shape
    first = covariance.shape[0] - reduced
    gain = covariance[first:, first:] - np.eye(reduced)
    whole = np.empty((first + modes, first + modes))
    whole[:first, :first] = covariance[:first, :first]
    whole[first:, :first] = basis @ np.ascontiguousarray(covariance[first:, :first])
    whole[:first, first:] = whole[first:, :first].T
    whole[first:, first:] = basis @ gain @ basis.T
    for k in range(first, first + modes):
        whole[k, k] += 1.0
    return whole


@kernel
def _points_by_unknowns(
    evidence: Evidence, reduced: Evidence, state: State, system: System
) -> tuple[FloatArray, FloatArray]:
    """Derivatives (m, 3, U) of all points by the unknowns, and covariances (m, 3, 3) of the rest.

    The rest are displacements and the modes that the evidence doesn't tell apart.
    """
    points, modes = reduced.shape.mean.shape[0], reduced.shape.modes.shape[0]
    unknowns = system.gradient.shape[0]
    first = unknowns - modes - 3
    scale = np.exp(state.log_scales)
    starts, ends = _equations_of_points(reduced, system, points)
    rows = np.zeros((points, 3, unknowns))
    own = np.zeros((points, 3, 3))
    left_out = evidence.shape.modes.shape[0] > modes
    for i in range(points):
        for a in range(3):
            value = reduced.shape.mean[i, a]
            for k in range(modes):
                mode = reduced.shape.modes[k, i, a]
                value += state.coefficients[k] * mode
                rows[i, a, first + 3 + k] = scale[a] * mode
            rows[i, a, first + a] = scale[a] * value
        square = reduced.shape.spread[i] ** 2
        for a in range(3):
            own[i, a, a] = square
        for c in range(starts[i], ends[i]):
            for a in range(3):
                by_own = square * system.rows[unknowns + 1 + a, c]
                for b in range(3):
                    own[i, a, b] -= by_own * square * system.rows[unknowns + 1 + b, c]
                for k in range(unknowns):
                    rows[i, a, k] -= by_own * system.rows[k, c]
        if left_out and ends[i] == 0:
            _add_rest(evidence.shape.modes, reduced.shape.modes, scale, i, own[i])
    return rows, own


@kernel
def _add_rest(
    all_modes: FloatArray, reduced: FloatArray, scale: FloatArray, i: int, own: FloatArray
) -> None:
    """Add the covariance of point i that the reduced modes lack."""
    for a in range(3):
        for b in range(3):
            total = 0.0
            for k in range(all_modes.shape[0]):
                total += all_modes[k, i, a] * all_modes[k, i, b]
            for k in range(reduced.shape[0]):
                total -= reduced[k, i, a] * reduced[k, i, b]
            own[a, b] += scale[a] * scale[b] * total


@kernel
def _equations_of_points(
    evidence: Evidence, system: System, points: int
) -> tuple[IntArray, IntArray]:
    """The first column of each point's equations (m,) and the one after its last (m,)."""
    starts = np.zeros(points, dtype=np.int64)
    ends = np.zeros(points, dtype=np.int64)
    for n in range(evidence.sightings.point.shape[0]):
        i = evidence.sightings.point[n]
        if ends[i] == 0:
            starts[i] = system.first[n]
        ends[i] = system.first[n + 1]
    return starts, ends


@fast_sums
def _blocks(rows: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariances (m, 3, 3) of m triples of combinations (m, 3, U) of the unknowns."""
    points, _, unknowns = rows.shape
    flat = rows.reshape((3 * points, unknowns))
    products = (flat @ covariance).reshape((points, 3, unknowns))
    found = np.empty((points, 3, 3))
    for i in range(points):
        for a in range(3):
            for b in range(3):
                total = 0.0
                for k in range(unknowns):
                    total += products[i, a, k] * rows[i, b, k]
                found[i, a, b] = total
    return found


@kernel
def _turn_and_move(evidence: Evidence, state: State, rows: FloatArray) -> None:
    """Take derivatives (m, 3, U) of points from the model's frame to the first camera's.

    There a point is exp(rotation vector) turned + translation, in the rig's frame.
    """
    shape = evidence.shape
    pose = state.poses[evidence.rig.pose[0]]
    rotation = pose[:9].copy().reshape((3, 3))
    camera = evidence.rig.cam_from_rig[0, :9].copy().reshape((3, 3))
    turn = camera @ rotation
    first = 6 * evidence.rig.pose[0]
    scale = np.exp(state.log_scales)
    point = np.empty(3)
    for i in range(rows.shape[0]):
        for a in range(3):
            value = shape.mean[i, a]
            for k in range(shape.modes.shape[0]):
                value += state.coefficients[k] * shape.modes[k, i, a]
            point[a] = scale[a] * value + state.displacements[i, a]
        for k in range(rows.shape[2]):
            u, v, w = rows[i, 0, k], rows[i, 1, k], rows[i, 2, k]
            for a in range(3):
                rows[i, a, k] = turn[a, 0] * u + turn[a, 1] * v + turn[a, 2] * w
        x, y, z = rotation @ point
        across = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
        rows[i, :, first : first + 3] += camera @ across
        rows[i, :, first + 3 : first + 6] += camera


@kernel
def _cam_from_model(evidence: Evidence, state: State) -> FloatArray:
    """Rotation (3, 3) of the first camera from the model."""
    camera = evidence.rig.cam_from_rig[0, :9].copy().reshape((3, 3))
    return camera @ state.poses[evidence.rig.pose[0], :9].copy().reshape((3, 3))
