"""Pose of one view's keypoints (6 unknowns), with a Gaussian shape integrated out.

**Elimination.** Near a state, the residuals of the keypoints are ``r + J dp + A (x - offset)``,
with a step dp of the pose and offsets x of covariance S. Without x they are ``e = r - A offset``,
of covariance ``M = I + A S A'``. Whitening by the Cholesky factor of M leaves least squares in dp.
Then ``x = -S A' M^-1 (e + J dp)``.

**Objective.** Integrating out the shape adds a determinant:

    F = r' r + x' S^-1 x + log det M.

M depends on the pose and on the points at which A is evaluated. Half the derivative of log det M by
point i is h_i, a sum of `cadalign.solvers.projection.slope_of_row` in the model's frame, with the
responses ``y_q = (P A')_iq``. Half the derivative by a rotation is
``sum_i x_i x h_i + sum_q y_q x a_q``; by the translation it is the sum of h_i. A slope ``h' x`` of
the objective moves the prior's mean by -S h. The Hessian neglects log det M.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import borrow, fast_sums, inline, kernel
from cadalign.solvers.alignment import Equations, empty_equations, solve_damped
from cadalign.solvers.constants import POSE_SIZE
from cadalign.solvers.evidence import (
    KeypointEvidence,
    keypoint_cost,
    score_of_distance,
    weigh_error,
    weight_slope,
)
from cadalign.solvers.linalg import (
    add,
    add_products,
    cholesky,
    copy_into,
    cross,
    dot,
    mirror_upper,
    triple,
)
from cadalign.solvers.marginal.problem import (
    GaussianTarget,
    Seen,
    factorize_upper,
    invert_upper,
    unwhiten,
    whiten,
    write_covariance,
)
from cadalign.solvers.projection import (
    motion_of,
    ray_of,
    ray_slopes,
    shift,
    slope_of_row,
    turn,
    turn_back,
    write_motion,
)
from cadalign.solvers.search import allocate, are_same, cost_at, evaluate, move, score_of, solve
from cadalign.solvers.unknowns import move_rigid, orthonormalize

POSE_UNKNOWNS = 6
POSE = 12  # length of the pose at the start of a state
_RESIDUAL = 6
_SAME_CHORD = 0.05
_LEAST_INFORMATION = 25.0  # added about rotations [1 / rad^2]: large angles are not Gaussian


class Marginal(NamedTuple):
    """One view's keypoints under one Gaussian; without ``integrates`` the cost omits log det M.

    A state is the pose (12,), rotation row by row and translation; offsets x (3 n,) of the
    keypoints from the mean; and w (3 n,), with ``S w = x``.
    """

    target: GaussianTarget
    seen: Seen
    integrates: bool


class MarginalEquations(NamedTuple):
    """Whitened equations of 2 n coordinates, and scratch space.

    ``normal`` are the normal equations of the pose, ``gradient`` is their gradient. ``rows``
    (7, 2 n) are derivatives by the pose, then the residuals e, minus A S h if the shape is
    integrated out. ``by_shape`` (2 n, 3) are derivatives by the own point, not whitened. ``factor``
    (2 n, 2 n) is the upper Cholesky factor of M with an inverted diagonal. ``slope`` (3 n,) is h;
    ``pose_slope`` (6,) is half the derivative of log det M by the pose, for a constant shape.
    ``sums`` (2,) are the constant of the predicted decrease of F, and log det M. The columns of
    ``points`` (n, 3) are the depth and, for u and v, the residual times `weight_slope`.
    """

    normal: Equations
    gradient: FloatArray
    rows: FloatArray
    by_shape: FloatArray
    factor: FloatArray
    slope: FloatArray
    pose_slope: FloatArray
    sums: FloatArray
    points: FloatArray
    right: FloatArray
    inverse: FloatArray
    square: FloatArray
    lever: FloatArray


@kernel
def empty_marginal_equations(system: Marginal) -> MarginalEquations:
    n = system.seen.points.shape[0]
    size = 2 * n if system.integrates else 0
    normal = empty_equations(POSE_UNKNOWNS)
    return MarginalEquations(
        normal,
        normal.gradient,
        np.empty((POSE_UNKNOWNS + 1, 2 * n)),
        np.empty((2 * n, 3)),
        np.empty((2 * n, 2 * n)),
        np.zeros(3 * n),
        np.zeros(POSE_UNKNOWNS),
        np.empty(2),
        np.empty((n, 3)),
        np.empty(2 * n),
        np.empty((size, size)),
        np.empty((size, size)),
        np.empty((size, 3)),
    )


@allocate.of(Marginal)
@kernel
def _allocate(system: Marginal) -> tuple[MarginalEquations, MarginalEquations]:
    return empty_marginal_equations(system), empty_marginal_equations(system)


@evaluate.of(Marginal)
@kernel
def evaluate_marginal(system: Marginal, state: FloatArray, equations: MarginalEquations) -> float:
    """Write the equations at a state; returns the cost, infinite behind the camera."""
    cost = _write_rows(system, state, equations)
    if not cost < np.inf:
        return np.inf
    write_covariance(system.target.covariance, equations.by_shape, equations.factor)
    equations.sums[1] = factorize_upper(equations.factor)
    if not equations.sums[1] < np.inf:
        return np.inf
    if system.integrates:
        cost += equations.sums[1]
        invert_upper(equations.factor, equations.inverse, equations.square)
        _write_slopes(system, state, equations)
        _shift_mean(system, state, equations)
    whiten(equations.factor, equations.rows)
    hessian, gradient = equations.normal.hessian, equations.gradient
    hessian[:] = 0.0
    gradient[:] = 0.0
    add_products(equations.rows, equations.rows.shape[1], hessian, gradient)
    mirror_upper(hessian)
    if system.integrates:
        for k in range(POSE_UNKNOWNS):
            gradient[k] += equations.pose_slope[k]
    return cost


@borrow
def _write_rows(system: Marginal, state: FloatArray, equations: MarginalEquations) -> float:
    seen, mean = system.seen, system.target.mean
    rows, by_shape, points = equations.rows, equations.by_shape, equations.points
    n = mean.shape[0]
    motion = motion_of(state)
    cost = 0.0
    square = 0.0
    prior = 0.0
    for i in range(n):
        o = POSE + 3 * i
        f = o + 3 * n
        offset = state[o], state[o + 1], state[o + 2]
        prior += dot(offset, (state[f], state[f + 1], state[f + 2]))
        turned = turn(
            motion, (mean[i, 0] + offset[0], mean[i, 1] + offset[1], mean[i, 2] + offset[2])
        )
        place = ray_of(shift(motion, turned))
        if not place[2] > 0:
            return np.inf
        du, dv = place[0] - seen.rays[i, 0], place[1] - seen.rays[i, 1]
        error = weigh_error(triple(seen.whitening[i]), du, dv, seen.loss, seen.loss_scale)
        cost += error.cost
        own = error.u * error.u + error.v * error.v
        square += own
        points[i, 0] = place[2]
        fall = weight_slope(seen.loss, seen.loss_scale, error.root, own)
        points[i, 1], points[i, 2] = fall * error.u, fall * error.v
        slopes = ray_slopes(place, error.whitening)
        residuals = error.u, error.v
        for q in range(2):
            column = 2 * i + q
            write_motion(turned, slopes[q], rows, column)
            by_point = turn_back(motion, slopes[q])
            by_shape[column, 0], by_shape[column, 1], by_shape[column, 2] = by_point
            rows[_RESIDUAL, column] = residuals[q] - dot(by_point, offset)
    equations.sums[0] = square + prior
    return cost + prior


@fast_sums
def _write_slopes(system: Marginal, state: FloatArray, equations: MarginalEquations) -> None:
    """Write half the derivatives of log det M by points and pose."""
    points, square, lever = equations.points, equations.square, equations.lever
    covariance, mean = system.target.covariance, system.target.mean
    by_shape, slope, turned = equations.by_shape, equations.slope, equations.pose_slope
    size = by_shape.shape[0]
    forced = np.empty(3 * mean.shape[0])
    for q in range(size):  # y_q: rows of S A' M^-1 for the own point
        for c in range(size // 2):
            one, two = square[q, 2 * c], square[q, 2 * c + 1]
            for a in range(3):
                forced[3 * c + a] = one * by_shape[2 * c, a] + two * by_shape[2 * c + 1, a]
        for a in range(3):
            total = 0.0
            for k in range(forced.shape[0]):
                total += covariance[3 * (q // 2) + a, k] * forced[k]
            lever[q, a] = total
    motion = motion_of(state)
    total_turn = total_slope = (0.0, 0.0, 0.0)
    for i in range(mean.shape[0]):
        depth, o = points[i, 0], POSE + 3 * i
        nearer = motion[6] / depth, motion[7] / depth, motion[8] / depth
        place = mean[i, 0] + state[o], mean[i, 1] + state[o + 1], mean[i, 2] + state[o + 2]
        rest = 2.0 - square[2 * i, 2 * i] - square[2 * i + 1, 2 * i + 1]  # sum of a_q y_q
        own = (0.0, 0.0, 0.0)
        for q in range(2):
            row, response = triple(by_shape[2 * i + q]), triple(lever[2 * i + q])
            fall = rest * points[i, 1 + q]
            own = add(own, slope_of_row(row, dot(row, response), response, nearer, fall))
            total_turn = add(total_turn, cross(response, row))
        total_turn = add(total_turn, cross(place, own))
        total_slope = add(total_slope, own)
        slope[3 * i], slope[3 * i + 1], slope[3 * i + 2] = own
    turned[0], turned[1], turned[2] = turn(motion, total_turn)
    turned[3], turned[4], turned[5] = turn(motion, total_slope)


@fast_sums
def _shift_mean(system: Marginal, state: FloatArray, equations: MarginalEquations) -> None:
    """Subtract A S h from the residuals, and update the constant of the predicted decrease."""
    covariance, slope, by_shape = system.target.covariance, equations.slope, equations.by_shape
    for i in range(slope.shape[0] // 3):
        for a in range(3):
            total = 0.0
            for k in range(slope.shape[0]):
                total += covariance[3 * i + a, k] * slope[k]
            equations.rows[_RESIDUAL, 2 * i] -= by_shape[2 * i, a] * total
            equations.rows[_RESIDUAL, 2 * i + 1] -= by_shape[2 * i + 1, a] * total
            equations.sums[0] += slope[3 * i + a] * (total + 2.0 * state[POSE + 3 * i + a])


@cost_at.of(Marginal)
@kernel
def marginal_cost(system: Marginal, state: FloatArray) -> float:
    if system.integrates:
        return evaluate_marginal(system, state, empty_marginal_equations(system))
    seen, points = system.seen, system.target.mean.copy()
    size = 3 * points.shape[0]
    prior = 0.0
    for k in range(size):
        points[k // 3, k % 3] += state[POSE + k]
        prior += state[POSE + k] * state[POSE + size + k]
    pose = np.ones(POSE_SIZE)
    copy_into(pose[:POSE], state[:POSE])
    keypoints = KeypointEvidence(points, seen.rays, seen.whitening, seen.loss, seen.loss_scale)
    return keypoint_cost(keypoints, pose) + prior


@solve.of(Marginal)
@fast_sums
def _solve(
    system: Marginal, equations: MarginalEquations, damping: float, step: FloatArray
) -> float:
    expected = solve_damped(equations.normal, POSE_UNKNOWNS, damping, step)
    if expected != expected:
        return np.nan
    rows = equations.rows
    expected = float(equations.sums[0])
    if system.integrates:
        for k in range(POSE_UNKNOWNS):
            expected -= 2.0 * equations.pose_slope[k] * step[k]
    for c in range(rows.shape[1]):
        total = rows[_RESIDUAL, c]
        for k in range(POSE_UNKNOWNS):
            total += rows[k, c] * step[k]
        expected -= total * total
        equations.right[c] = -total
    return expected


@move.of(Marginal)
@fast_sums
def _move(
    system: Marginal,
    state: FloatArray,
    equations: MarginalEquations,
    damping: float,
    step: FloatArray,
    moved: FloatArray,
) -> None:
    move_rigid(state, step, moved)
    orthonormalize(moved)
    by_shape, right = equations.by_shape, equations.right
    slope, covariance = equations.slope, system.target.covariance
    unwhiten(equations.factor, right)
    size = covariance.shape[0]
    share = 1.0 / (1.0 + damping)
    force = np.empty(size)
    for i in range(size // 3):
        for a in range(3):
            k = 3 * i + a
            force[k] = by_shape[2 * i, a] * right[2 * i] + by_shape[2 * i + 1, a] * right[2 * i + 1]
            if system.integrates:
                force[k] -= slope[k]
            old = state[POSE + size + k]
            moved[POSE + size + k] = old + share * (force[k] - old)
    for k in range(size):
        total = 0.0
        for m in range(size):
            total += covariance[k, m] * force[m]
        moved[POSE + k] = state[POSE + k] + share * (total - state[POSE + k])


@score_of.of(Marginal)
@kernel
def _score_of(system: Marginal, state: FloatArray, cost: float) -> float:
    if not system.integrates:
        return cost
    equations = empty_marginal_equations(system)
    score = evaluate_marginal(system, state, equations)
    factor = equations.normal.hessian
    for k in range(3):
        factor[k, k] += _LEAST_INFORMATION
    if not score < np.inf or not cholesky(factor, POSE_UNKNOWNS, 0.0):
        return np.inf
    for k in range(POSE_UNKNOWNS):
        score += 2.0 * np.log(factor[k, k])
    return float(score + score_of_distance(_mean_depth(system.target.mean, state)))


@kernel
def _mean_depth(mean: FloatArray, state: FloatArray) -> float:
    total = 0.0
    for i in range(mean.shape[0]):
        total += state[11]
        for a in range(3):
            total += state[6 + a] * (mean[i, a] + state[POSE + 3 * i + a])
    return float(total / mean.shape[0])


@are_same.of(Marginal)
@inline
def _are_same(system: Marginal, first: FloatArray, second: FloatArray) -> bool:
    square = 0.0
    for k in range(9):
        square += (first[k] - second[k]) ** 2
    return square < _SAME_CHORD * _SAME_CHORD
