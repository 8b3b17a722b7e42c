"""Edges of triangle meshes, and simplification by vertex clustering."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.geometry.mesh import Mesh, face_normals

FINEST = float(1 << 20)
"""Largest number of cells along an axis: a cell's number must fit into 63 bits."""

_CELL_NUMBER = np.array([1 << 42, 1 << 21, 1])
_FACES_PER_CELL = 9.4  # faces of a sphere over the squared number of cells along an axis
_MOST_TRIES = 6


@dataclass(frozen=True, eq=False)
class MeshEdges:
    """The edges of a triangle mesh.

    ``ends`` (e, 2) are vertex numbers, the lower one first. ``opposite`` (e, 2) are the third
    vertices of the two triangles at the edge, the same vertex twice at a border. ``creased`` (e,)
    marks borders, edges of more than two triangles, and edges at which the surface bends.
    """

    ends: IntArray
    opposite: IntArray
    creased: BoolArray


def mesh_edges(vertices: FloatArray, faces: IntArray, *, crease_angle: float) -> MeshEdges:
    """Find the edges of a mesh; its triangles may have either orientation.

    An edge is creased if its triangles' planes meet at more than ``crease_angle`` [degrees].
    """
    sides = triangle_sides(faces)
    key = sides @ [len(vertices), 1]
    order = np.argsort(key, kind="stable")
    _, first, count = np.unique(key[order], return_index=True, return_counts=True)
    pair = order[np.stack([first, first + np.minimum(1, count - 1)], axis=1)]
    beside = pair // 3
    normals = face_normals(vertices[faces])
    cosine = np.abs(np.einsum("ek,ek->e", normals[beside[:, 0]], normals[beside[:, 1]]))
    creased = (count != 2) | (cosine < np.cos(np.radians(crease_angle)))
    return MeshEdges(sides[pair[:, 0]], faces[:, [2, 0, 1]].ravel()[pair], creased)


def triangle_sides(faces: IntArray) -> IntArray:
    """Sides of triangles (m, 3), three rows for each, (3 m, 2) int; the lower vertex first."""
    return np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)


def number_rows(rows: npt.NDArray[np.float64] | npt.NDArray[np.int64]) -> IntArray:
    """Number the distinct rows of an (n, 3) array; (n,) int, equal for equal rows."""
    # Adding 0 turns -0.0 into 0.0; their bytes differ.
    packed = np.ascontiguousarray(rows + 0).view(np.dtype((np.void, 3 * rows.itemsize))).ravel()
    return np.asarray(np.unique(packed, return_inverse=True)[1].ravel(), dtype=np.int64)


@dataclass(frozen=True, eq=False)
class SimplifiedMesh:
    """A simplified mesh.

    ``source`` (m,) is the number of a triangle of the full mesh that each triangle replaces.
    ``wires`` (k, 2) are lines that remain of thin parts; they are not sides of triangles.
    """

    vertices: FloatArray
    faces: IntArray
    source: IntArray
    wires: IntArray = field(default_factory=lambda: np.empty((0, 2), dtype=np.int64))


def cluster(mesh: Mesh, *, cells: float) -> SimplifiedMesh:
    """Simplify a mesh: merge the vertices in each cell of a grid into their mean.

    See Rossignac, Borrel, "Multi-resolution 3D approximations for rendering complex scenes" (1993).
    Of coincident triangles the first is kept. Triangles that become lines are kept as wires, so
    that masts and railings don't vanish; those that become points are dropped. ``cells``, at most
    `FINEST`, is the number of cells along the longest side of the mesh.
    """
    used = mesh.is_used
    vertices = mesh.vertices[used]
    faces = (np.cumsum(used) - 1)[mesh.faces]
    low, size = vertices.min(axis=0), float(np.ptp(vertices, axis=0).max())
    cell = np.floor((vertices - low) * (cells / max(size, 1e-300)) + 0.5).astype(np.int64)
    number, place, count = np.unique(cell @ _CELL_NUMBER, return_inverse=True, return_counts=True)
    sums = [np.bincount(place, weights=axis, minlength=len(count)) for axis in vertices.T]
    centers = np.stack(sums, axis=1) / count[:, None]
    faces = place[faces]
    ordered = np.sort(faces, axis=1)
    solid = (ordered[:, 0] != ordered[:, 1]) & (ordered[:, 1] != ordered[:, 2])
    kept = np.flatnonzero(solid)
    _, first = np.unique(number_rows(ordered[kept]), return_index=True)
    kept = kept[np.sort(first)]
    # Encode each pair of vertices as one number.
    thin = np.unique(ordered[~solid][:, [0, 2]] @ [len(number), 1])
    thin = thin[thin // len(number) != thin % len(number)]
    thin = thin[~np.isin(thin, triangle_sides(faces[kept]) @ [len(number), 1])]
    wires = np.stack([thin // len(number), thin % len(number)], axis=1)
    remaining = np.concatenate([faces[kept].ravel(), wires.ravel()])
    remaining, place = np.unique(remaining, return_inverse=True)
    corners, ends = np.split(place, [3 * len(kept)])
    return SimplifiedMesh(centers[remaining], corners.reshape(-1, 3), kept, ends.reshape(-1, 2))


def simplify(mesh: Mesh, *, max_faces: int) -> SimplifiedMesh:
    """Simplify a mesh to at most ``max_faces`` triangles by `cluster`.

    The grid's resolution is adapted until the number of triangles is near the maximum. If no grid
    satisfies the maximum, the first ``max_faces`` triangles of the mesh are returned.
    """
    if len(mesh.faces) <= max_faces:
        return SimplifiedMesh(mesh.vertices, mesh.faces, np.arange(len(mesh.faces)))
    best, most = None, 0
    cells = np.sqrt(max_faces / _FACES_PER_CELL)
    for _ in range(_MOST_TRIES):
        result = cluster(mesh, cells=min(cells, FINEST))
        count = len(result.faces)
        if most < count <= max_faces:
            best, most = result, count
        if 0.6 * max_faces < count <= max_faces:
            break
        # The number of triangles is proportional to the squared number of cells.
        cells *= np.sqrt(0.8 * max_faces / max(count, 1))
    if best is not None:
        return best
    return SimplifiedMesh(mesh.vertices, mesh.faces[:max_faces], np.arange(max_faces))
