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
from cadalign.compile import fast_sums
from cadalign.solvers.joint.evidence import Evidence, Shape, State, packed

_LEAST_SQUARE = 1e-14  # of a direction's rest, over the largest
_LOST = 0.01  # of a direction's square: less asks for a second pass


class Reduction(NamedTuple):
    """Evidence with reduced modes, and their ``basis`` (K + 3 u, r) in the evidence's own.

    Rows K + 3 j + a belong to the displacement along axis a of point ``displaced[j]`` (u,).
    """

    evidence: Evidence
    basis: FloatArray
    displaced: IntArray


def reduce_modes(evidence: Evidence) -> Reduction:
    """The evidence with modes in the directions that it tells apart."""
    shape, modes = evidence.shape, len(evidence.shape.modes)
    sighted = sighted_points(evidence)
    displaced = np.empty(0, dtype=np.int64)
    if evidence.rig.pose.max() > 0:
        displaced = np.flatnonzero(sighted & (shape.spread > 0))
    size = modes + 3 * len(displaced)
    used = used_points(evidence)
    is_small = size <= 3 * used.sum()
    if is_small and not len(displaced):
        return Reduction(evidence, np.eye(modes), displaced)
    whole, spread = np.zeros((size, *shape.mean.shape)), shape.spread.copy()
    whole[:modes] = shape.modes
    rows, axes = np.repeat(displaced, 3), np.tile(np.arange(3), len(displaced))
    whole[np.arange(modes, size), rows, axes] = spread[rows]
    spread[displaced] = 0.0
    basis = np.eye(size)
    if not is_small:
        directions = np.ascontiguousarray(whole[:, used].reshape(size, -1).T)
        basis = directions[: _orthonormalize(directions)]
        whole = (basis @ whole.reshape(size, -1)).reshape(-1, *shape.mean.shape)
    reduced = evidence._replace(shape=Shape(shape.mean, whole, spread))
    return Reduction(reduced, np.ascontiguousarray(basis.T), displaced)


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


def reduced_row(evidence: Evidence, state: State) -> tuple[Reduction, FloatArray]:
    """The reduction of evidence, and a state in it as a row of numbers."""
    reduction = reduce_modes(evidence)
    return reduction, packed(reduced_state(reduction, evidence.shape, state))


def whole_state(reduction: Reduction, whole: Shape, state: State) -> State:
    """The state in the coefficients and displacements of the shape that was reduced."""
    modes, displaced = len(whole.modes), reduction.displaced
    given = reduction.basis @ state.coefficients
    displacements = state.displacements.copy()
    displacements[displaced] = given[modes:].reshape(-1, 3) * whole.spread[displaced, None]
    return state._replace(coefficients=given[:modes], displacements=displacements)


def used_points(evidence: Evidence) -> BoolArray:
    """True for the points (m,) that a piece of evidence names."""
    used, ends = sighted_points(evidence), evidence.offsets.ends
    used[evidence.planes.point] = used[ends[ends >= 0]] = True
    return used


def sighted_points(evidence: Evidence) -> BoolArray:
    """True for the points (m,) that are sighted."""
    sighted = np.zeros(len(evidence.shape.mean), dtype=bool)
    sighted[evidence.sightings.point] = True
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
