"""Fewer triangles for display: vertices of a grid cell become one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.geometry.clustering import merge_vertices
from cadalign.geometry.mesh import Mesh

_MOST_CELLS = float(1 << 20)  # along an axis, so that a cell's number fits into 63 bits
_FACES_PER_CELL = 9.4  # over the number of cells along an axis, squared: a sphere's
_MOST_TRIES = 6


@dataclass(frozen=True, eq=False)
class Simplified:
    """A mesh with fewer triangles.

    Parameters
    ----------
    vertices : (n, 3) float
        [model units]
    faces : (m, 3) int
    source : (m,) int
        The triangle of the full mesh that each one stands for.
    """

    vertices: FloatArray
    faces: IntArray
    source: IntArray


def simplify(mesh: Mesh, *, max_faces: int) -> Simplified:
    """Make a mesh of at most so many triangles; unchanged if it has no more.

    Vertices in the same cell of a grid become one; the grid is made coarser or finer until about as
    many triangles are left as may be.

    Parameters
    ----------
    mesh : Mesh
    max_faces : int
        At least 1.

    Examples
    --------
    >>> mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    >>> simplify(mesh, max_faces=10).faces.tolist()
    [[0, 1, 2]]
    """
    if len(mesh.faces) <= max_faces:
        return Simplified(mesh.vertices, mesh.faces, np.arange(len(mesh.faces)))
    best = Simplified(mesh.vertices, mesh.faces[:max_faces], np.arange(max_faces))
    cells = np.sqrt(max_faces / _FACES_PER_CELL)
    for _ in range(_MOST_TRIES):
        result = _clustered(mesh, min(cells, _MOST_CELLS))
        count = len(result.faces)
        if count <= max_faces:
            if count > 0:
                best = result
            if count > max_faces / 2:
                break
        # The number of triangles goes with the square of the number of cells.
        cells *= np.sqrt(0.8 * max_faces / max(count, 1))
    return best


def _clustered(mesh: Mesh, cells: float) -> Simplified:
    """Merge the vertices of each cell, with ``cells`` of them along the longest side."""
    low, high = mesh.bounds
    size = float((high - low).max()) or 1.0
    # Vertices that no face uses may lie anywhere.
    place = np.clip((mesh.vertices - low) / size, 0, 1) * cells
    vertices, cluster = merge_vertices(mesh.vertices, place.astype(np.int64))
    faces = cluster[mesh.faces]
    a, b, c = faces.T
    kept = np.flatnonzero((a != b) & (b != c) & (c != a))
    kept = kept[_first_of_each(np.sort(faces[kept], axis=1))]
    return Simplified(vertices, faces[kept], kept)


def _first_of_each(rows: IntArray) -> IntArray:
    """Where each different row (m, 3) occurs first, in order; `np.unique` takes 10 times longer."""
    order = np.lexsort(rows.T)  # stable: of equal rows the first stays first
    ordered = rows[order]
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    return np.sort(order[new])
