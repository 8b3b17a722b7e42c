"""The joint system with smooth motion between successive poses; states, steps, covariance.

A state is one of `cadalign.solvers.joint.system.Joint` followed by the velocities of all poses
(P, 6). Unknowns stand frame by frame, pose then velocity, and the border last.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.compile import kernel
from cadalign.solvers.joint.arrow import Arrow, empty_arrow
from cadalign.solvers.joint.covariance import JointCovariance, covariances_from, unbounded
from cadalign.solvers.joint.equations import JointEquations, joint_room, with_turns
from cadalign.solvers.joint.evidence import Evidence, State, packed, unpacked
from cadalign.solvers.joint.reduction import (
    reduce_modes,
    reduced_row,
    reduced_state,
    sighted_points,
    whole_state,
)
from cadalign.solvers.joint.search import has_latent
from cadalign.solvers.joint.system import Joint, evaluate_joint, move_joint
from cadalign.solvers.linalg import damp, expected_decrease
from cadalign.solvers.search import evaluate, move, refine, room_of, solve
from cadalign.solvers.tracks.chain import (
    STATE,
    Chain,
    clear_chain,
    copy_chain,
    empty_chain,
    factorize_chain,
    invert_chain,
    solve_chain,
)
from cadalign.solvers.tracks.motion import MotionPrior, add_motion, log_rotation, moments

_LEAST_SHARE = 1e-12  # of an unknown's information that the others must leave


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


class MovingEquations(NamedTuple):
    """Normal equations: those of the evidence, and the ``chain`` that they and the motion make.

    ``gradient`` is that of the chain; ``factor`` is for the damped one.
    """

    joint: JointEquations
    chain: Chain
    gradient: FloatArray
    factor: Chain


@kernel
def _velocities(system: Moving, row: FloatArray) -> FloatArray:
    frames = system.motion.seconds.shape[0] + 1
    return row[row.shape[0] - 6 * frames :].reshape((frames, 6))


@kernel
def _joint_part(system: Moving, row: FloatArray) -> FloatArray:
    return row[: row.shape[0] - 6 * (system.motion.seconds.shape[0] + 1)]


@room_of.of(Moving)
@kernel
def _room_of(system: Moving) -> tuple[MovingEquations, MovingEquations]:
    first, second = with_turns(joint_room(system.evidence))
    frames, size = first.arrow.blocks.shape[0], first.arrow.border.shape[0]
    factor, one, other = (
        empty_chain(frames, size),
        empty_chain(frames, size),
        empty_chain(frames, size),
    )
    return (
        MovingEquations(first, one, one.gradient, factor),
        MovingEquations(second, other, other.gradient, factor),
    )


@evaluate.of(Moving)
@kernel
def evaluate_moving(system: Moving, row: FloatArray, equations: MovingEquations) -> float:
    """Write the normal equations at a state; see `cadalign.solvers.search.evaluate`."""
    joint, chain = Joint(system.evidence, system.integrates), equations.chain
    cost = evaluate_joint(joint, _joint_part(system, row), equations.joint)
    if not cost < np.inf:
        return np.inf
    clear_chain(chain)
    _add_arrow(equations.joint.arrow, chain)
    state = unpacked(system.evidence, _joint_part(system, row))
    velocities = _velocities(system, row)
    cost += add_motion(system.motion, state.poses, velocities, chain)
    if system.motion.told > 0.0:
        cost += _add_volume(system, state, chain)
    if system.anchor.information.shape[0] > 0:
        cost += _add_anchor(system.anchor, state, velocities[0], chain)
    return cost


@kernel
def _add_volume(system: Moving, state: State, chain: Chain) -> float:
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
            chain.gradient[STATE * p + 3 + a] -= share * camera[6 + a] / depth
    return cost


@kernel
def _add_arrow(arrow: Arrow, chain: Chain) -> None:
    """Add the equations of the evidence."""
    frames, size = arrow.blocks.shape[0], arrow.border.shape[0]
    for p in range(frames):
        for k in range(6):
            chain.gradient[STATE * p + k] += arrow.gradient[6 * p + k]
            for m in range(6):
                chain.frames[p, k, m] += arrow.blocks[p, k, m]
            for m in range(size):
                chain.later[p, k, STATE + m] += arrow.coupling[p, k, m]
    chain.border[:] += arrow.border
    chain.gradient[STATE * frames :] += arrow.gradient[6 * frames :]


@kernel
def _add_anchor(anchor: Anchor, state: State, velocity: FloatArray, chain: Chain) -> float:
    """Add what is known of the first frame and the border; returns its cost."""
    size, last = anchor.border.shape[0], chain.gradient.shape[0] - anchor.border.shape[0]
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
    chain.gradient[:STATE] += slope[:STATE]
    chain.gradient[last:] += slope[STATE:]
    chain.frames[0] += anchor.information[:STATE, :STATE]
    chain.later[0, :, STATE:] += anchor.information[:STATE, STATE:]
    chain.border[:] += anchor.information[STATE:, STATE:]
    return float(((slope + anchor.gradient) * away).sum())


@solve.of(Moving)
@kernel
def _solve(system: Moving, equations: MovingEquations, damping: float, step: FloatArray) -> float:
    factor = equations.factor
    copy_chain(equations.chain, factor)
    damp(factor.frames, factor.border, damping)
    if not factorize_chain(factor):
        return np.nan
    solve_chain(factor, equations.gradient, step)
    return expected_decrease(equations.gradient, step, len(step))


@move.of(Moving)
@kernel
def _move(
    system: Moving,
    row: FloatArray,
    equations: MovingEquations,
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
        equations.joint,
        damping,
        own,
        _joint_part(system, moved_row),
    )


class Path(NamedTuple):
    """An estimate of a track: the joint ``state`` and the ``velocities`` (P, 6) of the body."""

    state: State
    velocities: FloatArray


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


def equations_of(system: Moving, path: Path) -> tuple[float, Chain]:
    """The cost and the normal equations at a path."""
    equations, _ = _room_of(system)
    return evaluate_moving(system, row_of(path), equations), equations.chain


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
    system = Moving(reduction.evidence, False, motion._replace(told=0.0), NOTHING_KNOWN)
    return _covariance_of(evidence, system, basis, row, sighted_points(evidence))


@kernel
def _covariance_of(
    evidence: Evidence, system: Moving, basis: FloatArray, row: FloatArray, sighted: BoolArray
) -> PathCovariance:
    equations, _ = _room_of(system)
    cost = evaluate_moving(system, row, equations)
    chain = equations.chain
    frames, size = chain.frames.shape[0], chain.border.shape[0]
    for p in range(frames):
        for k in range(STATE):
            chain.frames[p, k, k] *= 1.0 + _LEAST_SHARE
    for k in range(size):
        chain.border[k, k] *= 1.0 + _LEAST_SHARE
    if not factorize_chain(chain):
        nothing = np.full((frames, STATE, STATE), np.inf)
        unknown = np.full(2, np.inf)
        found = unbounded(evidence, frames)
        return PathCovariance(found, nothing, nothing, unknown, unknown, unknown)
    inverse = invert_chain(chain)
    arrow = empty_arrow(frames, size)
    for p in range(frames):
        arrow.blocks[p] = inverse.frames[p, :6, :6]
        arrow.coupling[p] = inverse.later[p, :6, STATE:]
    arrow.border[:] = inverse.border
    joint = _joint_part(system, row)
    found = covariances_from(
        evidence, system.evidence, basis, joint, equations.joint, arrow, sighted
    )
    poses = unpacked(system.evidence, joint).poses
    squares, variances = moments(system.motion, poses, _velocities(system, row), inverse)
    links = inverse.later[:, :, :STATE].copy()
    costs = np.array([cost - squares.sum(), squares.sum()])
    return PathCovariance(found, inverse.frames, links, squares, variances, costs)
