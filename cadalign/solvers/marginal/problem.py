"""One view's keypoints, Gaussian shapes, and the residual covariance that shapes cause.

A shape is ``x = mean + S w``, with the covariance S and the cost ``w' S w``. Only the rows of S
that belong to keypoints matter, so the normal equations have the size of the keypoints for any
number of modes.

The 2 n residuals of n keypoints have the derivatives A by the shape. Row q of A depends on one
point only, and is stored as three numbers: ``by_shape`` (2 n, 3). The residuals have the covariance
``M = I + A S A'``, and are whitened by its Cholesky factor.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import fast_sums, kernel


class Mixture(NamedTuple):
    """G Gaussians: means (G, m, 3), covariances (G, 3 m, 3 m), penalties (G,) = -2 log weight."""

    means: FloatArray
    covariances: FloatArray
    penalties: FloatArray


class Seen(NamedTuple):
    """Keypoints of a view: indices ``points`` (n,), rays (n, 2), whitening (n, 3), and the loss."""

    points: IntArray
    rays: FloatArray
    whitening: FloatArray
    loss: int
    loss_scale: float


class GaussianTarget(NamedTuple):
    """One Gaussian restricted to the keypoints: mean (n, 3) and covariance (3 n, 3 n)."""

    mean: FloatArray
    covariance: FloatArray


def mixture_at(mixture: Mixture, seen: Seen) -> Mixture:
    """Restrict Gaussians to the keypoints: means (G, n, 3), covariances (G, 3 n, 3 n)."""
    rows = coordinates_of(seen)
    covariances = np.ascontiguousarray(mixture.covariances[:, rows[:, None], rows])
    return Mixture(mixture.means[:, seen.points], covariances, mixture.penalties)


@kernel
def target_of(mixture: Mixture, component: int) -> GaussianTarget:
    return GaussianTarget(mixture.means[component], mixture.covariances[component])


def coordinates_of(seen: Seen) -> IntArray:
    """Indices (3 n,) of the keypoints' coordinates among the coordinates of all points."""
    return np.asarray((3 * seen.points[:, None] + np.arange(3)).ravel())


def shape_at(mixture: Mixture, component: int, seen: Seen, state: FloatArray) -> FloatArray:
    """All points (m, 3) of the shape at a state of `solvers.marginal.equations.Marginal`."""
    force = state[len(state) - 3 * len(seen.points) :]
    moved = mixture.covariances[component][:, coordinates_of(seen)] @ force
    return np.asarray(mixture.means[component] + moved.reshape(-1, 3))


@fast_sums
def write_covariance(covariance: FloatArray, by_shape: FloatArray, matrix: FloatArray) -> None:
    """Write the upper triangle of M (2 n, 2 n) for the covariance S (3 n, 3 n)."""
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
def factorize_upper(matrix: FloatArray) -> float:
    """Replace an upper triangle by its Cholesky factor with an inverted diagonal.

    Returns the log determinant, infinite if the matrix is not positive definite.
    """
    size = matrix.shape[0]
    log_determinant = 0.0
    for k in range(0, size, 2):
        one, two = matrix[k], matrix[k + 1]
        first = one[k]
        if not first > 0.0:
            return np.inf
        scale = 1.0 / np.sqrt(first)
        share = one[k + 1] * scale
        second = two[k + 1] - share * share
        if not second > 0.0:
            return np.inf
        log_determinant += np.log(first * second)
        scale_two = 1.0 / np.sqrt(second)
        one[k], one[k + 1], two[k + 1] = scale, share, scale_two
        for j in range(k + 2, size):
            above = one[j] * scale
            one[j] = above
            two[j] = (two[j] - share * above) * scale_two
        for i in range(k + 2, size):
            row, p, q = matrix[i], one[i], two[i]
            for j in range(i, size):
                row[j] -= p * one[j] + q * two[j]
    return float(log_determinant)


@fast_sums
def whiten(factor: FloatArray, rows: FloatArray) -> None:
    """Whiten rows (k, 2 n) of residuals and their derivatives, in place."""
    size = factor.shape[0]
    for m in range(rows.shape[0]):
        row = rows[m]
        for k in range(0, size, 2):
            one, two = factor[k], factor[k + 1]
            p = row[k] * one[k]
            q = (row[k + 1] - p * one[k + 1]) * two[k + 1]
            row[k], row[k + 1] = p, q
            for j in range(k + 2, size):
                row[j] -= p * one[j] + q * two[j]


@fast_sums
def unwhiten(factor: FloatArray, right: FloatArray) -> None:
    """Multiply whitened residuals (2 n,) by the transposed inverse of the factor, in place."""
    size = factor.shape[0]
    for i in range(size - 1, -1, -1):
        total = right[i]
        for k in range(i + 1, size):
            total -= factor[i, k] * right[k]
        right[i] = total * factor[i, i]


@fast_sums
def invert_upper(factor: FloatArray, inverse: FloatArray, square: FloatArray) -> None:
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
