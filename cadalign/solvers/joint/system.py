"""The system of all unknowns: poses, focal lengths, scales and shape from all evidence.

With one pose, displacements of points are eliminated (see `cadalign.solvers.joint.equations`); with
several, they are modes (see `cadalign.solvers.joint.search`), so that poses have no products
with each other. What is integrated out, coefficients and displacements, leaves its log determinant
in the objective (see `cadalign.solvers.joint.equations`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import inlined, kernel
from cadalign.solvers.evidence import score_of_distance, whole_information
from cadalign.solvers.joint.arrow import (
    Arrow,
    add_rows,
    border_start,
    clear,
    copy_matrix,
    decide_on_undetermined,
    factorize_arrow,
    hold,
    log_determinant,
    solve_arrow,
)
from cadalign.solvers.joint.equations import (
    JointEquations,
    add_log_determinant,
    eliminate,
    follow,
    joint_room,
    shift_means,
)
from cadalign.solvers.joint.evidence import Evidence, State, exp_of, stretched_point, unpacked
from cadalign.solvers.joint.rows import (
    add_blocks,
    bounded_scales,
    count_equations,
    first_scale,
    write_rows,
)
from cadalign.solvers.linalg import damp, expected_decrease
from cadalign.solvers.projection import shift, turn
from cadalign.solvers.search import (
    are_same,
    cost_at,
    evaluate,
    integrating,
    move,
    room_of,
    score_of,
    solve,
)
from cadalign.solvers.unknowns import leaves_bounds, move_rigid, orthonormalize

_LARGEST_LOG_STEP = 1.0
_SAME_CHORD = 1e-3


class Joint(NamedTuple):
    """All evidence; with ``integrates`` the shape is integrated out of the objective."""

    evidence: Evidence
    integrates: bool


@integrating.of(Joint)
@kernel
def _integrating(system: Joint, integrates: bool) -> Joint:
    return Joint(system.evidence, integrates)


@room_of.of(Joint)
@kernel
def _room_of(system: Joint) -> tuple[JointEquations, JointEquations]:
    return joint_room(system.evidence), joint_room(system.evidence)


@evaluate.of(Joint)
@kernel
def evaluate_joint(system: Joint, row: FloatArray, equations: JointEquations) -> float:
    """Write the normal equations at a state; see `cadalign.solvers.search.evaluate`."""
    evidence, arrow = system.evidence, equations.arrow
    state = unpacked(evidence, row)
    poses = state.poses.shape[0]
    clear(arrow)
    equations.log_determinant[0] = 0.0
    equations.slopes[:] = 0.0
    cost = 0.0
    seen = 0
    for p in range(poses):
        chosen = equations.order[equations.first[p] : equations.first[p + 1]]
        part = write_rows(evidence, state, chosen, equations.rows, equations.seen, seen)
        if not part < np.inf:
            return np.inf
        cost += part
        columns = 0
        for n in chosen:
            columns += count_equations(evidence.sightings, n)
        seen += columns
        if poses == 1:
            cost += eliminate(evidence, state, equations)
        add_rows(arrow, p, equations.rows, columns, equations.products)
    cost += add_blocks(evidence, state, arrow)
    if system.integrates:
        volume = add_log_determinant(evidence, state, equations)
        if not volume < np.inf:
            return np.inf
        cost += volume + equations.log_determinant[0]
        if poses == 1:
            shift_means(evidence, equations)
    for a in range(3):
        if evidence.scales.free[a] == 0.0:
            hold(arrow, first_scale(evidence) + a)
    focals = evidence.focals
    for f in range(focals.low.shape[0]):
        slope = arrow.gradient[border_start(arrow) + f]
        if leaves_bounds(state.log_focals[f], focals.low[f], focals.high[f], slope):
            hold(arrow, f)
    return cost


@cost_at.of(Joint)
@kernel
def _cost_at(system: Joint, row: FloatArray) -> float:
    return evaluate_joint(system, row, joint_room(system.evidence))


def joint_cost(system: Joint, row: FloatArray) -> float:
    """The cost at a state; not one kernel, since `evaluate_joint` takes long to compile."""
    return evaluate_joint(system, row, joint_room(system.evidence))


@solve.of(Joint)
@kernel
def _solve(system: Any, equations: JointEquations, damping: float, step: FloatArray) -> float:
    """Write the damped step; see `cadalign.solvers.search.solve`."""
    factor = equations.factor
    copy_matrix(equations.arrow, factor)
    damp(factor.blocks, factor.border, damping)
    if not factorize_arrow(factor):
        return np.nan
    solve_arrow(factor, equations.gradient, step)
    return expected_decrease(equations.gradient, step, len(step))


@move.of(Joint)
@kernel
def _move(
    system: Joint,
    row: FloatArray,
    equations: JointEquations,
    damping: float,
    step: FloatArray,
    moved_row: FloatArray,
) -> None:
    """Write the state that a step leads to; see `cadalign.solvers.search.move`."""
    evidence = system.evidence
    state, moved = unpacked(evidence, row), unpacked(evidence, moved_row)
    poses, focals = state.poses.shape[0], state.log_focals.shape[0]
    for p in range(poses):
        move_rigid(state.poses[p], step[6 * p : 6 * p + 6], moved.poses[p])
        orthonormalize(moved.poses[p])
    first = 6 * poses
    for f in range(focals):
        value = state.log_focals[f] + _bounded(step[first + f])
        moved.log_focals[f] = min(max(value, evidence.focals.low[f]), evidence.focals.high[f])
    if evidence.rig.pose.shape[0] == poses:
        _follow_focals(evidence, state, step[first:], moved)
    first += focals
    for a in range(3):
        moved.log_scales[a] = state.log_scales[a] + _bounded(step[first + a])
    for k in range(state.coefficients.shape[0]):
        moved.coefficients[k] = state.coefficients[k] + step[first + 3 + k]
    for i in range(state.displacements.shape[0]):
        for a in range(3):
            moved.displacements[i, a] = state.displacements[i, a]
    if poses == 1:
        follow(evidence, equations, step, moved)


@inlined
def _follow_focals(evidence: Evidence, state: State, log_steps: FloatArray, moved: State) -> None:
    """Let the distance of every view follow its focal length.

    A longer lens and a larger distance give nearly the same image: along the curve on which both
    grow by one factor the cost hardly changes, and steps can be long.
    """
    for v in range(evidence.rig.pose.shape[0]):
        p, f = evidence.rig.pose[v], evidence.focals.group[v]
        if f >= 0:
            factor = np.exp(moved.log_focals[f] - state.log_focals[f])
            along = moved.poses[p, 11] - state.poses[p, 11] * log_steps[f]
            moved.poses[p, 11] = along * factor


@inlined
def _bounded(log_step: float) -> float:
    return min(max(log_step, -_LARGEST_LOG_STEP), _LARGEST_LOG_STEP)


@score_of.of(Joint)
@kernel
def _score_of(system: Joint, row: FloatArray, cost: float) -> float:
    equations = joint_room(system.evidence)
    cost = evaluate_joint(Joint(system.evidence, False), row, equations)
    return _score_from(system.evidence, row, cost, equations)


def joint_score(evidence: Evidence, row: FloatArray) -> float:
    """-2 log of the evidence by Laplace's approximation; infinite where it is not determined."""
    equations = joint_room(evidence)
    cost = evaluate_joint(Joint(evidence, False), row, equations)
    return _score_from(evidence, row, cost, equations)


@kernel
def _score_from(
    evidence: Evidence, row: FloatArray, cost: float, equations: JointEquations
) -> float:
    if not cost < np.inf:
        return np.inf
    decide_on_undetermined(equations.arrow, equations.arrow.blocks.shape[0] > 1)
    _bound_volume(evidence, equations.arrow)
    if not factorize_arrow(equations.arrow):
        return np.inf
    score = cost + log_determinant(equations.arrow) + equations.log_determinant[0]
    return float(score + _score_of_distances(evidence, unpacked(evidence, row)))


@kernel
def _bound_volume(evidence: Evidence, arrow: Arrow) -> None:
    """Add the information of a prior that is flat at the estimate: no volume exceeds its own."""
    bound, first = evidence.scales.bound, first_scale(evidence)
    if bound.weight > 0.0:
        rows = bounded_scales(evidence)
        for a in range(3):
            for b in range(3):
                for c in range(3):
                    share = rows[a, b] * rows[a, c]
                    arrow.border[first + b, first + c] += share * whole_information(bound)


@kernel
def _score_of_distances(evidence: Evidence, state: State) -> float:
    """-2 log of the prior of the translations: `score_of_distance` of the sightings' mean one."""
    sightings, rig, scale = evidence.sightings, evidence.rig, exp_of(state.log_scales)
    poses = state.poses.shape[0]
    totals, counts = np.zeros(poses), np.zeros(poses)
    for n in range(sightings.point.shape[0]):
        p = rig.pose[sightings.image[n]]
        camera, motion = rig.cam_from_rig[sightings.image[n]], state.poses[p]
        point = stretched_point(evidence.shape, state, scale, sightings.point[n])
        in_rig = shift(motion, turn(motion, point))
        totals[p] += shift(camera, turn(camera, in_rig))[2]
        counts[p] += 1.0
    score = 0.0
    for p in range(poses):
        if counts[p] > 0.0:
            score += score_of_distance(totals[p] / counts[p])
    return score


@are_same.of(Joint)
@kernel
def _are_same(system: Joint, first_row: FloatArray, second_row: FloatArray) -> bool:
    evidence = system.evidence
    first, second = unpacked(evidence, first_row), unpacked(evidence, second_row)
    square = 0.0
    for p in range(first.poses.shape[0]):
        for i in range(9):
            square += (first.poses[p, i] - second.poses[p, i]) ** 2
    for a in range(3):
        square += (first.log_scales[a] - second.log_scales[a]) ** 2
    for f in range(first.log_focals.shape[0]):
        square += (first.log_focals[f] - second.log_focals[f]) ** 2
    return square < _SAME_CHORD * _SAME_CHORD
