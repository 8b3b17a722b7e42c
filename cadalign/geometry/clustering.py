"""Vertices that share a cell of a grid become one: the step of every simplification here."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray, IntArray

_NUMBER_CELLS = np.array([1 << 42, 1 << 21, 1])


def merge_vertices(vertices: FloatArray, cells: IntArray) -> tuple[FloatArray, IntArray]:
    """Replace the vertices in each cell by their mean.

    As in Rossignac, Borrel, "Multi-resolution 3D approximations for rendering complex scenes"
    (1993).

    Parameters
    ----------
    vertices : (n, 3) float
    cells : (n, 3) int
        The cell that each lies in, from 0 to 2^21 - 1 along each axis.

    Returns
    -------
    centers : (m, 3) float
        In the order of their cells.
    place : (n,) int
        Which of them each vertex has become.

    Examples
    --------
    >>> vertices = np.array([[0.0, 0, 0], [4, 0, 0], [2, 0, 0]])
    >>> centers, place = merge_vertices(vertices, np.array([[0, 0, 0], [1, 0, 0], [0, 0, 0]]))
    >>> centers[:, 0].tolist(), place.tolist()
    ([1.0, 4.0], [0, 1, 0])
    """
    _, place, count = np.unique(cells @ _NUMBER_CELLS, return_inverse=True, return_counts=True)
    sums = [np.bincount(place, weights=axis, minlength=len(count)) for axis in vertices.T]
    return np.stack(sums, axis=1) / count[:, None], place
