"""Dense linear algebra for compiled kernels, without allocations in loops."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import fast_sums, inline, kernel

Triple = tuple[float, float, float]

_COLUMNS = 32
LEAST_INFORMATION = 1e-15
"""Least information about an unknown, relative to the largest."""


@inline
def add(a: Triple, b: Triple) -> Triple:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inline
def subtract(a: Triple, b: Triple) -> Triple:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inline
def multiply(a: Triple, factor: float) -> Triple:
    return a[0] * factor, a[1] * factor, a[2] * factor


@inline
def normalize(a: Triple) -> Triple:
    return multiply(a, 1.0 / np.sqrt(dot(a, a)))


@inline
def cross(a: Triple, b: Triple) -> Triple:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inline
def dot(a: Triple, b: Triple) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inline
def triple(row: FloatArray) -> Triple:
    """The first three numbers of a row."""
    return row[0], row[1], row[2]


@inline
def second_moments(points: FloatArray) -> tuple[float, float, float, float, float, float]:
    """Sums of xx, xy, xz, yy, yz and zz over points (n, 3)."""
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        xx, xy, xz = xx + x * x, xy + x * y, xz + x * z
        yy, yz, zz = yy + y * y, yz + y * z, zz + z * z
    return xx, xy, xz, yy, yz, zz


@fast_sums
def add_products(rows: FloatArray, columns: int, hessian: FloatArray, gradient: FloatArray) -> None:
    """Add J' J to an upper triangle (U, U) and J' r to (U,); ``rows`` are J', then r."""
    unknowns = gradient.shape[0]
    for k in range(unknowns):
        for m in range(k, unknowns + 1):
            total = 0.0
            for c in range(columns):
                total += rows[k, c] * rows[m, c]
            if m < unknowns:
                hessian[k, m] += total
            else:
                gradient[k] += total


@inline
def mirror_upper(matrix: FloatArray) -> None:
    """Copy the upper triangle of a matrix to the lower one."""
    for k in range(matrix.shape[0]):
        for m in range(k):
            matrix[k, m] = matrix[m, k]


@kernel
def cholesky(matrix: FloatArray, size: int, floor: float) -> bool:
    """Write the lower Cholesky factor in place; False for a pivot below ``floor`` * diagonal."""
    for i in range(size):
        diagonal = matrix[i, i]
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not total > floor * diagonal:
                    return False
                matrix[i, i] = np.sqrt(total)
            else:
                matrix[i, j] = total / matrix[j, j]
    return True


@kernel
def solve_cholesky(factor: FloatArray, size: int, right: FloatArray) -> None:
    """Solve in place, with a factor from `cholesky`."""
    for i in range(size):
        total = right[i]
        for k in range(i):
            total -= factor[i, k] * right[k]
        right[i] = total / factor[i, i]
    for i in range(size - 1, -1, -1):
        total = right[i]
        for k in range(i + 1, size):
            total -= factor[k, i] * right[k]
        right[i] = total / factor[i, i]


@fast_sums
def factorize(matrix: FloatArray) -> bool:
    """Like `cholesky` with floor 0, but with SIMD sums, for large matrices."""
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


@fast_sums
def solve_factor(factor: FloatArray, right: FloatArray) -> None:
    """Solve in place, with a factor from `factorize`."""
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
def solve_factor_rows(factor: FloatArray, right: FloatArray) -> None:
    """Solve for all columns of ``right`` (n, k) in place, in blocks that fit the CPU cache."""
    size = factor.shape[0]
    for start in range(0, right.shape[1], _COLUMNS):
        block = right[:, start : start + _COLUMNS]
        for i in range(size):
            own = block[i]
            for k in range(i):
                share, other = factor[i, k], block[k]
                for c in range(own.shape[0]):
                    own[c] -= share * other[c]
            for c in range(own.shape[0]):
                own[c] /= factor[i, i]
        for i in range(size - 1, -1, -1):
            own = block[i]
            for c in range(own.shape[0]):
                own[c] /= factor[i, i]
            for k in range(i):
                share, other = factor[i, k], block[k]
                for c in range(own.shape[0]):
                    other[c] -= share * own[c]


@inline
def copy_into(target: FloatArray, source: FloatArray) -> None:
    """Copy a vector; ``target[:] = source`` would compile Numba's code for error messages."""
    for k in range(target.shape[0]):
        target[k] = source[k]


@inline
def expected_decrease(gradient: FloatArray, step: FloatArray, size: int) -> float:
    """Predicted decrease of the cost by a Gauss-Newton step."""
    expected = 0.0
    for k in range(size):
        expected -= gradient[k] * step[k]
    return expected


@kernel
def damp(blocks: FloatArray, border: FloatArray, damping: float) -> None:
    """Add damping, and a small floor, to the diagonals of blocks (P, k, k) and border (b, b)."""
    least = 1e-300
    for p in range(blocks.shape[0]):
        for k in range(blocks.shape[1]):
            least = max(least, LEAST_INFORMATION * blocks[p, k, k])
    for k in range(border.shape[0]):
        least = max(least, LEAST_INFORMATION * border[k, k])
    for p in range(blocks.shape[0]):
        for k in range(blocks.shape[1]):
            blocks[p, k, k] += damping * blocks[p, k, k] + least
    for k in range(border.shape[0]):
        border[k, k] += damping * border[k, k] + least


@kernel
def eigenvectors_4(matrix: FloatArray, vectors: FloatArray) -> None:
    """Diagonalise a symmetric (4, 4) in place by Jacobi's method; eigenvectors are columns."""
    for i in range(4):
        for j in range(4):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(12):
        off = 0.0
        for p in range(3):
            for q in range(p + 1, 4):
                off += matrix[p, q] * matrix[p, q]
        trace = 0.0
        for p in range(4):
            trace += matrix[p, p] * matrix[p, p]
        if off <= 1e-36 * trace:
            return
        for p in range(3):
            for q in range(p + 1, 4):
                apq = matrix[p, q]
                if apq == 0.0:
                    continue
                theta = (matrix[q, q] - matrix[p, p]) / (2.0 * apq)
                if theta >= 0:
                    t = 1.0 / (theta + np.sqrt(1.0 + theta * theta))
                else:
                    t = -1.0 / (-theta + np.sqrt(1.0 + theta * theta))
                c = 1.0 / np.sqrt(1.0 + t * t)
                s = t * c
                matrix[p, p] -= t * apq
                matrix[q, q] += t * apq
                matrix[p, q] = 0.0
                matrix[q, p] = 0.0
                for k in range(4):
                    if k not in (p, q):
                        akp = matrix[k, p]
                        akq = matrix[k, q]
                        matrix[k, p] = c * akp - s * akq
                        matrix[p, k] = matrix[k, p]
                        matrix[k, q] = s * akp + c * akq
                        matrix[q, k] = matrix[k, q]
                    vkp = vectors[k, p]
                    vkq = vectors[k, q]
                    vectors[k, p] = c * vkp - s * vkq
                    vectors[k, q] = s * vkp + c * vkq


@kernel
def rotation_from_quaternion(w: float, x: float, y: float, z: float, rotation: FloatArray) -> None:
    """Write the rotation matrix (3, 3) of a quaternion of any length."""
    norm = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * norm, x * norm, y * norm, z * norm
    rotation[0, 0] = 1 - 2 * (y * y + z * z)
    rotation[0, 1] = 2 * (x * y - w * z)
    rotation[0, 2] = 2 * (x * z + w * y)
    rotation[1, 0] = 2 * (x * y + w * z)
    rotation[1, 1] = 1 - 2 * (x * x + z * z)
    rotation[1, 2] = 2 * (y * z - w * x)
    rotation[2, 0] = 2 * (x * z - w * y)
    rotation[2, 1] = 2 * (y * z + w * x)
    rotation[2, 2] = 1 - 2 * (x * x + y * y)


@kernel
def nearest_rotation(
    matrix: FloatArray, rotation: FloatArray, work: FloatArray, vectors: FloatArray
) -> None:
    """Write the rotation R of determinant +1 that maximises trace(R' matrix) into ``rotation``.

    Horn, "Closed-form solution of absolute orientation using unit quaternions", 1987: the
    quaternion is the dominant eigenvector of a symmetric 4 x 4 matrix. ``work``, ``vectors`` (4, 4)
    are scratch.
    """
    m = matrix
    work[0, 0] = m[0, 0] + m[1, 1] + m[2, 2]
    work[1, 1] = m[0, 0] - m[1, 1] - m[2, 2]
    work[2, 2] = m[1, 1] - m[0, 0] - m[2, 2]
    work[3, 3] = m[2, 2] - m[0, 0] - m[1, 1]
    work[0, 1] = work[1, 0] = m[2, 1] - m[1, 2]
    work[0, 2] = work[2, 0] = m[0, 2] - m[2, 0]
    work[0, 3] = work[3, 0] = m[1, 0] - m[0, 1]
    work[1, 2] = work[2, 1] = m[0, 1] + m[1, 0]
    work[1, 3] = work[3, 1] = m[0, 2] + m[2, 0]
    work[2, 3] = work[3, 2] = m[1, 2] + m[2, 1]
    eigenvectors_4(work, vectors)
    best = 0
    for k in range(1, 4):
        if work[k, k] > work[best, best]:
            best = k
    rotation_from_quaternion(
        vectors[0, best], vectors[1, best], vectors[2, best], vectors[3, best], rotation
    )


@kernel
def polish_rotation(matrix: FloatArray, rotation: FloatArray) -> None:
    """Write the rotation nearest to an almost orthogonal matrix, by two Newton-Schulz steps."""
    gram = np.empty((3, 3))
    for i in range(3):
        copy_into(rotation[i], matrix[i])
    for _ in range(2):
        for i in range(3):
            for j in range(3):
                gram[i, j] = (1.5 if i == j else 0.0) - 0.5 * (
                    rotation[0, i] * rotation[0, j]
                    + rotation[1, i] * rotation[1, j]
                    + rotation[2, i] * rotation[2, j]
                )
        for i in range(3):
            a, b, c = rotation[i, 0], rotation[i, 1], rotation[i, 2]
            for j in range(3):
                rotation[i, j] = a * gram[0, j] + b * gram[1, j] + c * gram[2, j]
