"""Edges of triangle meshes: adjacent triangles and creases, and rows that coincide."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class MeshEdges:
    """The edges of a triangle mesh.

    ``ends`` (e, 2) are vertices, the lower number first; ``opposite`` (e, 2) the third vertices of
    two triangles at the edge, the same one twice at a border. ``creased`` (e,) are borders, edges
    of more than two triangles, and edges at which the surface bends.
    """

    ends: IntArray
    opposite: IntArray
    creased: BoolArray


def mesh_edges(vertices: FloatArray, faces: IntArray, *, crease_angle: float) -> MeshEdges:
    """Find the edges of a mesh whose triangles, sharing vertices, may face either way.

    Triangles whose planes meet at a larger angle than ``crease_angle`` [degrees] make a crease.

    Examples
    --------
    >>> square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    >>> edges = mesh_edges(square, np.array([[0, 1, 2], [0, 2, 3]]), crease_angle=30)
    >>> edges.ends[~edges.creased].tolist(), edges.opposite[~edges.creased].tolist()
    ([[0, 2]], [[1, 3]])
    """
    sides = triangle_sides(faces)
    key = sides @ [len(vertices), 1]
    order = np.argsort(key, kind="stable")
    _, first, count = np.unique(key[order], return_index=True, return_counts=True)
    pair = order[np.stack([first, first + np.minimum(1, count - 1)], axis=1)]
    beside = pair // 3
    a, b, c = vertices[faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    cosine = np.abs(np.einsum("ek,ek->e", normals[beside[:, 0]], normals[beside[:, 1]]))
    creased = (count != 2) | (cosine < np.cos(np.radians(crease_angle)))
    return MeshEdges(sides[pair[:, 0]], faces[:, [2, 0, 1]].ravel()[pair], creased)


def triangle_sides(faces: IntArray) -> IntArray:
    """The sides of triangles, (3 m, 2) int, three after each other, the lower vertex first."""
    return np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)


def number_rows(rows: npt.NDArray[np.float64] | npt.NDArray[np.int64]) -> IntArray:
    """Number the distinct rows of an (n, 3) array; (n,) int, equal for equal rows."""
    # Adding 0 turns -0.0 into 0.0, which has other bytes.
    packed = np.ascontiguousarray(rows + 0).view(np.dtype((np.void, 3 * rows.itemsize))).ravel()
    return np.asarray(np.unique(packed, return_inverse=True)[1].ravel(), dtype=np.int64)


def first_of_each(rows: IntArray) -> IntArray:
    """Find the first occurrence of each distinct row (m, 3), in order of occurrence."""
    order = np.lexsort(rows.T)  # stable, and 10 times as fast as np.unique
    ordered = rows[order]
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    return np.sort(order[new])
