"""Normal equations of a joint estimate.

The displacement d of a point, with the prior N(0, spread^2 I), is eliminated: its equations
``r + J dx + D (e - d)``, with e the displacement to find, have the covariance I + spread^2 D D'
about ``r - D d + J dx``. Whitening them by its Cholesky factor leaves least squares in x alone, and
``e = -spread^2 D' L^-T (whitened residual)`` follows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import fast_sums, kernel
from cadalign.solvers.joint.evidence import Evidence, State, count_unknowns
from cadalign.solvers.joint.planes import add_heights, add_planes
from cadalign.solvers.joint.priors import add_directions, add_lengths, add_priors
from cadalign.solvers.joint.rows import count_equations, write_rows
from cadalign.solvers.linalg import cholesky


class System(NamedTuple):
    """Normal equations of U unknowns, with the displacements eliminated.

    ``rows`` (U + 4, C) holds the derivatives by the unknowns, the residuals, and the derivatives by
    the displacement of the point, whitened; ``first`` (N + 1,) the columns at which each sighting
    begins; ``hessian`` (U, U), ``gradient`` (U,); ``log_determinant`` (1,) is that of the
    covariances by which the displacements widened the equations.
    """

    rows: FloatArray
    first: IntArray
    hessian: FloatArray
    gradient: FloatArray
    log_determinant: FloatArray


@kernel
def empty_system(evidence: Evidence) -> System:
    """Room for the normal equations."""
    sightings = evidence.sightings
    unknowns = count_unknowns(evidence, evidence.shape.modes.shape[0])
    count = sightings.point.shape[0]
    first = np.zeros(count + 1, dtype=np.int64)
    for n in range(count):
        first[n + 1] = first[n] + count_equations(sightings, n)
    return System(
        np.empty((unknowns + 4, first[count])),
        first,
        np.empty((unknowns, unknowns)),
        np.empty(unknowns),
        np.empty(1),
    )


@kernel
def evaluate_joint(evidence: Evidence, state: State, system: System) -> float:
    """Write the normal equations at a state; returns the cost, infinite behind a camera."""
    unknowns = system.gradient.shape[0]
    cost = write_rows(evidence, state, system.rows, unknowns)
    if not cost < np.inf:
        return np.inf
    cost += _eliminate(evidence, state, system)
    _products(system.rows, unknowns, system.hessian, system.gradient)
    cost += add_priors(evidence, state, system.hessian, system.gradient)
    cost += add_directions(evidence, state, system.hessian, system.gradient)
    cost += add_lengths(evidence, state, system.hessian, system.gradient)
    cost += add_heights(evidence, state, system.hessian, system.gradient)
    cost += add_planes(evidence, state, system.hessian, system.gradient)
    for k in range(unknowns):
        for m in range(k):
            system.hessian[k, m] = system.hessian[m, k]
    first = unknowns - evidence.shape.modes.shape[0] - 3
    for a in range(3):
        if evidence.scales.free[a] == 0.0:
            k = first + a
            system.gradient[k] = 0.0
            for m in range(unknowns):
                system.hessian[k, m] = system.hessian[m, k] = 0.0
            system.hessian[k, k] = 1.0
    return cost


@kernel
def _eliminate(evidence: Evidence, state: State, system: System) -> float:
    """Whiten the equations of points with displacements; returns the cost of their prior."""
    spread, sightings, rows, first = (
        evidence.shape.spread,
        evidence.sightings,
        system.rows,
        system.first,
    )
    unknowns = system.gradient.shape[0]
    cost = 0.0
    system.log_determinant[0] = 0.0
    count = sightings.point.shape[0]
    n = 0
    while n < count:
        i = sightings.point[n]
        start = first[n]
        while n < count and sightings.point[n] == i:
            n += 1
        if not spread[i] > 0:
            continue
        for a in range(3):
            displacement = state.displacements[i, a]
            cost += (displacement / spread[i]) ** 2
            for c in range(start, first[n]):
                rows[unknowns, c] -= rows[unknowns + 1 + a, c] * displacement
        system.log_determinant[0] += _whiten(
            rows, start, first[n], spread[i], np.empty((first[n] - start, first[n] - start))
        )
    return cost


@kernel
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


@fast_sums
def _products(rows: FloatArray, unknowns: int, hessian: FloatArray, gradient: FloatArray) -> None:
    """Write the upper triangle of J' W J and J' W r."""
    columns = rows.shape[1]
    for k in range(unknowns):
        for m in range(k, unknowns + 1):
            total = 0.0
            for c in range(columns):
                total += rows[k, c] * rows[m, c]
            if m < unknowns:
                hessian[k, m] = total
            else:
                gradient[k] = total
