"""The joint system with smooth motion between successive poses; states, steps, covariance.

A state is one of `cadalign.solvers.joint.system.Joint` followed by the velocities of all poses
(P, 6). Unknowns stand frame by frame, pose then velocity, and the border last.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.solvers.joint.arrow import (
    Arrow,
    decide_on_undetermined,
    factorize_arrow,
    invert_arrow,
)
from cadalign.solvers.joint.covariance import JointCovariance, covariances_from, unbounded
from cadalign.solvers.joint.equations import JointEquations, joint_room
from cadalign.solvers.joint.evidence import Evidence, State, packed, unpacked
from cadalign.solvers.joint.motion import STATE, MotionPrior, add_motion, log_rotation, moments
from cadalign.solvers.joint.search import (
    has_latent,
    reduce_modes,
    reduced_row,
    reduced_state,
    sighted_points,
    whole_state,
)
from cadalign.solvers.joint.system import Joint, evaluate_joint, move_joint, solve_joint
from cadalign.solvers.search import evaluate, move, refine, room_of, solve


class Anchor(NamedTuple):
    """Information of earlier frames on the first frame and the border, to second order.

    At the ``pose`` (12,), the ``velocity`` (6,) and the ``border`` (b,) half the cost has the
    ``gradient`` (12 + b,) and the ``information`` (12 + b, 12 + b), which is (0, 0) for nothing.
    """

    pose: FloatArray
    velocity: FloatArray
    border: FloatArray
    gradient: FloatArray
    information: FloatArray


_NONE = np.empty(0)
NOTHING_KNOWN = Anchor(_NONE, _NONE, _NONE, _NONE, np.empty((0, 0)))


class Moving(NamedTuple):
    """All evidence about poses in the order of time, and the motion between them.

    With ``integrates`` the shape is integrated out of the objective.
    """

    evidence: Evidence
    integrates: bool
    motion: MotionPrior
    anchor: Anchor


@kernel
def _velocities(system: Moving, row: FloatArray) -> FloatArray:
    frames = system.motion.seconds.shape[0] + 1
    return row[row.shape[0] - 6 * frames :].reshape((frames, 6))


@kernel
def _joint_part(system: Moving, row: FloatArray) -> FloatArray:
    return row[: row.shape[0] - 6 * (system.motion.seconds.shape[0] + 1)]


@room_of.of(Moving)
@kernel
def _room_of(system: Moving) -> tuple[JointEquations, JointEquations]:
    return joint_room(system.evidence, STATE, STATE), joint_room(system.evidence, STATE, STATE)


@evaluate.of(Moving)
@kernel
def evaluate_moving(system: Moving, row: FloatArray, equations: JointEquations) -> float:
    """Write the normal equations at a state; see `cadalign.solvers.search.evaluate`."""
    cost = _evaluate_evidence(system, row, equations)
    return cost + _add_motion(system, row, equations) if cost < np.inf else np.inf


@kernel
def _evaluate_evidence(system: Moving, row: FloatArray, equations: JointEquations) -> float:
    joint = Joint(system.evidence, system.integrates)
    return evaluate_joint(joint, _joint_part(system, row), equations)


@kernel
def _add_motion(system: Moving, row: FloatArray, equations: JointEquations) -> float:
    """Add the motion, and what is known of the first frame; returns their cost."""
    arrow = equations.arrow
    state = unpacked(system.evidence, _joint_part(system, row))
    velocities = _velocities(system, row)
    cost = add_motion(system.motion, state.poses, velocities, arrow)
    if system.motion.told > 0.0:
        cost += _add_volume(system, state, arrow)
    if system.anchor.information.shape[0] > 0:
        cost += _add_anchor(system.anchor, state, velocities[0], arrow)
    return cost


solve.of(Moving)(solve_joint)


@kernel
def _add_volume(system: Moving, state: State, arrow: Arrow) -> float:
    """Add the slope of what `MotionPrior` says of depths; returns its cost."""
    rig, told, cost = system.evidence.rig, system.motion.told, 0.0
    frames = state.poses.shape[0]
    counts = np.zeros(frames)
    for view in range(rig.pose.shape[0]):
        counts[rig.pose[view]] += 1.0
    for view in range(rig.pose.shape[0]):
        p, camera = rig.pose[view], rig.cam_from_rig[view]
        depth = camera[11]
        for a in range(3):
            depth += camera[6 + a] * state.poses[p, 9 + a]
        if not depth > 0.0:
            return np.inf
        share = told / counts[p]
        cost += 2.0 * share * np.log(system.motion.farthest / depth)
        for a in range(3):
            arrow.gradient[STATE * p + 3 + a] -= share * camera[6 + a] / depth
    return cost


@kernel
def _add_anchor(anchor: Anchor, state: State, velocity: FloatArray, arrow: Arrow) -> float:
    """Add what is known of the first frame and the border; returns its cost."""
    size, last = anchor.border.shape[0], arrow.gradient.shape[0] - anchor.border.shape[0]
    away = np.empty(STATE + size)
    start, now = anchor.pose[:9].reshape((3, 3)), state.poses[0, :9].copy().reshape((3, 3))
    away[:3] = log_rotation(now @ start.T)
    away[3:6] = state.poses[0, 9:] - anchor.pose[9:]
    away[6:STATE] = velocity - anchor.velocity
    focals = state.log_focals.shape[0]
    away[STATE : STATE + focals] = state.log_focals
    away[STATE + focals : STATE + focals + 3] = state.log_scales
    away[STATE + focals + 3 :] = state.coefficients
    away[STATE:] -= anchor.border
    slope = anchor.information @ away + anchor.gradient
    arrow.gradient[:STATE] += slope[:STATE]
    arrow.gradient[last:] += slope[STATE:]
    arrow.blocks[0] += anchor.information[:STATE, :STATE]
    arrow.coupling[0, :, STATE:] += anchor.information[:STATE, STATE:]
    arrow.border[:] += anchor.information[STATE:, STATE:]
    return float(((slope + anchor.gradient) * away).sum())


@move.of(Moving)
@kernel
def _move(
    system: Moving,
    row: FloatArray,
    equations: JointEquations,
    damping: float,
    step: FloatArray,
    moved_row: FloatArray,
) -> None:
    frames = system.motion.seconds.shape[0] + 1
    own = np.empty(6 * frames + step.shape[0] - STATE * frames)
    velocities, moved = _velocities(system, row), _velocities(system, moved_row)
    for p in range(frames):
        for k in range(6):
            own[6 * p + k] = step[STATE * p + k]
            moved[p, k] = velocities[p, k] + step[STATE * p + 6 + k]
    own[6 * frames :] = step[STATE * frames :]
    move_joint(
        Joint(system.evidence, system.integrates),
        _joint_part(system, row),
        equations,
        damping,
        own,
        _joint_part(system, moved_row),
    )


class Path(NamedTuple):
    """An estimate of a track: the joint ``state`` and the ``velocities`` (P, 6) of the body."""

    state: State
    velocities: FloatArray


def frame_information(evidence: Evidence, state: State) -> FloatArray:
    """Greatest information (2,) of one frame about a rotation and a translation along an axis."""
    reduction, row = reduced_row(evidence, state)
    equations = joint_room(reduction.evidence, 6, 0)
    evaluate_joint(Joint(reduction.evidence, False), row, equations)
    diagonals = np.einsum("pkk->pk", equations.arrow.blocks)
    return np.asarray(diagonals.reshape(-1, 2, 3).max(axis=(0, 2)))


def refine_moving(
    evidence: Evidence,
    motion: MotionPrior,
    path: Path,
    *,
    max_iterations: int,
) -> tuple[float, Path, int]:
    """Improve a path, the shape integrated out; returns the objective, the path, the iterations.

    The objective is infinite if a point lies behind a camera at the start.
    """
    reduction = reduce_modes(evidence)
    reduced = reduction.evidence
    state = reduced_state(reduction, evidence.shape, path.state)
    system = Moving(reduced, has_latent(reduced), motion, NOTHING_KNOWN)
    cost, found, iterations = refine_path(system, path._replace(state=state), max_iterations)
    whole = whole_state(reduction, evidence.shape, found.state)
    return cost, found._replace(state=whole), iterations


def refine_path(system: Moving, path: Path, max_iterations: int) -> tuple[float, Path, int]:
    """Improve a path of a system whose modes are all used."""
    row = row_of(path)
    cost, iterations, _ = refine(system, max_iterations, row)
    count = path.velocities.size
    state = unpacked(system.evidence, row[:-count])
    return cost, Path(state, row[-count:].reshape(-1, 6)), iterations


def row_of(path: Path) -> FloatArray:
    """The path as a row of numbers."""
    return np.concatenate([packed(path.state), path.velocities.ravel()])


def equations_of(system: Moving, path: Path) -> tuple[float, Arrow]:
    """The cost and the normal equations at a path."""
    equations = joint_room(system.evidence, STATE, STATE)
    return evaluate_moving(system, row_of(path), equations), equations.arrow


class PathCovariance(NamedTuple):
    """Covariances of a path: those of the joint estimate, and of successive frames.

    ``frames`` (P, 12, 12) are those of pose and velocity, ``links`` (P, 12, 12) of frames with the
    next one. ``squares`` and ``variances`` (2,) are those of `moments`, and ``costs`` (2,) those of
    evidence and motion.
    """

    joint: JointCovariance
    frames: FloatArray
    links: FloatArray
    squares: FloatArray
    variances: FloatArray
    costs: FloatArray


def moving_covariance(evidence: Evidence, motion: MotionPrior, path: Path) -> PathCovariance:
    """The inverse information at a path."""
    reduction, row = reduced_row(evidence, path.state)
    row = np.concatenate([row, path.velocities.ravel()])
    basis = np.ascontiguousarray(reduction.basis[: len(evidence.shape.modes)])
    reduced, sighted = reduction.evidence, sighted_points(evidence)
    system = Moving(reduced, False, motion._replace(told=0.0), NOTHING_KNOWN)
    equations = joint_room(reduced, STATE, STATE)
    joint = row[: -path.velocities.size]
    cost = evaluate_joint(Joint(reduced, False), joint, equations)
    found = _inverse_of(system, row, equations, cost)
    if not found.is_determined:
        frames = len(equations.arrow.blocks)
        nothing, unknown = np.full((frames, STATE, STATE), np.inf), np.full(2, np.inf)
        endless = unbounded(evidence, frames)
        return PathCovariance(endless, nothing, nothing, unknown, unknown, unknown)
    of_all = covariances_from(evidence, reduced, basis, joint, equations, found.of_poses, sighted)
    return PathCovariance(of_all, *found[2:])


class _Inverse(NamedTuple):
    """The inverse information: that ``of_poses`` and border, and what `PathCovariance` holds."""

    is_determined: bool
    of_poses: Arrow
    frames: FloatArray
    links: FloatArray
    squares: FloatArray
    variances: FloatArray
    costs: FloatArray


@kernel
def _inverse_of(
    system: Moving, row: FloatArray, equations: JointEquations, cost: float
) -> _Inverse:
    """The inverse information at a path, from the equations of its evidence and their cost."""
    arrow = equations.arrow
    # Before the motion, whose information may be more than a trillion times that of the evidence.
    decide_on_undetermined(arrow, True)
    if cost < np.inf:
        cost += _add_motion(system, row, equations)
    if not factorize_arrow(arrow):
        nothing = np.empty(0)
        return _Inverse(False, arrow, arrow.blocks, arrow.blocks, nothing, nothing, nothing)
    inverse = invert_arrow(arrow)
    of_poses = Arrow(
        inverse.blocks[:, :6, :6].copy(),
        inverse.coupling[:, :6, STATE:].copy(),
        inverse.border,
        inverse.gradient,
    )
    poses = unpacked(system.evidence, _joint_part(system, row)).poses
    squares, variances = moments(system.motion, poses, _velocities(system, row), inverse)
    links = inverse.coupling[:, :, :STATE].copy()
    costs = np.array([cost - squares.sum(), squares.sum()])
    return _Inverse(True, of_poses, inverse.blocks, links, squares, variances, costs)
