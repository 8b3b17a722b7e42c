"""The system of all unknowns: poses, focal lengths, scales and shape from all evidence.

Of one pose, the displacement d of a point, with the prior N(0, spread^2 I), is eliminated: its
equations ``r + J dx + D (e - d)``, with e the displacement to find, have the covariance
I + spread^2 D D' about ``r - D d + J dx``. Whitening them by its Cholesky factor leaves least
squares in x alone, and ``e = -spread^2 D' L^-T (whitened residual)`` follows. Of several poses,
displacements are modes (see `cadalign.solvers.joint.reduction`), so that poses have no products
with each other.

What is integrated out, coefficients and displacements, leaves its log determinant in the objective;
see `add_log_determinant`.
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
from cadalign.solvers.joint.evidence import Evidence, State, count_poses, unpacked, unstretched
from cadalign.solvers.joint.rows import count_equations, write_rows
from cadalign.solvers.linalg import cholesky, factorize, invert_factor
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
from cadalign.solvers.unknowns import leaves_bounds, move_rigid, orthonormalize

_LARGEST_LOG_STEP = 1.0
_SAME_CHORD = 1e-3


class Joint(NamedTuple):
    """All evidence; with ``integrates`` the shape is integrated out of the objective."""

    evidence: Evidence
    integrates: bool


class JointEquations(NamedTuple):
    """Normal equations, those that steps are from and those evaluated last, and scratch space.

    The sightings of pose p are ``order[first[p]:first[p + 1]]``, point after point. ``rows`` and
    ``seen`` are those of `write_rows`; ``kept`` are the rows of one pose that belong to the current
    equations. ``log_determinant`` (1,) is that of the covariances by which eliminated displacements
    widened the equations; ``slopes`` (m, 3) are half the derivatives of the log determinant by the
    points before the stretch, of the equations evaluated last and of the current ones.
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
    new_slopes: FloatArray
    slopes: FloatArray


@room_of.of(Joint)
@kernel
def joint_room(system: Joint) -> JointEquations:
    """Room for the normal equations."""
    evidence = system.evidence
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
    most, total = columns.max(), columns.sum()
    current = empty_arrow(poses, border)
    rows = np.zeros((6 + border + 4, most))
    return JointEquations(
        current,
        empty_arrow(poses, border),
        empty_arrow(poses, border),
        current.gradient,
        order,
        first,
        rows,
        rows.copy() if poses == 1 else np.zeros((0, 0)),
        np.zeros((6, total)),
        np.zeros((7 + border, 7 + border)),
        np.zeros(1),
        np.zeros((points, 3)),
        np.zeros((points, 3)),
    )


@evaluate.of(Joint)
@kernel
def evaluate_joint(system: Joint, row: FloatArray, equations: JointEquations) -> float:
    """Write the normal equations at a state; see `cadalign.solvers.system.evaluate`."""
    evidence = system.evidence
    state, new = unpacked(evidence, row), equations.new
    poses = state.poses.shape[0]
    clear(new)
    equations.log_determinant[0] = 0.0
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
            cost += _eliminate(evidence, state, equations)
        add_products(new, p, equations.rows, columns, equations.products)
    cost += add_blocks(evidence, state, new)
    if system.integrates:
        volume = add_log_determinant(evidence, state, equations)
        if not volume < np.inf:
            return np.inf
        cost += volume + equations.log_determinant[0]
    for a in range(3):
        if evidence.scales.free[a] == 0.0:
            hold(new, first_scale(evidence) + a)
    _hold_at_bounds(evidence, state, new)
    return cost


@kernel
def add_log_determinant(evidence: Evidence, state: State, equations: JointEquations) -> float:
    """Add half the derivative of the log determinant; returns that of the coefficients.

    With the equations ``r + A z`` of the coefficients and displacements z, whose prior is standard
    normal, it is that of M = I + A A', and its derivative is ``2 tr(dA P A')``, P the covariance of
    z given the rest. Row q of A touches only the point i that it is of: with ``y_q = P_i a_q`` the
    response of this point in the rig's frame, a_q the row there, and d the camera's z over the
    depth, half the derivative by the point is

        h_q = -((a_q . y_q) d + (d . y_q) a_q),

    and that by a turn ``X_i x h_q + y_q x a_q``; stretch and focal length scale the rows as well.
    """
    shape, sightings, rig = evidence.shape, evidence.sightings, evidence.rig
    new, seen, slopes = equations.new, equations.seen, equations.new_slopes
    first, modes = first_scale(evidence), shape.modes.shape[0]
    start = 6 * new.blocks.shape[0] + first
    one_pose = new.blocks.shape[0] == 1
    slopes[:] = 0.0
    factor = new.border[first + 3 :, first + 3 :].copy()
    if not factorize(factor):
        return np.inf
    volume = 0.0
    for k in range(modes):
        volume += 2.0 * np.log(factor[k, k])
    covariance = np.zeros((modes, modes))
    if modes > 0:
        triangle = invert_factor(factor)
        covariance = triangle.T @ triangle
    scale = np.exp(state.log_scales)
    point, posterior = np.empty(3), np.zeros((3, 3))
    a, d, y, h, model = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    column = last = -1
    column = 0
    for index in range(equations.order.shape[0]):
        n = equations.order[index]
        i, v = sightings.point[n], sightings.image[n]
        p = rig.pose[v]
        pose = state.poses[p]
        if i != last:
            _posterior_of_point(evidence, equations, covariance, one_pose, index, column, posterior)
            last = i
        for r in range(3):
            point[r] = 0.0
            for c in range(3):
                point[r] += pose[3 * r + c] * scale[c] * unstretched(shape, state, i, c)
        for _ in range(count_equations(sightings, n)):
            for r in range(3):
                a[r], d[r] = seen[r, column], seen[3 + r, column]
            for c in range(3):  # the row before the stretch
                model[c] = scale[c] * (a[0] * pose[c] + a[1] * pose[3 + c] + a[2] * pose[6 + c])
            for r in range(3):
                y[r] = 0.0
            along = 0.0
            for c in range(3):
                response = 0.0
                for b in range(3):
                    response += posterior[c, b] * model[b]
                along += response * model[c]
                new.gradient[start + c] += response * model[c]
                for r in range(3):
                    y[r] += pose[3 * r + c] * scale[c] * response
            farther = d[0] * y[0] + d[1] * y[1] + d[2] * y[2]
            for r in range(3):
                h[r] = -(along * d[r] + farther * a[r])
                new.gradient[6 * p + 3 + r] += h[r]
            new.gradient[6 * p] += point[1] * h[2] - point[2] * h[1] + y[1] * a[2] - y[2] * a[1]
            new.gradient[6 * p + 1] += point[2] * h[0] - point[0] * h[2] + y[2] * a[0] - y[0] * a[2]
            new.gradient[6 * p + 2] += point[0] * h[1] - point[1] * h[0] + y[0] * a[1] - y[1] * a[0]
            if evidence.focals.group[v] >= 0 and (d[0] != 0.0 or d[1] != 0.0 or d[2] != 0.0):
                new.gradient[start - first + evidence.focals.group[v]] += along
            for c in range(3):
                slope = scale[c] * (h[0] * pose[c] + h[1] * pose[3 + c] + h[2] * pose[6 + c])
                new.gradient[start + c] += slope * unstretched(shape, state, i, c)
                slopes[i, c] += slope
                for k in range(modes):
                    new.gradient[start + 3 + k] += slope * shape.modes[k, i, c]
            column += 1
    if one_pose:
        _shift_displacements(evidence, equations)
    return volume


@kernel
def _posterior_of_point(
    evidence: Evidence,
    equations: JointEquations,
    covariance: FloatArray,
    one_pose: bool,
    index: int,
    column: int,
    posterior: FloatArray,
) -> None:
    """Write the covariance (3, 3) of a point before the stretch, given all but the shape.

    ``covariance`` is that of the coefficients; the point's sightings begin at ``index`` and their
    equations at ``column``.
    """
    shape, sightings, rows = evidence.shape, evidence.sightings, equations.rows
    i = sightings.point[equations.order[index]]
    own, left = np.zeros((3, 3)), np.eye(3)
    square = shape.spread[i] ** 2
    if one_pose and square > 0.0:
        last = rows.shape[0] - 3
        while index < equations.order.shape[0]:
            n = equations.order[index]
            if sightings.point[n] != i:
                break
            for _ in range(count_equations(sightings, n)):
                for r in range(3):
                    for c in range(3):
                        left[r, c] -= square * rows[last + r, column] * rows[last + c, column]
                column += 1
            index += 1
        for r in range(3):
            for c in range(3):
                own[r, c] = square * left[r, c]
    modes = shape.modes.shape[0]
    moved = np.empty((3, modes))
    for r in range(3):
        for k in range(modes):
            moved[r, k] = (
                left[r, 0] * shape.modes[k, i, 0]
                + left[r, 1] * shape.modes[k, i, 1]
                + left[r, 2] * shape.modes[k, i, 2]
            )
    for r in range(3):
        for k in range(modes):
            product = 0.0
            for m in range(modes):
                product += covariance[k, m] * moved[r, m]
            for c in range(3):
                own[r, c] += product * moved[c, k]
    for r in range(3):
        for c in range(3):
            posterior[r, c] = own[r, c]


@kernel
def _shift_displacements(evidence: Evidence, equations: JointEquations) -> None:
    """Move the eliminated displacements' prior means as the slopes of the log determinant do."""
    spread, sightings, rows = evidence.shape.spread, evidence.sightings, equations.rows
    unknowns = rows.shape[0] - 4
    column = 0
    for n in equations.order:
        i = sightings.point[n]
        for _ in range(count_equations(sightings, n)):
            if spread[i] > 0.0:
                shift = 0.0
                for a in range(3):
                    shift -= rows[unknowns + 1 + a, column] * equations.new_slopes[i, a]
                shift *= spread[i] ** 2
                rows[unknowns, column] += shift
                for k in range(unknowns):
                    equations.new.gradient[k] += rows[k, column] * shift
            column += 1


@inlined
def _hold_at_bounds(evidence: Evidence, state: State, arrow: Arrow) -> None:
    """Hold focal lengths where they would leave their bounds."""
    focals = evidence.focals
    for f in range(focals.low.shape[0]):
        slope = arrow.gradient[6 * arrow.blocks.shape[0] + f]
        if leaves_bounds(state.log_focals[f], focals.low[f], focals.high[f], slope):
            hold(arrow, f)


@kernel
def _eliminate(evidence: Evidence, state: State, equations: JointEquations) -> float:
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


@cost_at.of(Joint)
@kernel
def joint_cost(system: Joint, row: FloatArray) -> float:
    """The cost at a state."""
    return evaluate_joint(system, row, joint_room(system))


@accept.of(Joint)
@kernel
def _accept(system: Joint, row: FloatArray, equations: JointEquations) -> None:
    copy_arrow(equations.new, equations.current)
    for k in range(equations.kept.shape[0]):
        for c in range(equations.kept.shape[1]):
            equations.kept[k, c] = equations.rows[k, c]
    for i in range(equations.slopes.shape[0]):
        for a in range(3):
            equations.slopes[i, a] = equations.new_slopes[i, a]
    state = unpacked(system.evidence, row)
    for p in range(state.poses.shape[0]):
        orthonormalize(state.poses[p])


@solve.of(Joint)
@kernel
def _solve(system: Joint, equations: JointEquations, damping: float, step: FloatArray) -> float:
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
def _follow(evidence: Evidence, equations: JointEquations, step: FloatArray, moved: State) -> None:
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
            moved.displacements[i, a] = -(evidence.shape.spread[i] ** 2) * equations.slopes[i, a]
        for c in range(start, column):
            residual = rows[unknowns, c]
            for k in range(unknowns):
                residual += rows[k, c] * step[k]
            residual *= -(evidence.shape.spread[i] ** 2)
            for a in range(3):
                moved.displacements[i, a] += residual * rows[unknowns + 1 + a, c]


@score_of.of(Joint)
@kernel
def joint_score(system: Joint, row: FloatArray, cost: float) -> float:
    """-2 log of the evidence by Laplace's approximation; infinite where it is not determined."""
    plain = Joint(system.evidence, False)
    equations = joint_room(plain)
    cost = evaluate_joint(plain, row, equations)
    if not cost < np.inf:
        return np.inf
    decide_on_undetermined(equations.new, equations.new.blocks.shape[0])
    if not factorize_arrow(equations.new):
        return np.inf
    return float(cost + log_determinant(equations.new) + equations.log_determinant[0])


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


@is_estimate.of(Joint)
@inlined
def _is_estimate(system: Joint, row: FloatArray) -> bool:
    return True
