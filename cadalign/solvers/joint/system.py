"""The system of all unknowns: poses, focal lengths, scales and shape from all evidence.

Of one pose, the displacement d of a point, with the prior N(0, spread^2 I), is eliminated: its
equations ``r + J dx + D (e - d)``, with e the displacement to find, have the covariance
I + spread^2 D D' about ``r - D d + J dx``. Whitening them by its Cholesky factor leaves least
squares in x alone, and ``e = -spread^2 D' L^-T (whitened residual)`` follows. Of several poses,
displacements are modes (see `cadalign.solvers.joint.reduction`), so that poses have no products
with each other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import inlined, kernel
from cadalign.solvers.joint.arrow import (
    Arrow,
    add_products,
    clear,
    copy_arrow,
    damp,
    decide_on_undetermined,
    empty_arrow,
    factorize_arrow,
    hold,
    log_determinant,
    solve_arrow,
)
from cadalign.solvers.joint.blocks import add_blocks, first_scale
from cadalign.solvers.joint.evidence import Evidence, State, count_poses, unpacked
from cadalign.solvers.joint.rows import count_equations, write_rows
from cadalign.solvers.linalg import cholesky
from cadalign.solvers.system import (
    accept,
    are_same,
    cost_at,
    evaluate,
    is_estimate,
    move,
    room_of,
    score_of,
    solve,
)
from cadalign.solvers.unknowns import move_rigid, orthonormalize

_LARGEST_LOG_STEP = 1.0
_SAME_CHORD = 1e-3
_AT_BOUND = 1e-9


class Equations(NamedTuple):
    """Normal equations, those that steps are from and those evaluated last, and scratch space.

    The sightings of pose p are ``order[first[p]:first[p + 1]]``, point after point. ``rows`` and
    ``seen`` are those of `write_rows`; ``kept`` are the rows of one pose that belong to the current
    equations. ``log_determinant`` (1,) is that of the covariances by which eliminated displacements
    widened the equations.
    """

    current: Arrow
    new: Arrow
    factor: Arrow
    gradient: FloatArray
    order: IntArray
    first: IntArray
    rows: FloatArray
    kept: FloatArray
    seen: FloatArray
    products: FloatArray
    log_determinant: FloatArray


@room_of.of(Evidence)
@kernel
def joint_room(evidence: Evidence) -> Equations:
    """Room for the normal equations."""
    sightings, rig = evidence.sightings, evidence.rig
    poses = count_poses(evidence)
    border = evidence.focals.low.shape[0] + 3 + evidence.shape.modes.shape[0]
    count = sightings.point.shape[0]
    points = evidence.shape.mean.shape[0]
    order = np.argsort(rig.pose[sightings.image] * points + sightings.point, kind="mergesort")
    first = np.zeros(poses + 1, dtype=np.int64)
    columns = np.zeros(poses, dtype=np.int64)
    for n in range(count):
        p = rig.pose[sightings.image[n]]
        first[p + 1] += 1
        columns[p] += count_equations(sightings, n)
    for p in range(poses):
        first[p + 1] += first[p]
    most = columns.max()
    current = empty_arrow(poses, border)
    rows = np.zeros((6 + border + 4, most))
    return Equations(
        current,
        empty_arrow(poses, border),
        empty_arrow(poses, border),
        current.gradient,
        order,
        first,
        rows,
        rows.copy() if poses == 1 else np.zeros((0, 0)),
        np.zeros((7, most)),
        np.zeros((7 + border, 7 + border)),
        np.zeros(1),
    )


@evaluate.of(Evidence)
@kernel
def evaluate_joint(evidence: Evidence, row: FloatArray, equations: Equations) -> float:
    """Write the normal equations at a state; see `cadalign.solvers.system.evaluate`."""
    state, new = unpacked(evidence, row), equations.new
    poses = state.poses.shape[0]
    clear(new)
    equations.log_determinant[0] = 0.0
    cost = 0.0
    for p in range(poses):
        chosen = equations.order[equations.first[p] : equations.first[p + 1]]
        part = write_rows(evidence, state, chosen, equations.rows, equations.seen)
        if not part < np.inf:
            return np.inf
        cost += part
        columns = 0
        for n in chosen:
            columns += count_equations(evidence.sightings, n)
        if poses == 1:
            cost += _eliminate(evidence, state, equations)
        add_products(new, p, equations.rows, columns, equations.products)
    cost += add_blocks(evidence, state, new)
    for a in range(3):
        if evidence.scales.free[a] == 0.0:
            hold(new, first_scale(evidence) + a)
    _hold_at_bounds(evidence, state, new)
    return cost


@inlined
def _hold_at_bounds(evidence: Evidence, state: State, arrow: Arrow) -> None:
    """Hold focal lengths where they would leave their bounds."""
    focals = evidence.focals
    for f in range(focals.low.shape[0]):
        downhill = -arrow.gradient[6 * arrow.blocks.shape[0] + f]
        value = state.log_focals[f]
        if (value <= focals.low[f] + _AT_BOUND and downhill < 0.0) or (
            value >= focals.high[f] - _AT_BOUND and downhill > 0.0
        ):
            hold(arrow, f)


@kernel
def _eliminate(evidence: Evidence, state: State, equations: Equations) -> float:
    """Whiten the equations of points with displacements; returns the cost of their prior."""
    spread, sightings, rows = evidence.shape.spread, evidence.sightings, equations.rows
    last = rows.shape[0] - 4
    cost = 0.0
    order = equations.order
    column = n = 0
    while n < order.shape[0]:
        i = sightings.point[order[n]]
        start = column
        while n < order.shape[0] and sightings.point[order[n]] == i:
            column += count_equations(sightings, order[n])
            n += 1
        if not spread[i] > 0:
            continue
        for a in range(3):
            displacement = state.displacements[i, a]
            cost += (displacement / spread[i]) ** 2
            for c in range(start, column):
                rows[last, c] -= rows[last + 1 + a, c] * displacement
        equations.log_determinant[0] += _whiten(
            rows, start, column, spread[i], np.empty((column - start, column - start))
        )
    return cost


@kernel
def _whiten(rows: FloatArray, start: int, end: int, spread: float, factor: FloatArray) -> float:
    """Whiten the columns of one point; returns the log determinant of their covariance."""
    size = end - start
    last = rows.shape[0] - 3
    for p in range(size):
        for q in range(p + 1):
            total = 1.0 if p == q else 0.0
            for a in range(last, last + 3):
                total += spread * spread * rows[a, start + p] * rows[a, start + q]
            factor[p, q] = total
    cholesky(factor, size, 0.0)
    log_determinant = 0.0
    for p in range(size):
        log_determinant += 2.0 * np.log(factor[p, p])
        factor[p, p] = 1.0 / factor[p, p]
    for k in range(rows.shape[0]):
        for p in range(size):
            total = rows[k, start + p]
            for q in range(p):
                total -= factor[p, q] * rows[k, start + q]
            rows[k, start + p] = total * factor[p, p]
    return log_determinant


@cost_at.of(Evidence)
@kernel
def joint_cost(evidence: Evidence, row: FloatArray) -> float:
    """The cost at a state."""
    return evaluate_joint(evidence, row, joint_room(evidence))


@accept.of(Evidence)
@kernel
def _accept(evidence: Evidence, row: FloatArray, equations: Equations) -> None:
    copy_arrow(equations.new, equations.current)
    for k in range(equations.kept.shape[0]):
        for c in range(equations.kept.shape[1]):
            equations.kept[k, c] = equations.rows[k, c]
    state = unpacked(evidence, row)
    for p in range(state.poses.shape[0]):
        orthonormalize(state.poses[p])


@solve.of(Evidence)
@kernel
def _solve(evidence: Evidence, equations: Equations, damping: float, step: FloatArray) -> float:
    factor = equations.factor
    copy_arrow(equations.current, factor)
    damp(factor, damping)
    if not factorize_arrow(factor):
        return np.nan
    solve_arrow(factor, equations.gradient, step)
    expected = 0.0
    for k in range(step.shape[0]):
        expected -= equations.gradient[k] * step[k]
    return expected


@move.of(Evidence)
@kernel
def _move(
    evidence: Evidence,
    row: FloatArray,
    equations: Equations,
    damping: float,
    step: FloatArray,
    moved_row: FloatArray,
) -> None:
    state, moved = unpacked(evidence, row), unpacked(evidence, moved_row)
    poses, focals = state.poses.shape[0], state.log_focals.shape[0]
    for p in range(poses):
        move_rigid(state.poses[p], step[6 * p : 6 * p + 6], moved.poses[p])
    first = 6 * poses
    for f in range(focals):
        value = state.log_focals[f] + _bounded(step[first + f])
        moved.log_focals[f] = min(max(value, evidence.focals.low[f]), evidence.focals.high[f])
    first += focals
    for a in range(3):
        moved.log_scales[a] = state.log_scales[a] + _bounded(step[first + a])
    for k in range(state.coefficients.shape[0]):
        moved.coefficients[k] = state.coefficients[k] + step[first + 3 + k]
    for i in range(state.displacements.shape[0]):
        for a in range(3):
            moved.displacements[i, a] = state.displacements[i, a]
    if poses == 1:
        _follow(evidence, equations, step, moved)


@inlined
def _bounded(log_step: float) -> float:
    return min(max(log_step, -_LARGEST_LOG_STEP), _LARGEST_LOG_STEP)


@kernel
def _follow(evidence: Evidence, equations: Equations, step: FloatArray, moved: State) -> None:
    """Write the displacements that are best after a step."""
    sightings, rows, order = evidence.sightings, equations.kept, equations.order
    unknowns = step.shape[0]
    column = n = 0
    while n < order.shape[0]:
        i = sightings.point[order[n]]
        start = column
        while n < order.shape[0] and sightings.point[order[n]] == i:
            column += count_equations(sightings, order[n])
            n += 1
        if not evidence.shape.spread[i] > 0:
            continue
        for a in range(3):
            moved.displacements[i, a] = 0.0
        for c in range(start, column):
            residual = rows[unknowns, c]
            for k in range(unknowns):
                residual += rows[k, c] * step[k]
            residual *= -(evidence.shape.spread[i] ** 2)
            for a in range(3):
                moved.displacements[i, a] += residual * rows[unknowns + 1 + a, c]


@score_of.of(Evidence)
@kernel
def joint_score(evidence: Evidence, row: FloatArray, cost: float) -> float:
    """-2 log of the evidence by Laplace's approximation; infinite where it is not determined."""
    equations = joint_room(evidence)
    cost = evaluate_joint(evidence, row, equations)
    if not cost < np.inf:
        return np.inf
    decide_on_undetermined(equations.new, equations.new.blocks.shape[0])
    if not factorize_arrow(equations.new):
        return np.inf
    return float(cost + log_determinant(equations.new) + equations.log_determinant[0])


@are_same.of(Evidence)
@kernel
def _are_same(evidence: Evidence, first_row: FloatArray, second_row: FloatArray) -> bool:
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


@is_estimate.of(Evidence)
@inlined
def _is_estimate(evidence: Evidence, row: FloatArray) -> bool:
    return True
