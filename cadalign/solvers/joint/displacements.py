"""Displacements of points that one pose sees, eliminated from its equations.

Of the displacement d of a point, with the prior N(0, spread^2 I), the equations
``r + J dx + D (e - d)``, with e the displacement to find, have the covariance I + spread^2 D D'
about ``r - D d + J dx``. Whitening them by its Cholesky factor L leaves least squares in x alone,
and ``e = -spread^2 D' L^-T (whitened residual)`` follows.
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import borrowing, kernel
from cadalign.solvers.joint.equations import JointEquations
from cadalign.solvers.joint.evidence import Evidence, State
from cadalign.solvers.linalg import cholesky


@kernel
def eliminate(evidence: Evidence, state: State, equations: JointEquations) -> float:
    """Whiten the equations of points with displacements; returns the cost of their prior."""
    spread, rows, columns = evidence.shape.spread, equations.rows, equations.columns
    last = rows.shape[0] - 4
    cost = 0.0
    for i in range(spread.shape[0]):
        start, end = columns[i, 0], columns[i, 1]
        if start == end or not spread[i] > 0:
            continue
        for a in range(3):
            displacement = state.displacements[i, a]
            cost += (displacement / spread[i]) ** 2
            for c in range(start, end):
                rows[last, c] -= rows[last + 1 + a, c] * displacement
        equations.log_determinant[0] += _whiten(
            rows, start, end, spread[i], np.empty((end - start, end - start))
        )
    return cost


@borrowing
def _whiten(rows: FloatArray, start: int, end: int, spread: float, factor: FloatArray) -> float:
    """Whiten the columns of one point; returns the log determinant of their covariance."""
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


@borrowing
def shift_means(evidence: Evidence, equations: JointEquations) -> None:
    """Move the displacements' prior means as the slopes of the log determinant do."""
    spread, rows, columns = evidence.shape.spread, equations.rows, equations.columns
    unknowns = rows.shape[0] - 4
    for i in range(spread.shape[0]):
        if not spread[i] > 0:
            continue
        for c in range(columns[i, 0], columns[i, 1]):
            moved = 0.0
            for a in range(3):
                moved -= spread[i] ** 2 * rows[unknowns + 1 + a, c] * equations.slopes[i, a]
            rows[unknowns, c] += moved
            for k in range(unknowns):
                equations.gradient[k] += rows[k, c] * moved


@borrowing
def follow(evidence: Evidence, equations: JointEquations, step: FloatArray, moved: State) -> None:
    """Write the displacements that are best after a step."""
    spread, rows, columns = evidence.shape.spread, equations.rows, equations.columns
    unknowns = step.shape[0]
    for i in range(spread.shape[0]):
        start, end = columns[i, 0], columns[i, 1]
        if start == end or not spread[i] > 0:
            continue
        for a in range(3):
            moved.displacements[i, a] = -(spread[i] ** 2) * equations.slopes[i, a]
        for c in range(start, end):
            residual = rows[unknowns, c]
            for k in range(unknowns):
                residual += rows[k, c] * step[k]
            residual *= -(spread[i] ** 2)
            for a in range(3):
                moved.displacements[i, a] += residual * rows[unknowns + 1 + a, c]
