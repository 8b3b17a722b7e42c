"""Fewer modes: those that the evidence tells apart.

Modes move the s points that the evidence names in at most 3 s directions. In an orthonormal basis
of these, coefficients ``c = basis @ reduced`` plus a rest that moves no such point: the rest keeps
its standard normal prior, and the reduced coefficients have one, too. Estimates, costs and
determinants are those of all modes. Of several poses, the displacements of sighted points are modes
as well, three for each, before the basis is chosen.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.compile import fast_sums, kernel
from cadalign.solvers.joint.evidence import Evidence, Shape, State, count_poses, with_shape

_LEAST_SQUARE = 1e-14  # of a direction's rest, over the largest
_LOST = 0.01  # of a direction's square: less asks for a second pass


class Reduction(NamedTuple):
    """Evidence with reduced modes, and their ``basis`` (K + 3 u, r) in the evidence's own.

    Rows K + 3 j + a belong to the displacement along axis a of point ``displaced[j]`` (u,).
    """

    evidence: Evidence
    basis: FloatArray
    displaced: IntArray


@kernel
def reduce_modes(evidence: Evidence) -> Reduction:
    """The evidence with modes in the directions that it tells apart."""
    shape = evidence.shape
    modes, points = shape.modes.shape[0], shape.modes.shape[1]
    used = used_points(evidence)
    displaced = np.empty(0, dtype=np.int64)
    if count_poses(evidence) > 1:
        displaced = np.flatnonzero(sighted_points(evidence) & (shape.spread > 0.0))
    extra = 3 * displaced.shape[0]
    if 3 * used.sum() >= modes + extra and not extra:
        return Reduction(evidence, np.eye(modes), displaced)
    whole = np.zeros((modes + extra, points, 3))
    whole[:modes] = shape.modes
    spread = shape.spread.copy()
    for j in range(displaced.shape[0]):
        for a in range(3):
            whole[modes + 3 * j + a, displaced[j], a] = shape.spread[displaced[j]]
        spread[displaced[j]] = 0.0
    if 3 * used.sum() >= modes + extra:
        return Reduction(
            with_shape(evidence, Shape(shape.mean, whole, spread)), np.eye(modes + extra), displaced
        )
    directions = np.empty((3 * used.sum(), modes + extra))
    row = 0
    for i in range(points):
        if used[i]:
            for a in range(3):
                for k in range(modes + extra):
                    directions[row, k] = whole[k, i, a]
                row += 1
    basis = directions[: _orthonormalize(directions)]
    flat = whole.reshape((modes + extra, 3 * points))
    reduced = (basis @ flat).reshape((basis.shape[0], points, 3))
    return Reduction(
        with_shape(evidence, Shape(shape.mean, reduced, spread)),
        np.ascontiguousarray(basis.T),
        displaced,
    )


def reduced_state(reduction: Reduction, whole: Shape, state: State) -> State:
    """A state in reduced coefficients; ``whole`` is the shape that was reduced."""
    displaced = reduction.displaced
    moved = state.displacements[displaced] / whole.spread[displaced, None]
    displacements = state.displacements.copy()
    displacements[displaced] = 0.0
    given = np.concatenate([state.coefficients, moved.ravel()])
    return state._replace(
        coefficients=given @ reduction.basis,
        displacements=displacements,
    )


def reduced(evidence: Evidence, state: State) -> tuple[Evidence, State]:
    """The evidence in reduced modes, and a state of it."""
    reduction = reduce_modes(evidence)
    return reduction.evidence, reduced_state(reduction, evidence.shape, state)


def whole_state(reduction: Reduction, whole: Shape, state: State) -> State:
    """The state in the coefficients and displacements of the shape that was reduced."""
    modes, displaced = len(whole.modes), reduction.displaced
    given = reduction.basis @ state.coefficients
    displacements = state.displacements.copy()
    displacements[displaced] = given[modes:].reshape(-1, 3) * whole.spread[displaced, None]
    return state._replace(coefficients=given[:modes], displacements=displacements)


@kernel
def used_points(evidence: Evidence) -> BoolArray:
    """True for the points (m,) that a piece of evidence names."""
    used = sighted_points(evidence)
    ends = evidence.offsets.ends
    for i in evidence.planes.point:
        used[i] = True
    for j in range(ends.shape[0]):
        for end in range(2):
            if ends[j, end] >= 0:
                used[ends[j, end]] = True
    return used


@kernel
def sighted_points(evidence: Evidence) -> BoolArray:
    """True for the points (m,) that are sighted."""
    sighted = np.zeros(evidence.shape.mean.shape[0], dtype=np.bool_)
    for i in evidence.sightings.point:
        sighted[i] = True
    return sighted


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
