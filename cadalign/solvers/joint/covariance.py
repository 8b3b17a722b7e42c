"""Covariance of a joint estimate: of the unknowns and of the object's points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.geometry.rotations import by_rotation
from cadalign.solvers.constants import ScalePrior
from cadalign.solvers.evidence import whole_information
from cadalign.solvers.joint.arrow import Arrow, dense_matrix, invert_arrow
from cadalign.solvers.joint.equations import JointEquations
from cadalign.solvers.joint.evidence import Evidence, State, pack, points_of
from cadalign.solvers.joint.search import equations_at, reduce_modes, sighted_points


class JointCovariance(NamedTuple):
    """Covariances of the unknowns, and of every point in two frames.

    ``poses`` (P, 6, 6), ``cross`` (P, 6, b) of poses with the border, ``border`` (b, b) of log
    focal lengths, log scales and coefficients. ``points`` (m, 3, 3) are in the model's frame,
    ``seen`` (m, 3, 3) in the first view's camera, where they include the pose's uncertainty.
    """

    poses: FloatArray
    cross: FloatArray
    border: FloatArray
    points: FloatArray
    seen: FloatArray


def joint_covariance(evidence: Evidence, state: State) -> JointCovariance:
    """Inverse information, infinite if not determined; a scale at its bound has its whole prior."""
    bound = evidence.scales.bound
    if bound.weight > 0:
        whole = ScalePrior(whole_information(bound), bound.width)
        evidence = evidence._replace(scales=evidence.scales._replace(bound=whole))
    reduction = reduce_modes(evidence)
    reduced, fewer = reduction.evidence, reduction.reduce_state(state)
    _, equations = equations_at(reduced, pack(fewer))
    inverse = invert_arrow(equations.arrow)
    first, modes = len(evidence.focals.low) + 3, len(evidence.shape.modes)
    if inverse is None:
        poses, points = len(state.poses), len(evidence.shape.mean)
        blocks = (poses, 6, 6), (poses, 6, first + modes), (first + modes, first + modes)
        of_points = (points, 3, 3), (points, 3, 3)
        return JointCovariance(*(np.full(size, np.inf) for size in (*blocks, *of_points)))
    held = first - 3 + np.flatnonzero(evidence.scales.free == 0)
    inverse.border[held, held] = 0.0
    rows, own = _point_jacobians(evidence, reduced, fewer, equations, sighted_points(evidence))
    turn, rows_seen = _first_camera_frame(reduced, fewer, rows)
    unknowns = pose_and_border(inverse, evidence.rig.pose[0])
    # Modes without evidence keep their prior.
    basis = reduction.basis[:modes]
    lift = np.zeros((first + modes, first + basis.shape[1]))
    lift[:first, :first] = np.eye(first)
    lift[first:, first:] = basis
    border = lift @ inverse.border @ lift.T
    border[first:, first:] += np.eye(modes) - basis @ basis.T
    return JointCovariance(
        inverse.blocks,
        inverse.coupling @ lift.T,
        border,
        rows @ unknowns @ rows.swapaxes(1, 2) + own,
        rows_seen @ unknowns @ rows_seen.swapaxes(1, 2) + turn @ own @ turn.T,
    )


def pose_and_border(inverse: Arrow | JointCovariance, pose: int) -> FloatArray:
    """Covariance (6 + b, 6 + b) of one pose and the border."""
    poses, cross, border, *_ = inverse
    return np.block([[poses[pose], cross[pose]], [cross[pose].T, border]])


def _point_jacobians(
    evidence: Evidence,
    reduced: Evidence,
    state: State,
    equations: JointEquations,
    sighted: BoolArray,
) -> tuple[FloatArray, FloatArray]:
    """Derivatives (m, 3, 6 + b) of points by pose and border, other covariances (m, 3, 3)."""
    shape, scale, axes = reduced.shape, np.exp(state.log_scales), np.arange(3)
    modes, points = shape.modes.transpose(1, 2, 0), points_of(shape, state)
    first = 6 + len(evidence.focals.low)
    rows = np.zeros((*points.shape, first + 3 + len(shape.modes)))
    rows[:, axes, first + axes] = points
    rows[:, :, first + 3 :] = scale[:, None] * modes
    squares = shape.spread**2
    own = squares[:, None, None] * np.diag(scale**2)
    begins, counts = equations.layout.columns[:, 0], np.diff(equations.layout.columns)[:, 0]
    eliminated = np.flatnonzero(counts)
    if len(eliminated):
        # Columns are grouped by points; a displacement is linear in the residuals of its point.
        columns, unknowns = slice(counts.sum()), rows.shape[2]
        by_own = equations.rows[unknowns + 1 :, columns].T
        by_own = by_own * scale * np.repeat(squares, counts)[:, None]
        by_unknowns = equations.rows[:unknowns, columns].T
        for target, factors in ((own, by_own), (rows, by_unknowns)):
            products = by_own[:, :, None] * factors[:, None]
            target[eliminated] -= np.add.reduceat(products, begins[eliminated])
    every, apart = evidence.shape.modes.transpose(1, 2, 0)[~sighted], modes[~sighted]
    rest = every @ every.swapaxes(1, 2) - apart @ apart.swapaxes(1, 2)
    own[~sighted] += np.outer(scale, scale) * rest
    return rows, own


def _first_camera_frame(
    evidence: Evidence, state: State, rows: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Rotation (3, 3) from the model to the first camera, and derivatives (m, 3, 6 + b) there."""
    rotation = state.poses[evidence.rig.pose[0], :9].reshape(3, 3)
    camera = evidence.rig.cam_from_rig[0, :9].reshape(3, 3)
    turn = camera @ rotation
    turned = points_of(evidence.shape, state) @ rotation.T
    moved = turn @ rows
    moved[:, :, :3] += camera @ by_rotation(turned)
    moved[:, :, 3:6] += camera
    return turn, moved


def information_of(evidence: Evidence, state: State) -> tuple[float, FloatArray]:
    """Cost at a state, and information (U, U) about all unknowns, border last."""
    cost, equations = equations_at(evidence, pack(state))
    return cost, dense_matrix(equations.arrow)


def scaled_information(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Information (U, U) scaled to unit diagonal, and the square roots (U,) of its diagonal."""
    sizes = np.sqrt(np.maximum(information.diagonal(), 1e-300))
    return information / np.outer(sizes, sizes), sizes
