"""Normal equations of the joint system: elimination of displacements, and log determinants.

**Elimination.** A point that one pose sees has the displacement e, with the prior
N(0, spread^2 I) and the current value d. Its equations ``r + J dx + D (e - d)`` have the mean
``r - D d + J dx`` and the covariance I + spread^2 D D'. Whitening by the Cholesky factor L of this
covariance leaves least squares in x alone. Then ``e = -spread^2 D' L^-T (whitened residual)``.

**Log determinant.** Integrating out coefficients and displacements adds a log determinant to the
objective. Its slope h_q by the point of equation q is
`cadalign.solvers.projection.slope_of_row` in the rig's frame, with the response y_q of the point.
The derivative by a rotation is ``X_i x h_q + y_q x a_q``; stretch and focal length also scale the
rows. The equations of blocks depend on the shape through the coefficients only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import borrow, kernel
from cadalign.solvers.joint.arrow import Arrow, add_gradient, border_start, empty_arrow
from cadalign.solvers.joint.evidence import (
    Evidence,
    Shape,
    State,
    coordinate_of,
    exp_triple,
    remove_displacements,
    stretched_point,
)
from cadalign.solvers.joint.rows import count_block_equations, write_block_row
from cadalign.solvers.linalg import cholesky, cross, dot, factorize, solve_factor_rows
from cadalign.solvers.projection import slope_of_row, turn, turn_back


class Layout(NamedTuple):
    """Columns of the equations of N sightings in the rows of derivatives.

    The sightings of pose p are ``order[first[p]:first[p + 1]]``, grouped by points. Sighting n has
    ``widths[n]`` columns: one for a contour point, two or three for a keypoint. With one pose, the
    columns of point i are ``columns[i, 0]`` to ``columns[i, 1]``; otherwise this range is empty.
    """

    order: IntArray
    first: IntArray
    widths: IntArray
    columns: IntArray


class JointEquations(NamedTuple):
    """Normal equations, and scratch space.

    ``gradient`` is the gradient of the ``arrow``, ``factor`` the factor of the damped arrow. For
    ``rows`` and ``seen`` see `write_rows`. ``log_determinant`` (1,) is the sum over the covariances
    of eliminated displacements. ``slopes`` (m, 3) are half the derivatives of the total log
    determinant by unstretched points.
    """

    arrow: Arrow
    gradient: FloatArray
    factor: Arrow
    layout: Layout
    rows: FloatArray
    seen: FloatArray
    products: FloatArray
    log_determinant: FloatArray
    slopes: FloatArray


def layout_of(evidence: Evidence) -> Layout:
    sightings, points = evidence.sightings, len(evidence.shape.mean)
    pose = evidence.rig.pose[sightings.image]
    poses = int(evidence.rig.pose.max()) + 1
    widths = 1 + (sightings.whitening[:, 2] > 0) + (sightings.depths[:, 1] > 0)
    counts = np.bincount(sightings.point, widths, points) * (poses == 1)
    ends = np.cumsum(counts.astype(np.int64))
    return Layout(
        np.argsort(pose * points + sightings.point, kind="stable"),
        np.append(0, np.cumsum(np.bincount(pose, minlength=poses))),
        widths,
        np.column_stack([np.append(0, ends[:-1]), ends]),
    )


@kernel
def empty_joint_equations(evidence: Evidence, layout: Layout) -> JointEquations:
    poses, points = layout.first.shape[0] - 1, evidence.shape.mean.shape[0]
    border = evidence.focals.low.shape[0] + 3 + evidence.shape.modes.shape[0]
    most = total = 0
    for p in range(poses):
        columns = 0
        for n in layout.order[layout.first[p] : layout.first[p + 1]]:
            columns += layout.widths[n]
        most, total = max(most, columns), total + columns
    arrow = empty_arrow(poses, border)
    return JointEquations(
        arrow,
        arrow.gradient,
        empty_arrow(poses, border),
        layout,
        np.zeros((6 + border + 4, most)),
        np.zeros((8, total)),
        np.zeros((7 + border, 7 + border)),
        np.zeros(1),
        np.zeros((points, 3)),
    )


@kernel
def eliminate_displacements(
    spread: FloatArray, displacements: FloatArray, equations: JointEquations
) -> float:
    """Whiten the equations of points with displacements; returns the cost of the prior."""
    rows, columns = equations.rows, equations.layout.columns
    last = rows.shape[0] - 4
    cost = 0.0
    for i in range(spread.shape[0]):
        start, end = columns[i, 0], columns[i, 1]
        if start == end or not spread[i] > 0:
            continue
        for a in range(3):
            displacement = displacements[i, a]
            cost += (displacement / spread[i]) ** 2
            for c in range(start, end):
                rows[last, c] -= rows[last + 1 + a, c] * displacement
        equations.log_determinant[0] += _whiten_columns(
            rows, start, end, spread[i], np.empty((end - start, end - start))
        )
    return cost


@borrow
def _whiten_columns(
    rows: FloatArray, start: int, end: int, spread: float, factor: FloatArray
) -> float:
    """Whiten the columns of one point; returns the log determinant of the covariance."""
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


@borrow
def shift_means(spread: FloatArray, equations: JointEquations) -> None:
    """Move the prior means of displacements by the slopes of the log determinant."""
    rows, columns = equations.rows, equations.layout.columns
    unknowns = rows.shape[0] - 4
    beyond_pose = equations.gradient.shape[0] - unknowns
    for i in range(spread.shape[0]):
        if not spread[i] > 0:
            continue
        for c in range(columns[i, 0], columns[i, 1]):
            moved = 0.0
            for a in range(3):
                moved -= spread[i] ** 2 * rows[unknowns + 1 + a, c] * equations.slopes[i, a]
            rows[unknowns, c] += moved
            for k in range(unknowns):
                equations.gradient[k if k < 6 else k + beyond_pose] += rows[k, c] * moved


@borrow
def update_displacements(
    spread: FloatArray, equations: JointEquations, step: FloatArray, displacements: FloatArray
) -> None:
    """Write the optimal displacements after a step."""
    rows, columns = equations.rows, equations.layout.columns
    unknowns = step.shape[0]
    for i in range(spread.shape[0]):
        start, end = columns[i, 0], columns[i, 1]
        if start == end or not spread[i] > 0:
            continue
        for a in range(3):
            displacements[i, a] = -(spread[i] ** 2) * equations.slopes[i, a]
        for c in range(start, end):
            residual = rows[unknowns, c]
            for k in range(unknowns):
                residual += rows[k, c] * step[k]
            residual *= -(spread[i] ** 2)
            for a in range(3):
                displacements[i, a] += residual * rows[unknowns + 1 + a, c]


@kernel
def add_log_determinant(evidence: Evidence, state: State, equations: JointEquations) -> float:
    """Add half the derivative of the log determinant; returns the coefficients' determinant."""
    modes, total = evidence.shape.modes.shape[0], equations.seen.shape[1]
    first = evidence.focals.low.shape[0] + 3
    factor = equations.arrow.border[first:, first:].copy()
    if not factorize(factor):
        return np.inf
    volume = 0.0
    for k in range(modes):
        volume += 2.0 * np.log(factor[k, k])
    spread, columns = evidence.shape.spread, equations.layout.columns
    left = _undetermined_shares(spread, equations.rows, columns)
    by_model, response = np.empty((3, total)), np.empty((modes, total))
    _write_point_rows(evidence, state, equations, left, by_model, response)
    solve_factor_rows(factor, response)
    _add_slopes(evidence, state, equations, left, by_model, response, np.empty((3, 4)))
    if modes > 0:
        _add_block_slopes(evidence, state, equations.arrow, factor)
    return volume


@kernel
def _add_block_slopes(evidence: Evidence, state: State, arrow: Arrow, factor: FloatArray) -> None:
    """Add half the derivatives from blocks: the change of each row along its response."""
    first, total = 6 + evidence.focals.low.shape[0] + 3, count_block_equations(evidence)
    row, moved_row = np.empty(6 + arrow.border.shape[0]), np.empty(6 + arrow.border.shape[0])
    still, moved = remove_displacements(state), remove_displacements(state)
    response = np.empty((factor.shape[0], total))
    for q in range(total):
        equation = write_block_row(evidence, still, q, row)
        for k in range(factor.shape[0]):
            response[k, q] = equation.root * row[first + k]
    solve_factor_rows(factor, response)
    for q in range(total):
        equation = write_block_row(evidence, still, q, row)
        along = 0.0
        for k in range(factor.shape[0]):
            moved.coefficients[k] = still.coefficients[k] + response[k, q]
            along += equation.root * row[first + k] * response[k, q]
        write_block_row(evidence, moved, q, moved_row)
        # The loss's weight falls as the residual grows.
        fall = along * equation.fall * equation.root * equation.residual
        for k in range(row.shape[0]):
            moved_row[k] = equation.root * (moved_row[k] - row[k] + fall * row[k])
        add_gradient(arrow, equation.pose, moved_row)


@kernel
def _undetermined_shares(spread: FloatArray, rows: FloatArray, columns: IntArray) -> FloatArray:
    """Posterior over prior covariance (m, 3, 3) of each displacement, given its equations."""
    left = np.zeros((spread.shape[0], 3, 3))
    last = rows.shape[0] - 3
    for i in range(spread.shape[0]):
        for r in range(3):
            left[i, r, r] = 1.0
        if spread[i] > 0.0:
            for k in range(columns[i, 0], columns[i, 1]):
                for r in range(3):
                    for c in range(3):
                        left[i, r, c] -= spread[i] ** 2 * rows[last + r, k] * rows[last + c, k]
    return left


@borrow
def _write_point_rows(
    evidence: Evidence,
    state: State,
    equations: JointEquations,
    left: FloatArray,
    by_model: FloatArray,
    by_modes: FloatArray,
) -> None:
    """Write derivatives by unstretched points (3, N) and by coefficients (K, N)."""
    sightings, modes, seen = evidence.sightings, evidence.shape.modes, equations.seen
    scale = exp_triple(state.log_scales)
    column = 0
    for n in equations.layout.order:
        i = sightings.point[n]
        motion = state.poses[evidence.rig.pose[sightings.image[n]]]
        for _ in range(equations.layout.widths[n]):
            turned = turn_back(motion, (seen[0, column], seen[1, column], seen[2, column]))
            row = turned[0] * scale[0], turned[1] * scale[1], turned[2] * scale[2]
            kept = dot(left[i, 0], row), dot(left[i, 1], row), dot(left[i, 2], row)
            for c in range(3):
                by_model[c, column] = row[c]
            for k in range(modes.shape[0]):
                by_modes[k, column] = dot(modes[k, i], kept)
            column += 1


@borrow
def _add_slopes(
    evidence: Evidence,
    state: State,
    equations: JointEquations,
    left: FloatArray,
    by_model: FloatArray,
    response: FloatArray,
    moved: FloatArray,
) -> None:
    """Add half the derivatives from sightings, given the coefficients' ``response`` (K, N)."""
    shape, sightings, rig = evidence.shape, evidence.sightings, evidence.rig
    seen, slopes, gradient = equations.seen, equations.slopes, equations.gradient
    size, start = equations.arrow.blocks.shape[1], border_start(equations.arrow)
    first = start + evidence.focals.low.shape[0]
    scale = exp_triple(state.log_scales)
    slopes[:] = 0.0
    column = 0
    for n in equations.layout.order:
        i, v = sightings.point[n], sightings.image[n]
        p = rig.pose[v]
        motion, group = state.poses[p], evidence.focals.group[v]
        turned = turn(motion, stretched_point(shape, state, scale, i))
        count = equations.layout.widths[n]
        _write_responses(shape, i, left[i], by_model, response, column, count, moved)
        of_depth = count - int(sightings.depths[n, 1] > 0.0)
        in_image = 0.0
        for q in range(of_depth):
            in_image += moved[q, 3]
        for q in range(count):
            a = seen[0, column], seen[1, column], seen[2, column]
            d = seen[3, column], seen[4, column], seen[5, column]
            back, along = (moved[q, 0], moved[q, 1], moved[q, 2]), moved[q, 3]
            y = turn(motion, (scale[0] * back[0], scale[1] * back[1], scale[2] * back[2]))
            # The loss's weight falls as the residual grows.
            fall = (in_image if q < of_depth else along) * seen[6, column]
            h = slope_of_row(a, along, y, d, fall)
            by_turn, by_row, by_point = cross(turned, h), cross(y, a), turn_back(motion, h)
            for c in range(3):
                gradient[size * p + c] += by_turn[c] + by_row[c]
                gradient[size * p + 3 + c] += h[c]
                gradient[first + c] += by_model[c, column] * back[c]
                slopes[i, c] += scale[c] * by_point[c]
            if group >= 0:
                gradient[start + group] += fall * seen[7, column]
                if d[0] != 0.0 or d[1] != 0.0 or d[2] != 0.0:
                    gradient[start + group] += along
            column += 1
    for i in range(slopes.shape[0]):
        for c in range(3):
            if slopes[i, c] != 0.0:
                gradient[first + c] += slopes[i, c] * coordinate_of(shape, state, i, c)
                for k in range(shape.modes.shape[0]):
                    gradient[first + 3 + k] += slopes[i, c] * shape.modes[k, i, c]


@borrow
def _write_responses(
    shape: Shape,
    i: int,
    left: FloatArray,
    by_model: FloatArray,
    response: FloatArray,
    first: int,
    count: int,
    moved: FloatArray,
) -> None:
    """Write responses of point i to its equations (q, 3), and their dot products with the rows."""
    square = shape.spread[i] ** 2
    for q in range(count):
        column = first + q
        row = by_model[0, column], by_model[1, column], by_model[2, column]
        back = square * row[0], square * row[1], square * row[2]
        for k in range(shape.modes.shape[0]):
            share, mode = response[k, column], shape.modes[k, i]
            back = back[0] + share * mode[0], back[1] + share * mode[1], back[2] + share * mode[2]
        back = dot(left[0], back), dot(left[1], back), dot(left[2], back)
        moved[q, 0], moved[q, 1], moved[q, 2], moved[q, 3] = *back, dot(row, back)
