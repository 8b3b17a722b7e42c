"""Covariance of a joint estimate: of its unknowns and of the object's points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.compile import fast_sums, kernel
from cadalign.solvers.constants import ScalePrior
from cadalign.solvers.evidence import whole_information
from cadalign.solvers.joint.arrow import (
    Arrow,
    decide_on_undetermined,
    dense_matrix,
    factorize_arrow,
    invert_arrow,
)
from cadalign.solvers.joint.equations import JointEquations, joint_room
from cadalign.solvers.joint.evidence import Evidence, State, packed, unpacked, unstretched
from cadalign.solvers.joint.rows import first_scale
from cadalign.solvers.joint.search import reduced_row, sighted_points
from cadalign.solvers.joint.system import Joint, evaluate_joint


class JointCovariance(NamedTuple):
    """Covariances of the unknowns, and of every point in two frames.

    Blocks of every pose (P, 6, 6), of poses with the border (P, 6, b) and of the ``border`` (b, b):
    log focal lengths, log scales, coefficients. ``points`` (m, 3, 3) in the model's frame are those
    of the shape, scales and displacements included; ``seen`` (m, 3, 3) in the first view's camera
    include the pose.
    """

    poses: FloatArray
    cross: FloatArray
    border: FloatArray
    points: FloatArray
    seen: FloatArray


def joint_covariance(evidence: Evidence, state: State) -> JointCovariance:
    """The inverse information at a state; zero for log scales that are held.

    A scale that only its bound keeps from running off is as uncertain as the whole prior.
    """
    bound = evidence.scales.bound
    if bound.weight > 0:
        whole = ScalePrior(whole_information(bound), bound.width)
        evidence = evidence._replace(scales=evidence.scales._replace(bound=whole))
    reduction, row = reduced_row(evidence, state)
    basis = np.ascontiguousarray(reduction.basis[: len(evidence.shape.modes)])
    reduced, sighted = reduction.evidence, sighted_points(evidence)
    equations = joint_room(reduced)
    evaluate_joint(Joint(reduced, False), row, equations)
    is_determined, inverse = _inverse_of(equations.arrow)
    if not is_determined:
        return _unbounded(evidence, len(inverse.blocks))
    return _covariances_from(evidence, reduced, basis, row, equations, inverse, sighted)


@kernel
def _inverse_of(arrow: Arrow) -> tuple[bool, Arrow]:
    """The inverse information about poses and border; False if it is not determined."""
    decide_on_undetermined(arrow, arrow.blocks.shape[0] > 1)
    if not factorize_arrow(arrow):
        return False, arrow
    return True, invert_arrow(arrow)


def _unbounded(evidence: Evidence, poses: int) -> JointCovariance:
    """Infinite covariances, of what is not determined."""
    size = len(evidence.focals.low) + 3 + len(evidence.shape.modes)
    points = len(evidence.shape.mean)
    return JointCovariance(
        np.full((poses, 6, 6), np.inf),
        np.full((poses, 6, size), np.inf),
        np.full((size, size), np.inf),
        np.full((points, 3, 3), np.inf),
        np.full((points, 3, 3), np.inf),
    )


@kernel
def _covariances_from(
    evidence: Evidence,
    reduced: Evidence,
    basis: FloatArray,
    row: FloatArray,
    equations: JointEquations,
    inverse: Arrow,
    sighted: BoolArray,
) -> JointCovariance:
    """Covariances from the ``inverse`` information about poses and border in ``reduced`` modes.

    The ``basis`` (K, r) of these is that of all.
    """
    state, first = unpacked(reduced, row), first_scale(evidence)
    points = evidence.shape.mean.shape[0]
    for a in range(3):
        if evidence.scales.free[a] == 0.0:
            inverse.border[first + a, first + a] = 0.0
    covariance = _pose_and_border(inverse, evidence.rig.pose[0])
    by_unknowns, own = _points_by_unknowns(evidence, reduced, state, equations, sighted)
    of_points = _blocks(by_unknowns, covariance) + own
    turn = _turn_and_move(reduced, state, by_unknowns)
    of_seen = _blocks(by_unknowns, covariance)
    for i in range(points):
        of_seen[i] += turn @ own[i] @ turn.T
    return JointCovariance(
        inverse.blocks,
        _cross_of_all_modes(inverse.coupling, basis, first + 3),
        _border_of_all_modes(inverse.border, basis, first + 3),
        of_points,
        of_seen,
    )


@kernel
def _pose_and_border(inverse: Arrow, pose: int) -> FloatArray:
    """Covariance (6 + b, 6 + b) of one pose and the border."""
    size = 6 + inverse.border.shape[0]
    found = np.empty((size, size))
    found[:6, :6] = inverse.blocks[pose]
    found[:6, 6:] = inverse.coupling[pose]
    found[6:, :6] = inverse.coupling[pose].T
    found[6:, 6:] = inverse.border
    return found


@kernel
def _cross_of_all_modes(coupling: FloatArray, basis: FloatArray, first: int) -> FloatArray:
    """Covariances (P, 6, b) of poses with the border, of all modes."""
    whole = np.empty((coupling.shape[0], 6, first + basis.shape[0]))
    for p in range(coupling.shape[0]):
        whole[p, :, :first] = coupling[p, :, :first]
        whole[p, :, first:] = np.ascontiguousarray(coupling[p, :, first:]) @ basis.T
    return whole


@kernel
def _border_of_all_modes(border: FloatArray, basis: FloatArray, first: int) -> FloatArray:
    """Covariance of the border with all modes from that with reduced ones.

    The rest of the modes keeps its prior.
    """
    modes, reduced = basis.shape
    gain = border[first:, first:] - np.eye(reduced)
    whole = np.empty((first + modes, first + modes))
    whole[:first, :first] = border[:first, :first]
    whole[first:, :first] = basis @ np.ascontiguousarray(border[first:, :first])
    whole[:first, first:] = whole[first:, :first].T
    whole[first:, first:] = basis @ gain @ basis.T
    for k in range(first, first + modes):
        whole[k, k] += 1.0
    return whole


@kernel
def _points_by_unknowns(
    evidence: Evidence,
    reduced: Evidence,
    state: State,
    equations: JointEquations,
    sighted: BoolArray,
) -> tuple[FloatArray, FloatArray]:
    """Derivatives (m, 3, 6 + b) of all points by a pose and the border, covariances of the rest.

    The rest (m, 3, 3) are displacements and the modes that the evidence doesn't tell apart.
    """
    points, modes = reduced.shape.mean.shape[0], reduced.shape.modes.shape[0]
    first = 6 + first_scale(evidence)
    unknowns = first + 3 + modes
    scale = np.exp(state.log_scales)
    columns = equations.columns
    rows = np.zeros((points, 3, unknowns))
    own = np.zeros((points, 3, 3))
    left_out = evidence.shape.modes.shape[0] > 0
    for i in range(points):
        for a in range(3):
            for k in range(modes):
                rows[i, a, first + 3 + k] = scale[a] * reduced.shape.modes[k, i, a]
            rows[i, a, first + a] = scale[a] * unstretched(reduced.shape, state, i, a)
        square = reduced.shape.spread[i] ** 2
        for a in range(3):
            own[i, a, a] = scale[a] * scale[a] * square
        for c in range(columns[i, 0], columns[i, 1]):
            for a in range(3):
                by_own = scale[a] * square * equations.rows[unknowns + 1 + a, c]
                for b in range(3):
                    own[i, a, b] -= by_own * scale[b] * square * equations.rows[unknowns + 1 + b, c]
                for k in range(unknowns):
                    rows[i, a, k] -= by_own * equations.rows[k, c]
        if left_out and not sighted[i]:
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
def _turn_and_move(evidence: Evidence, state: State, rows: FloatArray) -> FloatArray:
    """Take derivatives (m, 3, 6 + b) of points from the model's frame to the first camera's.

    There a point is exp(rotation vector) turned + translation, in the rig's frame. Returns the
    rotation (3, 3) of the camera from the model.
    """
    pose = state.poses[evidence.rig.pose[0]]
    rotation = pose[:9].copy().reshape((3, 3))
    camera = evidence.rig.cam_from_rig[0, :9].copy().reshape((3, 3))
    turn: FloatArray = camera @ rotation
    scale = np.exp(state.log_scales)
    point = np.empty(3)
    for i in range(rows.shape[0]):
        for a in range(3):
            point[a] = scale[a] * unstretched(evidence.shape, state, i, a)
        for k in range(rows.shape[2]):
            u, v, w = rows[i, 0, k], rows[i, 1, k], rows[i, 2, k]
            for a in range(3):
                rows[i, a, k] = turn[a, 0] * u + turn[a, 1] * v + turn[a, 2] * w
        x, y, z = rotation @ point
        across = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
        rows[i, :, :3] += camera @ across
        rows[i, :, 3:6] += camera
    return turn


def information_of(evidence: Evidence, state: State) -> tuple[float, FloatArray]:
    """The cost at a state, and the information (U, U) about all unknowns, border last."""
    equations = joint_room(evidence)
    cost = evaluate_joint(Joint(evidence, False), packed(state), equations)
    return float(cost), dense_matrix(equations.arrow)


def scaled_information(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Information (U, U) of unit diagonal, and the roots (U,) of its own."""
    sizes = np.sqrt(np.maximum(information.diagonal(), 1e-300))
    return information / np.outer(sizes, sizes), sizes
