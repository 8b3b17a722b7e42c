"""The log determinant that coefficients and displacements leave where they are integrated out.

With the equations ``r + A z`` of the coefficients and displacements z, whose prior is standard
normal, it is that of M = I + A A', and its derivative is ``2 tr(dA P A')``, P the covariance of z
given the rest. Row q of A touches only the point i that it is of: with ``y_q = P_i a_q`` the
response of this point in the rig's frame, a_q the row there, and d the camera's z over the depth,
half the derivative by the point is

    h_q = -((a_q . y_q) d + (d . y_q) a_q),

and that by a turn ``X_i x h_q + y_q x a_q``; stretch and focal length scale the rows as well.
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import borrowing, kernel
from cadalign.solvers.joint.blocks import first_scale
from cadalign.solvers.joint.equations import JointEquations
from cadalign.solvers.joint.evidence import Evidence, State, unstretched
from cadalign.solvers.joint.rows import count_equations, exp_of, stretched_point
from cadalign.solvers.linalg import cross, dot, factorize, invert_factor
from cadalign.solvers.projection import turn, turn_back


@kernel
def add_log_determinant(evidence: Evidence, state: State, equations: JointEquations) -> float:
    """Add half the derivative of the log determinant; returns that of the coefficients.

    Half the derivatives by the points before the stretch are left in the equations' ``slopes``.
    """
    modes, total = evidence.shape.modes.shape[0], equations.seen.shape[1]
    first = first_scale(evidence) + 3
    factor = equations.arrow.border[first:, first:].copy()
    if not factorize(factor):
        return np.inf
    volume = 0.0
    for k in range(modes):
        volume += 2.0 * np.log(factor[k, k])
    left = _left_of_displacements(evidence, equations)
    by_model, response = np.empty((3, total)), np.empty((modes, total))
    _write_rows(evidence, state, equations, left, by_model, response)
    if modes > 0:
        triangle = invert_factor(factor)
        response = triangle.T @ (triangle @ response)
    _add_slopes(evidence, state, equations, left, by_model, response)
    return volume


@kernel
def _left_of_displacements(evidence: Evidence, equations: JointEquations) -> FloatArray:
    """Share (m, 3, 3) of each point's displacement that its whitened equations leave open."""
    spread, rows, columns = evidence.shape.spread, equations.rows, equations.columns
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


@borrowing
def _write_rows(
    evidence: Evidence,
    state: State,
    equations: JointEquations,
    left: FloatArray,
    by_model: FloatArray,
    by_modes: FloatArray,
) -> None:
    """Write the rows by the point before the stretch (3, N), and by the coefficients (K, N).

    The latter are those that remain where the displacements follow.
    """
    sightings, modes, seen = evidence.sightings, evidence.shape.modes, equations.seen
    scale = exp_of(state.log_scales)
    column = 0
    for n in equations.order:
        i = sightings.point[n]
        motion = state.poses[evidence.rig.pose[sightings.image[n]]]
        for _ in range(count_equations(sightings, n)):
            turned = turn_back(motion, (seen[0, column], seen[1, column], seen[2, column]))
            row = turned[0] * scale[0], turned[1] * scale[1], turned[2] * scale[2]
            kept = dot(left[i, 0], row), dot(left[i, 1], row), dot(left[i, 2], row)
            for c in range(3):
                by_model[c, column] = row[c]
            for k in range(modes.shape[0]):
                by_modes[k, column] = dot(modes[k, i], kept)
            column += 1


@borrowing
def _add_slopes(
    evidence: Evidence,
    state: State,
    equations: JointEquations,
    left: FloatArray,
    by_model: FloatArray,
    response: FloatArray,
) -> None:
    """Add half the derivatives, from the coefficients' ``response`` (K, N) to each equation."""
    shape, sightings, rig = evidence.shape, evidence.sightings, evidence.rig
    seen, slopes, gradient = equations.seen, equations.slopes, equations.gradient
    start = 6 * equations.arrow.blocks.shape[0]
    first = start + first_scale(evidence)
    scale = exp_of(state.log_scales)
    slopes[:] = 0.0
    column = 0
    for n in equations.order:
        i, v = sightings.point[n], sightings.image[n]
        p = rig.pose[v]
        motion, group = state.poses[p], evidence.focals.group[v]
        turned = turn(motion, stretched_point(shape, state, scale, i))
        square = shape.spread[i] ** 2
        for _ in range(count_equations(sightings, n)):
            row = by_model[0, column], by_model[1, column], by_model[2, column]
            moved = square * row[0], square * row[1], square * row[2]
            for k in range(shape.modes.shape[0]):
                share, mode = response[k, column], shape.modes[k, i]
                moved = (
                    moved[0] + share * mode[0],
                    moved[1] + share * mode[1],
                    moved[2] + share * mode[2],
                )
            moved = dot(left[i, 0], moved), dot(left[i, 1], moved), dot(left[i, 2], moved)
            along = dot(row, moved)
            a = seen[0, column], seen[1, column], seen[2, column]
            d = seen[3, column], seen[4, column], seen[5, column]
            y = turn(motion, (scale[0] * moved[0], scale[1] * moved[1], scale[2] * moved[2]))
            farther = dot(d, y)
            h = (
                -(along * d[0] + farther * a[0]),
                -(along * d[1] + farther * a[1]),
                -(along * d[2] + farther * a[2]),
            )
            by_turn, by_row, by_point = cross(turned, h), cross(y, a), turn_back(motion, h)
            for c in range(3):
                gradient[6 * p + c] += by_turn[c] + by_row[c]
                gradient[6 * p + 3 + c] += h[c]
                gradient[first + c] += row[c] * moved[c]
                slopes[i, c] += scale[c] * by_point[c]
            if group >= 0 and (d[0] != 0.0 or d[1] != 0.0 or d[2] != 0.0):
                gradient[start + group] += along
            column += 1
    for i in range(slopes.shape[0]):
        for c in range(3):
            if slopes[i, c] != 0.0:
                gradient[first + c] += slopes[i, c] * unstretched(shape, state, i, c)
                for k in range(shape.modes.shape[0]):
                    gradient[first + 3 + k] += slopes[i, c] * shape.modes[k, i, c]
