"""Arrow-shaped normal equations of P poses and a shared border, factorized in linear time.

The unknowns are 6 for each pose and b shared ones, the border. Different poses have no products
with each other, so that eliminating one pose after the other causes no fill-in.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import fast_sums, inline, kernel
from cadalign.solvers.linalg import add_products, factorize, mirror_upper, solve_factor

_LEAST_SHARE = 1e-12  # least information about an unknown given the others, relative to its own


class Arrow(NamedTuple):
    """Symmetric matrix of blocks (P, 6, 6), coupling (P, 6, b), border (b, b); and a gradient."""

    blocks: FloatArray
    coupling: FloatArray
    border: FloatArray
    gradient: FloatArray


@kernel
def empty_arrow(poses: int, border: int) -> Arrow:
    return Arrow(
        np.zeros((poses, 6, 6)),
        np.zeros((poses, 6, border)),
        np.zeros((border, border)),
        np.zeros(6 * poses + border),
    )


@inline
def border_start(arrow: Arrow) -> int:
    return int(arrow.gradient.shape[0] - arrow.border.shape[0])


@kernel
def clear(arrow: Arrow) -> None:
    for part in (arrow.blocks.ravel(), arrow.coupling.ravel(), arrow.border.ravel()):
        part[:] = 0.0
    arrow.gradient[:] = 0.0


def dense_matrix(arrow: Arrow) -> FloatArray:
    """Dense matrix (U, U), the border last."""
    poses, size, border = arrow.coupling.shape
    last = size * poses
    whole = np.zeros((last + border, last + border))
    for p in range(poses):
        own = slice(size * p, size * (p + 1))
        whole[own, own] = arrow.blocks[p]
        whole[own, last:] = arrow.coupling[p]
        whole[last:, own] = arrow.coupling[p].T
    whole[last:, last:] = arrow.border
    return whole


@inline
def add_gradient(arrow: Arrow, pose: int, row: FloatArray) -> None:
    """Add derivatives (6 + b,) by one pose and the border to the gradient."""
    first, own = border_start(arrow), arrow.blocks.shape[1] * pose
    for k in range(row.shape[0]):
        arrow.gradient[own + k if k < 6 else first + k - 6] += row[k]


@kernel
def add_rows(arrow: Arrow, pose: int, rows: FloatArray, columns: int, products: FloatArray) -> None:
    """Add ``rows`` (6 + b + 1, C) of one pose, residuals last; ``products`` is scratch space."""
    unknowns = 6 + arrow.border.shape[0]
    first, own = border_start(arrow), arrow.blocks.shape[1] * pose
    matrix, right = products[:unknowns, :unknowns], products[unknowns, :unknowns]
    products[:] = 0.0
    add_products(rows, columns, matrix, right)
    mirror_upper(matrix)
    for k in range(6):
        arrow.gradient[own + k] += right[k]
        for m in range(6):
            arrow.blocks[pose, k, m] += matrix[k, m]
        for m in range(unknowns - 6):
            arrow.coupling[pose, k, m] += matrix[k, 6 + m]
    for k in range(unknowns - 6):
        arrow.gradient[first + k] += right[6 + k]
        for m in range(unknowns - 6):
            arrow.border[k, m] += matrix[6 + k, 6 + m]


@inline
def fix_unknown(arrow: Arrow, k: int) -> None:
    """Fix unknown k of the border: replace its equation by a unit row."""
    arrow.gradient[border_start(arrow) + k] = 0.0
    for p in range(arrow.blocks.shape[0]):
        for m in range(arrow.blocks.shape[1]):
            arrow.coupling[p, m, k] = 0.0
    for m in range(arrow.border.shape[0]):
        arrow.border[k, m] = arrow.border[m, k] = 0.0
    arrow.border[k, k] = 1.0


@kernel
def perturb_diagonal(arrow: Arrow, is_shared: bool) -> None:
    """Make a singular matrix definite for several views of one shape, indefinite for one view.

    Otherwise rounding errors would decide whether a Cholesky factor exists. With several views, an
    undetermined unknown gets a huge deviation; with one view, the factorization fails.
    """
    share = 1.0 + (_LEAST_SHARE if is_shared else -_LEAST_SHARE)
    for p in range(arrow.blocks.shape[0]):
        for k in range(arrow.blocks.shape[1]):
            arrow.blocks[p, k, k] *= share
    for k in range(arrow.border.shape[0]):
        arrow.border[k, k] *= share


@fast_sums
def factorize_arrow(arrow: Arrow) -> bool:
    """Replace a matrix by its Cholesky factor; False if it is not positive definite."""
    poses, size, border = arrow.coupling.shape
    for p in range(poses):
        block, coupling = arrow.blocks[p], arrow.coupling[p]
        if not factorize(block):
            return False
        for k in range(size):
            row = coupling[k]
            for j in range(k):
                share, above = block[k, j], coupling[j]
                for m in range(border):
                    row[m] -= share * above[m]
            inverse = 1.0 / block[k, k]
            for m in range(border):
                row[m] *= inverse
        for k in range(size):
            shared = coupling[k]
            for m in range(border):
                target, share = arrow.border[m], shared[m]
                for j in range(m + 1):
                    target[j] -= share * shared[j]
    return factorize(arrow.border)


@fast_sums
def solve_arrow(factor: Arrow, gradient: FloatArray, step: FloatArray) -> None:
    """Solve ``matrix @ step = -gradient``, given the factor of the matrix."""
    poses, size, border = factor.coupling.shape
    for k in range(step.shape[0]):
        step[k] = -gradient[k]
    shared = step[size * poses :]
    for p in range(poses):
        block, own = factor.blocks[p], step[size * p : size * (p + 1)]
        for k in range(size):
            row = block[k]
            for j in range(k):
                own[k] -= row[j] * own[j]
            own[k] /= row[k]
        for k in range(size):
            row, value = factor.coupling[p, k], own[k]
            for m in range(border):
                shared[m] -= row[m] * value
    solve_factor(factor.border, shared)
    for p in range(poses - 1, -1, -1):
        block, own = factor.blocks[p], step[size * p : size * (p + 1)]
        for k in range(size):
            row, total = factor.coupling[p, k], 0.0
            for m in range(border):
                total += row[m] * shared[m]
            own[k] -= total
        for k in range(size - 1, -1, -1):
            own[k] /= block[k, k]
            row, value = block[k], own[k]
            for j in range(k):
                own[j] -= row[j] * value


@kernel
def log_determinant(factor: Arrow) -> float:
    """Log determinant of the matrix, given its factor."""
    total = 0.0
    for p in range(factor.blocks.shape[0]):
        for k in range(factor.blocks.shape[1]):
            total += 2.0 * np.log(factor.blocks[p, k, k])
    for k in range(factor.border.shape[0]):
        total += 2.0 * np.log(factor.border[k, k])
    return total


def invert_arrow(arrow: Arrow) -> Arrow | None:
    """Blocks of the inverse; None if not determined, by the criterion of `perturb_diagonal`."""
    share = _LEAST_SHARE if len(arrow.blocks) > 1 else -_LEAST_SHARE
    try:
        lower = np.linalg.inv(np.linalg.cholesky(arrow.blocks * (1.0 + share * np.eye(6))))
        across = lower @ arrow.coupling
        rest = arrow.border * (1.0 + share * np.eye(len(arrow.border)))
        rest -= np.tensordot(across, across, ((0, 1), (0, 1)))
        triangle = np.linalg.inv(np.linalg.cholesky(rest))
    except np.linalg.LinAlgError:
        return None
    border = triangle.T @ triangle
    gain = lower.swapaxes(1, 2) @ across  # - d(pose) / d(border)
    coupling = -gain @ border
    blocks = lower.swapaxes(1, 2) @ lower - coupling @ gain.swapaxes(1, 2)
    return Arrow(blocks, coupling, border, np.zeros_like(arrow.gradient))
