"""Fewer modes: those that the evidence tells apart.

Modes move the s points that the evidence names in at most 3 s directions. In an orthonormal basis
of these, coefficients ``c = basis @ reduced`` plus a rest that moves no such point: the rest keeps
its standard normal prior, and the reduced coefficients have one, too. Estimates, costs and
determinants are those of all modes.
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.compile import fast_sums, kernel
from cadalign.solvers.joint.evidence import Evidence, Shape

_LEAST_SQUARE = 1e-14  # of a direction's rest, over the largest
_LOST = 0.01  # of a direction's square: less asks for a second pass


@kernel
def reduce_modes(evidence: Evidence) -> tuple[Evidence, FloatArray]:
    """The evidence with modes in the directions that it tells apart, and their basis (K, r)."""
    shape = evidence.shape
    modes, points = shape.modes.shape[0], shape.modes.shape[1]
    used = used_points(evidence)
    if 3 * used.sum() >= modes:
        return evidence, np.eye(modes)
    directions = np.empty((3 * used.sum(), modes))
    row = 0
    for i in range(points):
        if used[i]:
            for a in range(3):
                for k in range(modes):
                    directions[row, k] = shape.modes[k, i, a]
                row += 1
    basis = directions[: _orthonormalize(directions)]
    flat = np.ascontiguousarray(shape.modes).reshape((modes, 3 * points))
    reduced = (basis @ flat).reshape((basis.shape[0], points, 3))
    return Evidence(
        Shape(shape.mean, reduced, shape.spread),
        evidence.sightings,
        evidence.rig,
        evidence.directions,
        evidence.lengths,
        evidence.heights,
        evidence.planes,
        evidence.scales,
    ), np.ascontiguousarray(basis.T)


@kernel
def used_points(evidence: Evidence) -> BoolArray:
    """True for the points (m,) that a piece of evidence names."""
    used = np.zeros(evidence.shape.mean.shape[0], dtype=np.bool_)
    lengths = evidence.lengths.points
    for named in (evidence.sightings.point, evidence.heights.point, evidence.planes.point):
        for i in named:
            used[i] = True
    for j in range(lengths.shape[0]):
        used[lengths[j, 0]] = used[lengths[j, 1]] = True
    return used


@fast_sums
def _squared(row: FloatArray) -> float:
    total = 0.0
    for k in range(row.shape[0]):
        total += row[k] * row[k]
    return total


@fast_sums
def _subtract(unit: FloatArray, row: FloatArray) -> float:
    """Take the part along a unit vector off a row; returns its length."""
    product = 0.0
    for k in range(row.shape[0]):
        product += unit[k] * row[k]
    for k in range(row.shape[0]):
        row[k] -= product * unit[k]
    return product


@fast_sums
def _orthonormalize(rows: FloatArray) -> int:
    """Turn the first rows of a matrix into an orthonormal basis of them all; returns its rank.

    Gram and Schmidt's method, the longest rest first, with a second pass for rows that lost most of
    their length.
    """
    count, size = rows.shape
    squares = np.empty(count)
    for i in range(count):
        squares[i] = _squared(rows[i])
    wholes = squares.copy()
    least = _LEAST_SQUARE * squares.max() if count else 0.0
    for rank in range(count):
        best = rank
        for i in range(rank + 1, count):
            if squares[i] > squares[best]:
                best = i
        if not squares[best] > least:
            return rank
        for k in range(size):
            rows[rank, k], rows[best, k] = rows[best, k], rows[rank, k]
        whole = wholes[best]
        squares[best], wholes[best] = squares[rank], wholes[rank]
        square = _squared(rows[rank])
        if square < _LOST * whole:
            for i in range(rank):
                _subtract(rows[i], rows[rank])
            square = _squared(rows[rank])
        factor = 1.0 / np.sqrt(square)
        for k in range(size):
            rows[rank, k] *= factor
        for i in range(rank + 1, count):
            squares[i] -= _subtract(rows[rank], rows[i]) ** 2
    return int(count)
