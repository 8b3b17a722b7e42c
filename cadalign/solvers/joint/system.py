"""The joint system: poses, focal lengths, scales and shape from all evidence.

With one pose, `cadalign.solvers.joint.equations` eliminates displacements. With several, they are
modes (`cadalign.solvers.joint.search`), so that different poses have no products with each other.
Integrating out coefficients and displacements adds their log determinant to the objective.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import inline, kernel
from cadalign.solvers.evidence import score_of_distance, whole_information
from cadalign.solvers.joint.arrow import (
    add_rows,
    border_start,
    clear,
    factorize_arrow,
    fix_unknown,
    log_determinant,
    perturb_diagonal,
    solve_arrow,
)
from cadalign.solvers.joint.equations import (
    JointEquations,
    Layout,
    add_log_determinant,
    eliminate_displacements,
    empty_joint_equations,
    layout_of,
    shift_means,
    update_displacements,
)
from cadalign.solvers.joint.evidence import (
    Evidence,
    ScalePriors,
    State,
    exp_triple,
    stretched_point,
    unpack_state,
)
from cadalign.solvers.joint.rows import add_blocks, bounded_scales, write_rows
from cadalign.solvers.linalg import copy_into, damp, expected_decrease
from cadalign.solvers.projection import shift, turn
from cadalign.solvers.search import (
    Effort,
    Minima,
    allocate,
    are_same,
    cost_at,
    empty_minima,
    evaluate,
    move,
    refine_integrated,
    score_of,
    search,
    solve,
)
from cadalign.solvers.unknowns import move_rigid, orthonormalize

_LARGEST_LOG_STEP = 1.0
_SAME_CHORD = 1e-3
_AT_BOUND = 1e-9  # distance of a log focal length to its bound
_FEW_ITERATIONS = 3  # on the plain cost, before the shape is integrated out
_LESS_LIKELY = 20.0  # excess score at which a start is dropped


class Joint(NamedTuple):
    """All evidence; ``integrates`` is True if the objective has the shape integrated out."""

    evidence: Evidence
    layout: Layout
    integrates: bool


def joint_system(evidence: Evidence, *, integrates: bool) -> Joint:
    return Joint(evidence, layout_of(evidence), integrates)


@allocate.of(Joint)
@kernel
def _allocate(system: Joint) -> tuple[JointEquations, JointEquations]:
    evidence, layout = system.evidence, system.layout
    return empty_joint_equations(evidence, layout), empty_joint_equations(evidence, layout)


@evaluate.of(Joint)
@kernel
def evaluate_joint(system: Joint, row: FloatArray, equations: JointEquations) -> float:
    """Write the normal equations at a state; see `cadalign.solvers.search.evaluate`."""
    evidence, arrow, layout = system.evidence, equations.arrow, system.layout
    first = evidence.focals.low.shape[0]
    state = unpack_state(evidence.shape, first, row)
    poses = state.poses.shape[0]
    clear(arrow)
    equations.log_determinant[0] = 0.0
    equations.slopes[:] = 0.0
    cost = 0.0
    seen = 0
    for p in range(poses):
        chosen = layout.order[layout.first[p] : layout.first[p + 1]]
        part = write_rows(evidence, state, chosen, equations.rows, equations.seen, seen)
        if not part < np.inf:
            return np.inf
        cost += part
        columns = 0
        for n in chosen:
            columns += layout.widths[n]
        seen += columns
        if poses == 1:
            cost += eliminate_displacements(evidence.shape.spread, state.displacements, equations)
        add_rows(arrow, p, equations.rows, columns, equations.products)
    cost += add_blocks(evidence, state, arrow, equations.products)
    if system.integrates:
        volume = add_log_determinant(evidence, state, equations)
        if not volume < np.inf:
            return np.inf
        cost += volume + equations.log_determinant[0]
        if poses == 1:
            shift_means(evidence.shape.spread, equations)
    for a in range(3):
        if evidence.scales.free[a] == 0.0:
            fix_unknown(arrow, first + a)
    focals = evidence.focals
    for f in range(focals.low.shape[0]):
        slope = arrow.gradient[border_start(arrow) + f]
        is_low = state.log_focals[f] <= focals.low[f] + _AT_BOUND
        is_high = state.log_focals[f] >= focals.high[f] - _AT_BOUND
        if (is_low and slope > 0.0) or (is_high and slope < 0.0):
            fix_unknown(arrow, f)
    return cost


@cost_at.of(Joint)
@kernel
def _cost_at(system: Joint, row: FloatArray) -> float:
    return evaluate_joint(system, row, empty_joint_equations(system.evidence, system.layout))


@solve.of(Joint)
@kernel
def _solve(system: Any, equations: JointEquations, damping: float, step: FloatArray) -> float:
    factor, arrow = equations.factor, equations.arrow
    copy_into(factor.blocks.ravel(), arrow.blocks.ravel())
    copy_into(factor.coupling.ravel(), arrow.coupling.ravel())
    copy_into(factor.border.ravel(), arrow.border.ravel())
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
    evidence = system.evidence
    shape, focals = evidence.shape, evidence.focals.low.shape[0]
    state, moved = unpack_state(shape, focals, row), unpack_state(shape, focals, moved_row)
    poses = state.poses.shape[0]
    for p in range(poses):
        move_rigid(state.poses[p], step[6 * p : 6 * p + 6], moved.poses[p])
        orthonormalize(moved.poses[p])
    first = 6 * poses
    for f in range(focals):
        value = state.log_focals[f] + _bound_step(step[first + f])
        moved.log_focals[f] = min(max(value, evidence.focals.low[f]), evidence.focals.high[f])
    if evidence.rig.pose.shape[0] == poses:
        _follow_focals(evidence, state, step[first:], moved)
    first += focals
    for a in range(3):
        moved.log_scales[a] = state.log_scales[a] + _bound_step(step[first + a])
    for k in range(state.coefficients.shape[0]):
        moved.coefficients[k] = state.coefficients[k] + step[first + 3 + k]
    for i in range(state.displacements.shape[0]):
        for a in range(3):
            moved.displacements[i, a] = state.displacements[i, a]
    if poses == 1:
        update_displacements(evidence.shape.spread, equations, step, moved.displacements)


@inline
def _follow_focals(evidence: Evidence, state: State, log_steps: FloatArray, moved: State) -> None:
    """Scale distances with focal lengths: the cost hardly changes along this direction."""
    for v in range(evidence.rig.pose.shape[0]):
        p, f = evidence.rig.pose[v], evidence.focals.group[v]
        if f >= 0:
            factor = np.exp(moved.log_focals[f] - state.log_focals[f])
            along = moved.poses[p, 11] - state.poses[p, 11] * log_steps[f]
            moved.poses[p, 11] = along * factor


@inline
def _bound_step(log_step: float) -> float:
    return min(max(log_step, -_LARGEST_LOG_STEP), _LARGEST_LOG_STEP)


@score_of.of(Joint)
@kernel
def _score_of(system: Joint, row: FloatArray, cost: float) -> float:
    evidence, layout = system.evidence, system.layout
    equations = empty_joint_equations(evidence, layout)
    cost, arrow = evaluate_joint(Joint(evidence, layout, False), row, equations), equations.arrow
    if not cost < np.inf:
        return np.inf
    perturb_diagonal(arrow, arrow.blocks.shape[0] > 1)
    first = evidence.focals.low.shape[0]
    _bound_volume(evidence.scales, arrow.border[first:, first:])
    if not factorize_arrow(arrow):
        return np.inf
    score = cost + log_determinant(arrow) + equations.log_determinant[0]
    return float(score + _score_of_distances(evidence, unpack_state(evidence.shape, first, row)))


@kernel
def _bound_volume(scales: ScalePriors, information: FloatArray) -> None:
    """Add the information of the whole bound, so that no volume exceeds the prior's."""
    if scales.bound.weight > 0.0:
        rows, whole = bounded_scales(scales.free), whole_information(scales.bound)
        for a in range(3):
            for b in range(3):
                for c in range(3):
                    information[b, c] += rows[a, b] * rows[a, c] * whole


@kernel
def _score_of_distances(evidence: Evidence, state: State) -> float:
    """-2 log prior of the translations: `score_of_distance` at the mean depth of sightings."""
    sightings, rig, scale = evidence.sightings, evidence.rig, exp_triple(state.log_scales)
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
    shape, focals = system.evidence.shape, system.evidence.focals.low.shape[0]
    first, second = unpack_state(shape, focals, first_row), unpack_state(shape, focals, second_row)
    square = 0.0
    for p in range(first.poses.shape[0]):
        for i in range(9):
            square += (first.poses[p, i] - second.poses[p, i]) ** 2
    for a in range(3):
        square += (first.log_scales[a] - second.log_scales[a]) ** 2
    for f in range(first.log_focals.shape[0]):
        square += (first.log_focals[f] - second.log_focals[f]) ** 2
    return square < _SAME_CHORD * _SAME_CHORD


@kernel
def run_joint(system: Joint, starts: FloatArray, effort: Effort) -> tuple[Minima, JointEquations]:
    """Search from starts (S, D); with ``effort.starts`` 0, evaluate costs and the last equations.

    One kernel does both, to compile the equations only once. If the shape is integrated out, a few
    steps on the plain cost select promising starts; ``costs`` of the minima are plain ones.
    """
    plain = Joint(system.evidence, system.layout, False)
    integrates, size = system.integrates, starts.shape[1]
    equations = empty_joint_equations(system.evidence, system.layout)
    minima = empty_minima(effort.starts if effort.starts > 0 else starts.shape[0], size)
    if effort.starts == 0:
        for s in range(starts.shape[0]):
            minima.costs[s] = evaluate_joint(system, starts[s], equations)
    elif integrates and effort.iterations > 0:
        likely = empty_minima(effort.starts, size)
        few = Effort(effort.starts, _FEW_ITERATIONS, 0, effort.unlikely)
        search(plain, starts, few, 0, 0.0, likely)
        minima.counts[1] = likely.counts[1]
        refine_integrated(plain, system, likely, effort.iterations, _LESS_LIKELY, 0, 0.0, minima)
    else:
        search(system, starts, effort, 0, 0.0, minima)
        for k in range(minima.counts[0] if integrates else 0):
            minima.costs[k] = cost_at(plain, minima.states[k])
    return minima, equations
