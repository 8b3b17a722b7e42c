"""The system of one view's pose, the shape integrated out.

About a state, the residuals of the keypoints are ``r + J dp + A (x - offset)``, with steps dp of
the pose and a shape whose offsets x have the covariance S. Without x they are ``e = r - A offset``
with the covariance ``M = I + A S A'``; whitening by the Cholesky factor of M leaves least squares
in dp, and ``x = -S A' M^-1 (e + J dp)`` follows.

What is integrated out leaves its determinant, so that the objective is

    F = r' r + x' S^-1 x + log det M,

where M depends on the pose and on the shape, through the points that A is taken at. Its derivative
is ``d log det M = 2 tr(dA P A')``, P the covariance of the shape given the pose, and row q of A
touches only the point i that it is of: with ``y_q = (P A')_iq``, all in the model's frame, r_3 the
camera's z there, z the depth and a_q the row,

    half the derivative by the point    h_i = -sum_q ((a_q y_q) r_3 + (r_3 y_q) a_q) / z,
    half the derivative by a turn w     w . (sum_i x_i x h_i + sum_q y_q x a_q),

and that by the translation is the sum of h_i. A slope ``h' x`` of the objective moves the prior's
mean by -S h. The Hessian is that of the least squares alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import fast_sums, inlined, kernel
from cadalign.solvers.alignment import Equations, accept_new, room_for, solve_damped
from cadalign.solvers.constants import HUBER, LINEAR, POSE_SIZE
from cadalign.solvers.evidence import Keypoints, keypoint_cost, loss_and_root
from cadalign.solvers.linalg import cholesky, copy_into
from cadalign.solvers.marginal.problem import GaussianTarget, Seen
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

POSE_UNKNOWNS = 6
POSE = 12  # numbers of a pose at the start of a state
_RESIDUAL = 6
_SAME_CHORD = 0.05
_LEAST_INFORMATION = 25.0  # about a turn [1 / rad^2]; beyond, the posterior is no Gaussian


class Posed(NamedTuple):
    """One view's keypoints of one Gaussian; without ``integrates`` the cost is F less log det M.

    A state is the pose (12,), rotation row by row and translation; the offsets x (3 n,) of the
    keypoints from the mean; and w (3 n,), with ``S w = x``.
    """

    target: GaussianTarget
    seen: Seen
    integrates: bool


class Whitened(NamedTuple):
    """Equations of 2 n coordinates, whitened.

    ``rows`` (7, 2 n) are the derivatives by the pose and the residuals e, less A S h where the
    shape is integrated out; ``by_shape`` (2 n, 3) those by the own point, not whitened; ``factor``
    (2 n, 2 n) the upper Cholesky factor of M, with the inverse of its diagonal. ``slope`` (3 n,) is
    h and ``turned`` (6,) half the derivative of log det M by the pose, with the shape held.
    ``sums`` (2,) holds the decrease of F that the least squares of the rows are subtracted from,
    and log det M.
    """

    rows: FloatArray
    by_shape: FloatArray
    factor: FloatArray
    slope: FloatArray
    turned: FloatArray
    sums: FloatArray


class MarginalEquations(NamedTuple):
    """Equations that steps are from, those evaluated last, and scratch space.

    ``normal`` are those of the pose, ``gradient`` is theirs. ``points`` (n, 3) hold the depths and
    the derivatives of the loss's weight over those of the residuals.
    """

    normal: Equations
    gradient: FloatArray
    current: Whitened
    new: Whitened
    points: FloatArray
    right: FloatArray
    inverse: FloatArray
    square: FloatArray
    lever: FloatArray


@kernel
def _room_for_whitened(keypoints: int) -> Whitened:
    size = 2 * keypoints
    return Whitened(
        np.empty((POSE_UNKNOWNS + 1, size)),
        np.empty((size, 3)),
        np.empty((size, size)),
        np.zeros(3 * keypoints),
        np.zeros(POSE_UNKNOWNS),
        np.empty(2),
    )


@room_of.of(Posed)
@kernel
def posed_room(system: Posed) -> MarginalEquations:
    """Room for the equations."""
    n = system.seen.points.shape[0]
    size = 2 * n if system.integrates else 0
    normal = room_for(POSE_UNKNOWNS)
    return MarginalEquations(
        normal,
        normal.gradient,
        _room_for_whitened(n),
        _room_for_whitened(n),
        np.empty((n, 3)),
        np.empty(2 * n),
        np.empty((size, size)),
        np.empty((size, size)),
        np.empty((size, 3)),
    )


@kernel
def state_at(pose: FloatArray, keypoints: int) -> FloatArray:
    """The state of the mean at a pose (12,)."""
    state = np.zeros(POSE + 6 * keypoints)
    copy_into(state[:POSE], pose)
    return state


@kernel
def force_of(state: FloatArray) -> FloatArray:
    """The w (n, 3) of a state."""
    return state[(state.shape[0] + POSE) // 2 :].copy().reshape((-1, 3))


@evaluate.of(Posed)
@kernel
def evaluate_posed(system: Posed, state: FloatArray, equations: MarginalEquations) -> float:
    """Write the new equations at a state; returns the cost, infinite behind the camera."""
    new, normal = equations.new, equations.normal
    cost = _write_rows(system, state, equations)
    if not cost < np.inf:
        return np.inf
    _widen(system.target.covariance, new.by_shape, new.factor)
    if not _factorize(new):
        return np.inf
    if system.integrates:
        cost += new.sums[1]
        _invert(new.factor, equations.inverse, equations.square)
        _write_slopes(system, state, equations)
        _shift_mean(system, state, new)
    _whiten(new, normal.new_hessian, normal.new_gradient)
    if system.integrates:
        for k in range(POSE_UNKNOWNS):
            normal.new_gradient[k] += new.turned[k]
    return cost


@kernel
def _write_rows(system: Posed, state: FloatArray, equations: MarginalEquations) -> float:
    seen, mean = system.seen, system.target.mean
    rows, by_shape, points = equations.new.rows, equations.new.by_shape, equations.points
    n = mean.shape[0]
    cost = 0.0
    square = 0.0
    prior = 0.0
    for i in range(n):
        o = POSE + 3 * i
        dx, dy, dz = state[o], state[o + 1], state[o + 2]
        f = o + 3 * n
        prior += state[f] * dx + state[f + 1] * dy + state[f + 2] * dz
        px, py, pz = mean[i, 0] + dx, mean[i, 1] + dy, mean[i, 2] + dz
        x = state[0] * px + state[1] * py + state[2] * pz
        y = state[3] * px + state[4] * py + state[5] * pz
        z = state[6] * px + state[7] * py + state[8] * pz
        depth = z + state[11]
        if not depth > 0:
            return np.inf
        u, v = (x + state[9]) / depth, (y + state[10]) / depth
        a, b, c = seen.whitening[i, 0], seen.whitening[i, 1], seen.whitening[i, 2]
        du, dv = u - seen.rays[i, 0], v - seen.rays[i, 1]
        ru, rv = a * du + b * dv, c * dv
        part, root = loss_and_root(seen.loss, seen.loss_scale, ru * ru + rv * rv)
        cost += part
        own = root * root * (ru * ru + rv * rv)
        square += own
        points[i, 0] = depth
        fall = _fall_of_weight(seen.loss, seen.loss_scale, root, own)
        points[i, 1], points[i, 2] = fall * root * ru, fall * root * rv
        for q in range(2):
            column = 2 * i + q
            if q == 0:
                bx, by, residual = root * a / depth, root * b / depth, root * ru
            else:
                bx, by, residual = 0.0, root * c / depth, root * rv
            bz = -(bx * u + by * v)
            rows[0, column] = y * bz - z * by
            rows[1, column] = z * bx - x * bz
            rows[2, column] = x * by - y * bx
            rows[3, column], rows[4, column], rows[5, column] = bx, by, bz
            for k in range(3):
                by_shape[column, k] = bx * state[k] + by * state[3 + k] + bz * state[6 + k]
            rows[_RESIDUAL, column] = residual - (
                by_shape[column, 0] * dx + by_shape[column, 1] * dy + by_shape[column, 2] * dz
            )
    equations.new.sums[0] = square + prior
    return cost + prior


@inlined
def _fall_of_weight(loss: int, scale: float, root: float, square: float) -> float:
    """Derivative of the logarithm of the weight's root, over r' dr, of weighted residuals r."""
    if loss == LINEAR or root == 1.0:
        return 0.0
    return -0.5 / square if loss == HUBER else -1.0 / (scale * scale)


@fast_sums
def _widen(covariance: FloatArray, by_shape: FloatArray, matrix: FloatArray) -> None:
    """Write the upper triangle of ``M = I + A S A'``."""
    size = by_shape.shape[0]
    row = np.empty(covariance.shape[0])
    for c in range(size):
        i = c // 2
        p, q, r = by_shape[c, 0], by_shape[c, 1], by_shape[c, 2]
        for k in range(3 * i + 3):
            row[k] = (
                p * covariance[3 * i, k]
                + q * covariance[3 * i + 1, k]
                + r * covariance[3 * i + 2, k]
            )
        for d in range(c + 1):
            j = 3 * (d // 2)
            matrix[d, c] = (
                row[j] * by_shape[d, 0] + row[j + 1] * by_shape[d, 1] + row[j + 2] * by_shape[d, 2]
            )
        matrix[c, c] += 1.0


@fast_sums
def _factorize(new: Whitened) -> bool:
    """Factorize M, two rows at a time; False if it is not positive."""
    factor = new.factor
    size = factor.shape[0]
    log_determinant = 0.0
    for k in range(0, size, 2):
        one, two = factor[k], factor[k + 1]
        first = one[k]
        if not first > 0.0:
            return False
        scale = 1.0 / np.sqrt(first)
        share = one[k + 1] * scale
        second = two[k + 1] - share * share
        if not second > 0.0:
            return False
        log_determinant += np.log(first * second)
        scale_two = 1.0 / np.sqrt(second)
        one[k], one[k + 1], two[k + 1] = scale, share, scale_two
        for j in range(k + 2, size):
            above = one[j] * scale
            one[j] = above
            two[j] = (two[j] - share * above) * scale_two
        for i in range(k + 2, size):
            row, p, q = factor[i], one[i], two[i]
            for j in range(i, size):
                row[j] -= p * one[j] + q * two[j]
    new.sums[1] = log_determinant
    return True


@fast_sums
def _whiten(new: Whitened, hessian: FloatArray, gradient: FloatArray) -> None:
    """Whiten the rows, and sum the normal equations."""
    factor, rows = new.factor, new.rows
    size = factor.shape[0]
    for m in range(POSE_UNKNOWNS + 1):
        row = rows[m]
        for k in range(0, size, 2):
            one, two = factor[k], factor[k + 1]
            p = row[k] * one[k]
            q = (row[k + 1] - p * one[k + 1]) * two[k + 1]
            row[k], row[k + 1] = p, q
            for j in range(k + 2, size):
                row[j] -= p * one[j] + q * two[j]
    for k in range(POSE_UNKNOWNS):
        for m in range(k, POSE_UNKNOWNS + 1):
            total = 0.0
            for c in range(size):
                total += rows[k, c] * rows[m, c]
            if m < POSE_UNKNOWNS:
                hessian[k, m] = hessian[m, k] = total
            else:
                gradient[k] = total


@fast_sums
def _invert(factor: FloatArray, inverse: FloatArray, square: FloatArray) -> None:
    """Write the transposed inverse of the factor, and the inverse of M."""
    size = factor.shape[0]
    for k in range(size):
        for j in range(size):
            inverse[k, j] = square[k, j] = 0.0
    for k in range(0, size, 2):
        one, two = inverse[k], inverse[k + 1]
        for i in range(0, k, 2):
            over, under = inverse[i], inverse[i + 1]
            p, q = factor[i, k], factor[i + 1, k]
            r, s = factor[i, k + 1], factor[i + 1, k + 1]
            for j in range(i + 2):
                one[j] -= p * over[j] + q * under[j]
                two[j] -= r * over[j] + s * under[j]
        share, scale, scale_two = factor[k, k + 1], factor[k, k], factor[k + 1, k + 1]
        one[k], two[k + 1] = 1.0, 1.0
        for j in range(k + 2):
            one[j] *= scale
            two[j] = (two[j] - share * one[j]) * scale_two
        for i in range(k + 2):
            row, p, q = square[i], one[i], two[i]
            for j in range(k + 2):
                row[j] += p * one[j] + q * two[j]


@fast_sums
def _write_slopes(system: Posed, state: FloatArray, equations: MarginalEquations) -> None:
    """Write half the derivatives of log det M by shape and pose."""
    new, points, square, lever = equations.new, equations.points, equations.square, equations.lever
    covariance, mean = system.target.covariance, system.target.mean
    by_shape, slope, turned = new.by_shape, new.slope, new.turned
    size = by_shape.shape[0]
    forced = np.empty(3 * mean.shape[0])
    for q in range(size):  # y_q = S A' M^-1, of the own point
        for c in range(size // 2):
            one, two = square[q, 2 * c], square[q, 2 * c + 1]
            for a in range(3):
                forced[3 * c + a] = one * by_shape[2 * c, a] + two * by_shape[2 * c + 1, a]
        for a in range(3):
            total = 0.0
            for k in range(forced.shape[0]):
                total += covariance[3 * (q // 2) + a, k] * forced[k]
            lever[q, a] = total
    total_turn, total_slope = np.zeros(3), np.zeros(3)
    for i in range(mean.shape[0]):
        own = slope[3 * i : 3 * i + 3]
        own[:] = 0.0
        rest = 2.0 - square[2 * i, 2 * i] - square[2 * i + 1, 2 * i + 1]  # sum of a_q y_q
        for q in range(2 * i, 2 * i + 2):
            a, y = by_shape[q], lever[q]
            along = 0.0
            deeper = 0.0
            for k in range(3):
                along += a[k] * y[k]
                deeper += state[6 + k] * y[k]
            for k in range(3):
                own[k] -= (along * state[6 + k] + deeper * a[k]) / points[i, 0]
                own[k] += rest * points[i, 1 + q - 2 * i] * a[k]
                m, p = (k + 1) % 3, (k + 2) % 3
                total_turn[k] += y[m] * a[p] - y[p] * a[m]
        for k in range(3):
            m, p = (k + 1) % 3, (k + 2) % 3
            at_m = mean[i, m] + state[POSE + 3 * i + m]
            at_p = mean[i, p] + state[POSE + 3 * i + p]
            total_turn[k] += at_m * own[p] - at_p * own[m]
            total_slope[k] += own[k]
    for k in range(3):
        turned[k] = turned[3 + k] = 0.0
        for m in range(3):
            turned[k] += state[3 * k + m] * total_turn[m]
            turned[3 + k] += state[3 * k + m] * total_slope[m]


@fast_sums
def _shift_mean(system: Posed, state: FloatArray, new: Whitened) -> None:
    """Subtract A S h from the residuals, and what it changes from the decrease."""
    covariance, slope, by_shape = system.target.covariance, new.slope, new.by_shape
    for i in range(slope.shape[0] // 3):
        for a in range(3):
            total = 0.0
            for k in range(slope.shape[0]):
                total += covariance[3 * i + a, k] * slope[k]
            new.rows[_RESIDUAL, 2 * i] -= by_shape[2 * i, a] * total
            new.rows[_RESIDUAL, 2 * i + 1] -= by_shape[2 * i + 1, a] * total
            new.sums[0] += slope[3 * i + a] * (total + 2.0 * state[POSE + 3 * i + a])


@cost_at.of(Posed)
@kernel
def posed_cost(system: Posed, state: FloatArray) -> float:
    """The cost at a state."""
    if system.integrates:
        return evaluate_posed(system, state, posed_room(system))
    seen, points = system.seen, system.target.mean.copy()
    size = 3 * points.shape[0]
    prior = 0.0
    for k in range(size):
        points[k // 3, k % 3] += state[POSE + k]
        prior += state[POSE + k] * state[POSE + size + k]
    pose = np.ones(POSE_SIZE)
    copy_into(pose[:POSE], state[:POSE])
    keypoints = Keypoints(points, seen.rays, seen.whitening, seen.loss, seen.loss_scale)
    return keypoint_cost(keypoints, pose) + prior


@solve.of(Posed)
@fast_sums
def _solve(system: Posed, equations: MarginalEquations, damping: float, step: FloatArray) -> float:
    expected = solve_damped(equations.normal, POSE_UNKNOWNS, damping, step)
    if expected != expected:
        return np.nan
    rows = equations.current.rows
    expected = float(equations.current.sums[0])
    if system.integrates:
        for k in range(POSE_UNKNOWNS):
            expected -= 2.0 * equations.current.turned[k] * step[k]
    for c in range(rows.shape[1]):
        total = rows[_RESIDUAL, c]
        for k in range(POSE_UNKNOWNS):
            total += rows[k, c] * step[k]
        expected -= total * total
        equations.right[c] = -total
    return expected


@move.of(Posed)
@fast_sums
def _move(
    system: Posed,
    state: FloatArray,
    equations: MarginalEquations,
    damping: float,
    step: FloatArray,
    moved: FloatArray,
) -> None:
    move_rigid(state, step, moved)
    factor, by_shape, right = equations.current.factor, equations.current.by_shape, equations.right
    slope, covariance = equations.current.slope, system.target.covariance
    for i in range(factor.shape[0] - 1, -1, -1):
        total = right[i]
        for k in range(i + 1, factor.shape[0]):
            total -= factor[i, k] * right[k]
        right[i] = total * factor[i, i]
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


@accept.of(Posed)
@kernel
def _accept(system: Posed, state: FloatArray, equations: MarginalEquations) -> None:
    accept_new(equations.normal, POSE_UNKNOWNS)
    new, current = equations.new, equations.current
    for k in range(POSE_UNKNOWNS + 1):
        copy_into(current.rows[k], new.rows[k])
    for c in range(new.factor.shape[0]):
        copy_into(current.by_shape[c], new.by_shape[c])
        for d in range(c, new.factor.shape[0]):
            current.factor[c, d] = new.factor[c, d]
    copy_into(current.slope, new.slope)
    copy_into(current.turned, new.turned)
    copy_into(current.sums, new.sums)
    orthonormalize(state)


@score_of.of(Posed)
@kernel
def _score_of(system: Posed, state: FloatArray, cost: float) -> float:
    if not system.integrates:
        return cost
    equations = posed_room(system)
    score = evaluate_posed(system, state, equations)
    factor = equations.normal.new_hessian
    for k in range(3):
        factor[k, k] += _LEAST_INFORMATION
    if not score < np.inf or not cholesky(factor, POSE_UNKNOWNS, 0.0):
        return np.inf
    for k in range(POSE_UNKNOWNS):
        score += 2.0 * np.log(factor[k, k])
    return score


@are_same.of(Posed)
@inlined
def _are_same(system: Posed, first: FloatArray, second: FloatArray) -> bool:
    square = 0.0
    for k in range(9):
        square += (first[k] - second[k]) ** 2
    return square < _SAME_CHORD * _SAME_CHORD


@is_estimate.of(Posed)
@inlined
def _is_estimate(system: Posed, state: FloatArray) -> bool:
    return True
