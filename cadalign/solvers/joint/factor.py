"""Cholesky factors of normal equations of many unknowns, by sums over rows."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import fast_sums, kernel

_LEAST_SHARE = 1e-12  # of an unknown's information that the others must leave


@fast_sums
def factorize(matrix: FloatArray) -> bool:
    """Replace the lower triangle of a symmetric matrix by its Cholesky factor.

    Returns False where it is not positive definite.
    """
    for i in range(matrix.shape[0]):
        for j in range(i):
            total = 0.0
            for k in range(j):
                total += matrix[i, k] * matrix[j, k]
            matrix[i, j] = (matrix[i, j] - total) / matrix[j, j]
        total = 0.0
        for k in range(i):
            total += matrix[i, k] * matrix[i, k]
        square = matrix[i, i] - total
        if not square > 0.0:
            return False
        matrix[i, i] = np.sqrt(square)
    return True


@kernel
def decide_on_undetermined(information: FloatArray, views: int) -> None:
    """Make a singular matrix definite beside other views, and indefinite for a single one.

    What the evidence leaves open gets a deviation, a million times its own scale, where several
    views share a shape, and is refused for one alone. Otherwise the rounding of the entries would
    tell whether the matrix has a Cholesky factor.
    """
    share = _LEAST_SHARE if views > 1 else -_LEAST_SHARE
    for k in range(information.shape[0]):
        information[k, k] *= 1.0 + share


@fast_sums
def solve_factor(factor: FloatArray, right: FloatArray) -> None:
    """Solve in place, with the factor that `factorize` left."""
    size = factor.shape[0]
    for i in range(size):
        total = 0.0
        for k in range(i):
            total += factor[i, k] * right[k]
        right[i] = (right[i] - total) / factor[i, i]
    for i in range(size - 1, -1, -1):
        right[i] /= factor[i, i]
        for k in range(i):
            right[k] -= factor[i, k] * right[i]


@fast_sums
def invert_factor(factor: FloatArray) -> FloatArray:
    """The inverse of the lower triangle that `factorize` left."""
    size = factor.shape[0]
    inverse = np.zeros((size, size))
    for i in range(size):
        scale = 1.0 / factor[i, i]
        for k in range(i):
            product = factor[i, k] * scale
            for m in range(k + 1):
                inverse[i, m] -= product * inverse[k, m]
        inverse[i, i] = scale
    return inverse
