"""Normal equations of the pose, with the shape eliminated.

About a guess, the residuals of the keypoints are ``r + J dp + A (x - offset)``, with steps dp of
the pose and a shape whose offsets x have the covariance S. Without x they are ``e = r - A offset``
with the covariance ``M = I + A S A'``; whitening by the Cholesky factor of M leaves least squares
in dp, and ``x = -S A' M^-1 (e + J dp)`` follows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import fast_sums, kernel
from cadalign.solvers.evidence import loss_and_root
from cadalign.solvers.marginal.problem import Guess, Seen, Target

POSE_UNKNOWNS = 6
_RESIDUAL = 6


class Equations(NamedTuple):
    """Equations of 2 n coordinates, whitened.

    ``rows`` (7, 2 n) are the derivatives by the pose and the residuals e; ``by_shape`` (2 n, 3)
    those by the own point, not whitened; ``factor`` (2 n, 2 n) the lower Cholesky factor of M;
    ``hessian`` (6, 6), ``gradient`` (6,). ``sums`` (2,) holds the quadratic cost at the guess and
    the log determinant of M.
    """

    rows: FloatArray
    by_shape: FloatArray
    factor: FloatArray
    hessian: FloatArray
    gradient: FloatArray
    sums: FloatArray


@kernel
def empty_equations(keypoints: int) -> Equations:
    """Room for the equations."""
    return Equations(
        np.empty((POSE_UNKNOWNS + 1, 2 * keypoints)),
        np.empty((2 * keypoints, 3)),
        np.empty((2 * keypoints, 2 * keypoints)),
        np.empty((POSE_UNKNOWNS, POSE_UNKNOWNS)),
        np.empty(POSE_UNKNOWNS),
        np.empty(2),
    )


@kernel
def evaluate(target: Target, seen: Seen, guess: Guess, equations: Equations) -> float:
    """Write the equations at a guess; returns its cost, infinite behind the camera."""
    cost = _write_rows(target, seen, guess, equations)
    if not cost < np.inf:
        return np.inf
    _widen(target.covariance, equations.by_shape, equations.factor)
    if not _whiten(equations):
        return np.inf
    return cost


@kernel
def _write_rows(target: Target, seen: Seen, guess: Guess, equations: Equations) -> float:
    rows, by_shape, pose = equations.rows, equations.by_shape, guess.pose
    cost = 0.0
    square = 0.0
    prior = 0.0
    for i in range(seen.points.shape[0]):
        dx, dy, dz = guess.offset[i, 0], guess.offset[i, 1], guess.offset[i, 2]
        prior += guess.force[i, 0] * dx + guess.force[i, 1] * dy + guess.force[i, 2] * dz
        px, py, pz = target.mean[i, 0] + dx, target.mean[i, 1] + dy, target.mean[i, 2] + dz
        x = pose[0] * px + pose[1] * py + pose[2] * pz
        y = pose[3] * px + pose[4] * py + pose[5] * pz
        z = pose[6] * px + pose[7] * py + pose[8] * pz
        depth = z + pose[11]
        if not depth > 0:
            return np.inf
        u, v = (x + pose[9]) / depth, (y + pose[10]) / depth
        a, b, c = seen.whitening[i, 0], seen.whitening[i, 1], seen.whitening[i, 2]
        du, dv = u - seen.rays[i, 0], v - seen.rays[i, 1]
        ru, rv = a * du + b * dv, c * dv
        part, root = loss_and_root(seen.loss, seen.loss_scale, ru * ru + rv * rv)
        cost += part
        for q in range(2):
            column = 2 * i + q
            if q == 0:
                bx, by, residual = root * a / depth, root * b / depth, root * ru
            else:
                bx, by, residual = 0.0, root * c / depth, root * rv
            bz = -(bx * u + by * v)
            square += residual * residual
            rows[0, column] = y * bz - z * by
            rows[1, column] = z * bx - x * bz
            rows[2, column] = x * by - y * bx
            rows[3, column], rows[4, column], rows[5, column] = bx, by, bz
            for k in range(3):
                by_shape[column, k] = bx * pose[k] + by * pose[3 + k] + bz * pose[6 + k]
            rows[_RESIDUAL, column] = residual - (
                by_shape[column, 0] * dx + by_shape[column, 1] * dy + by_shape[column, 2] * dz
            )
    equations.sums[0] = square + prior
    return cost + prior


@fast_sums
def _widen(covariance: FloatArray, by_shape: FloatArray, matrix: FloatArray) -> None:
    """Write the lower triangle of ``M = I + A S A'``."""
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
            matrix[c, d] = (
                row[j] * by_shape[d, 0] + row[j + 1] * by_shape[d, 1] + row[j + 2] * by_shape[d, 2]
            )
        matrix[c, c] += 1.0


@fast_sums
def _whiten(equations: Equations) -> bool:
    """Factorize M, whiten the rows, and sum the normal equations; False if M is not positive."""
    factor, rows = equations.factor, equations.rows
    log_determinant = 0.0
    for i in range(factor.shape[0]):
        for j in range(i):
            total = 0.0
            for k in range(j):
                total += factor[i, k] * factor[j, k]
            factor[i, j] = (factor[i, j] - total) * factor[j, j]
        total = 0.0
        for k in range(i):
            total += factor[i, k] * factor[i, k]
        square = factor[i, i] - total
        if not square > 0.0:
            return False
        log_determinant += np.log(square)
        inverse = 1.0 / np.sqrt(square)
        for m in range(POSE_UNKNOWNS + 1):
            total = 0.0
            for k in range(i):
                total += factor[i, k] * rows[m, k]
            rows[m, i] = (rows[m, i] - total) * inverse
        factor[i, i] = inverse  # its only use is to divide by the diagonal
    for k in range(POSE_UNKNOWNS):
        for m in range(k, POSE_UNKNOWNS + 1):
            total = 0.0
            for c in range(factor.shape[0]):
                total += rows[k, c] * rows[m, c]
            if m < POSE_UNKNOWNS:
                equations.hessian[k, m] = equations.hessian[m, k] = total
            else:
                equations.gradient[k] = total
    equations.sums[1] = log_determinant
    return True


@fast_sums
def follow(
    target: Target,
    equations: Equations,
    step: FloatArray,
    share: float,
    guess: Guess,
    moved: Guess,
) -> float:
    """Write the shape that a step of the pose leads to, and return its quadratic cost.

    The shape goes the ``share`` of its way; the cost is that at the end of the way.
    """
    factor, rows, by_shape = equations.factor, equations.rows, equations.by_shape
    size = factor.shape[0]
    right = np.empty(size)
    cost = 0.0
    for c in range(size):
        total = rows[_RESIDUAL, c]
        for k in range(POSE_UNKNOWNS):
            total += rows[k, c] * step[k]
        cost += total * total
        right[c] = -total
    for i in range(size - 1, -1, -1):
        right[i] *= factor[i, i]
        for k in range(i):
            right[k] -= factor[i, k] * right[i]
    flat = np.empty(3 * (size // 2))
    for i in range(size // 2):
        for a in range(3):
            total = by_shape[2 * i, a] * right[2 * i] + by_shape[2 * i + 1, a] * right[2 * i + 1]
            flat[3 * i + a] = total
            moved.force[i, a] = guess.force[i, a] + share * (total - guess.force[i, a])
    for i in range(size // 2):
        for a in range(3):
            total = 0.0
            for k in range(flat.shape[0]):
                total += target.covariance[3 * i + a, k] * flat[k]
            moved.offset[i, a] = guess.offset[i, a] + share * (total - guess.offset[i, a])
    return cost
