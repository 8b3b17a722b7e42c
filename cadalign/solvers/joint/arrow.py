"""Normal equations of many poses that share a border: an arrow, factorized in linear time.

The unknowns are six for each of P poses, and b that all share. Poses have no products with each
other, so that each is eliminated by itself; what is left is a matrix of the border's size.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import fast_sums, inlined, kernel
from cadalign.solvers.linalg import factorize, invert_factor, solve_factor

_LEAST_SHARE = 1e-12  # of an unknown's information that the others must leave


class Arrow(NamedTuple):
    """A symmetric matrix: ``blocks`` (P, 6, 6), ``coupling`` (P, 6, b), ``border`` (b, b).

    The ``gradient`` (6 P + b,) is the right side of the equations.
    """

    blocks: FloatArray
    coupling: FloatArray
    border: FloatArray
    gradient: FloatArray


@kernel
def empty_arrow(poses: int, border: int) -> Arrow:
    """Room for an arrow."""
    return Arrow(
        np.zeros((poses, 6, 6)),
        np.zeros((poses, 6, border)),
        np.zeros((border, border)),
        np.zeros(6 * poses + border),
    )


@kernel
def clear(arrow: Arrow) -> None:
    """Set all entries to zero."""
    for part in (arrow.blocks.ravel(), arrow.coupling.ravel(), arrow.border.ravel()):
        part[:] = 0.0
    arrow.gradient[:] = 0.0


@kernel
def copy_arrow(source: Arrow, target: Arrow) -> None:
    """Copy all entries."""
    for p in range(source.blocks.shape[0]):
        for k in range(6):
            for m in range(6):
                target.blocks[p, k, m] = source.blocks[p, k, m]
            for m in range(source.border.shape[0]):
                target.coupling[p, k, m] = source.coupling[p, k, m]
    for k in range(source.border.shape[0]):
        for m in range(source.border.shape[0]):
            target.border[k, m] = source.border[k, m]
    for k in range(source.gradient.shape[0]):
        target.gradient[k] = source.gradient[k]


@kernel
def add_row(arrow: Arrow, pose: int, row: FloatArray, value: float) -> None:
    """Add an equation ``row . step = -value`` about one pose and the border, (6 + b,)."""
    first = 6 * arrow.blocks.shape[0]
    for k in range(row.shape[0]):
        slope = row[k]
        if slope == 0.0:
            continue
        if k < 6:
            arrow.gradient[6 * pose + k] += slope * value
            for m in range(6):
                arrow.blocks[pose, k, m] += slope * row[m]
            for m in range(arrow.border.shape[0]):
                arrow.coupling[pose, k, m] += slope * row[6 + m]
        else:
            arrow.gradient[first + k - 6] += slope * value
            for m in range(arrow.border.shape[0]):
                arrow.border[k - 6, m] += slope * row[6 + m]


@fast_sums
def add_products(
    arrow: Arrow, pose: int, rows: FloatArray, columns: int, products: FloatArray
) -> None:
    """Add the equations of a pose in the first ``columns`` of ``rows`` (6 + b + 1 or more, C).

    Row 6 + b holds the residuals; ``products`` (6 + b + 1, 6 + b + 1) is scratch space.
    """
    unknowns = 6 + arrow.border.shape[0]
    first = 6 * arrow.blocks.shape[0]
    for k in range(unknowns):
        for m in range(k, unknowns + 1):
            total = 0.0
            for c in range(columns):
                total += rows[k, c] * rows[m, c]
            products[k, m] = products[m, k] = total
    for k in range(6):
        arrow.gradient[6 * pose + k] += products[k, unknowns]
        for m in range(6):
            arrow.blocks[pose, k, m] += products[k, m]
        for m in range(unknowns - 6):
            arrow.coupling[pose, k, m] += products[k, 6 + m]
    for k in range(unknowns - 6):
        arrow.gradient[first + k] += products[6 + k, unknowns]
        for m in range(unknowns - 6):
            arrow.border[k, m] += products[6 + k, 6 + m]


@inlined
def hold(arrow: Arrow, k: int) -> None:
    """Replace the equations of unknown k of the border by a unit row."""
    arrow.gradient[6 * arrow.blocks.shape[0] + k] = 0.0
    for p in range(arrow.blocks.shape[0]):
        for m in range(6):
            arrow.coupling[p, m, k] = 0.0
    for m in range(arrow.border.shape[0]):
        arrow.border[k, m] = arrow.border[m, k] = 0.0
    arrow.border[k, k] = 1.0


@kernel
def decide_on_undetermined(arrow: Arrow, views: int) -> None:
    """Make a singular matrix definite beside other views, and indefinite for a single one.

    What the evidence leaves open gets a deviation, a million times its own scale, where several
    views share a shape, and is refused for one alone. Otherwise the rounding of the entries would
    tell whether the matrix has a Cholesky factor.
    """
    share = 1.0 + (_LEAST_SHARE if views > 1 else -_LEAST_SHARE)
    for p in range(arrow.blocks.shape[0]):
        for k in range(6):
            arrow.blocks[p, k, k] *= share
    for k in range(arrow.border.shape[0]):
        arrow.border[k, k] *= share


@fast_sums
def factorize_arrow(arrow: Arrow) -> bool:
    """Replace a matrix by its factor: blocks and border by Cholesky's, coupling by L^-1 C.

    Returns False where it is not positive definite. The gradient stays.
    """
    size = arrow.border.shape[0]
    for p in range(arrow.blocks.shape[0]):
        block, coupling = arrow.blocks[p], arrow.coupling[p]
        if not factorize(block):
            return False
        for k in range(6):
            for j in range(k):
                share = block[k, j]
                for m in range(size):
                    coupling[k, m] -= share * coupling[j, m]
            inverse = 1.0 / block[k, k]
            for m in range(size):
                coupling[k, m] *= inverse
        for k in range(6):
            for m in range(size):
                share = coupling[k, m]
                for j in range(m + 1):
                    arrow.border[m, j] -= share * coupling[k, j]
    return factorize(arrow.border)


@fast_sums
def solve_arrow(factor: Arrow, gradient: FloatArray, step: FloatArray) -> None:
    """Write the solution of ``matrix @ step = -gradient`` with the factor of the matrix."""
    poses, size = factor.blocks.shape[0], factor.border.shape[0]
    first = 6 * poses
    for k in range(step.shape[0]):
        step[k] = -gradient[k]
    shared = step[first:]
    for p in range(poses):
        block, coupling = factor.blocks[p], factor.coupling[p]
        own = step[6 * p : 6 * p + 6]
        for k in range(6):
            for j in range(k):
                own[k] -= block[k, j] * own[j]
            own[k] /= block[k, k]
        for k in range(6):
            for m in range(size):
                shared[m] -= coupling[k, m] * own[k]
    solve_factor(factor.border, shared)
    for p in range(poses):
        block, coupling = factor.blocks[p], factor.coupling[p]
        own = step[6 * p : 6 * p + 6]
        for k in range(6):
            total = 0.0
            for m in range(size):
                total += coupling[k, m] * shared[m]
            own[k] -= total
        for k in range(5, -1, -1):
            for j in range(k + 1, 6):
                own[k] -= block[j, k] * own[j]
            own[k] /= block[k, k]


@kernel
def log_determinant(factor: Arrow) -> float:
    """Log determinant of the matrix, from its factor."""
    total = 0.0
    for p in range(factor.blocks.shape[0]):
        for k in range(6):
            total += 2.0 * np.log(factor.blocks[p, k, k])
    for k in range(factor.border.shape[0]):
        total += 2.0 * np.log(factor.border[k, k])
    return total


@kernel
def invert_arrow(factor: Arrow) -> Arrow:
    """Blocks of the inverse matrix, from its factor: those of an arrow, with an empty gradient."""
    poses, size = factor.blocks.shape[0], factor.border.shape[0]
    inverse = empty_arrow(poses, size)
    triangle = invert_factor(factor.border)
    inverse.border[:] = triangle.T @ triangle
    for p in range(poses):
        lower = invert_factor(factor.blocks[p].copy())
        gain = lower.T @ factor.coupling[p].copy()  # - d(pose) / d(border)
        across = gain @ inverse.border
        inverse.coupling[p] = -across
        inverse.blocks[p] = lower.T @ lower + across @ gain.T
    return inverse
