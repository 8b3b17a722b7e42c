"""Mesh previews: models in few triangles and lines, light enough for a page."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray
from cadalign.geometry.clustering import merge_vertices
from cadalign.geometry.mesh import Mesh
from cadalign.io.files import dense_json, write_text

MAX_FACES = 1500
MAX_EDGES = 1500
_FINEST = 1 << 15  # cells along the longest side: the steps of 16-bit coordinates
_COARSEST = 4
_FIRST_TRY = 96
_SHRINK = 0.88
_CREASE_DEG = 30.0


@dataclass(frozen=True, eq=False)
class MeshPreview:
    """A simplified model.

    Parameters
    ----------
    vertices : (n, 3) float
        [model units]
    faces : (m, 3) int
    edges : (k, 2) int
        Pairs of vertices for a wireframe: what is too thin for triangles, creases and borders.
    """

    vertices: FloatArray
    faces: IntArray
    edges: IntArray

    def to_dict(self) -> dict[str, Any]:
        """The preview for JSON: arrays as base64, little-endian; vertex = lo + step * uint16."""
        placed = self.vertices if len(self.vertices) else np.zeros((1, 3))
        low = placed.min(axis=0)
        step = np.maximum(np.ptp(placed, axis=0), 1e-12) / (2 * _FINEST - 1)
        wide = len(self.vertices) > 2 * _FINEST
        index = "<u4" if wide else "<u2"
        return {
            "lo": low.tolist(),
            "step": step.tolist(),
            "vertices": _base64(np.round((self.vertices - low) / step), "<u2"),
            "faces": _base64(self.faces, index),
            "edges": _base64(self.edges, index),
            "wide": wide,
        }


def preview_of(
    mesh: Mesh, *, max_faces: int = MAX_FACES, max_edges: int = MAX_EDGES
) -> MeshPreview:
    """Simplify a mesh by merging the vertices in each cell of a grid.

    The finest grid is taken that leaves few enough triangles; a mesh that has few is kept as it is.

    Parameters
    ----------
    mesh : Mesh
    max_faces, max_edges : int
        Largest numbers of triangles and lines.

    Examples
    --------
    >>> square = Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    >>> preview = preview_of(square)
    >>> len(preview.faces), len(preview.edges)  # the diagonal is no crease
    (2, 4)
    """
    vertices, faces, wires = _merged(mesh.vertices, mesh.faces, _FINEST)
    cells = float(_FIRST_TRY)
    while len(faces) > max_faces and cells > _COARSEST:
        vertices, faces, wires = _merged(mesh.vertices, mesh.faces, cells)
        cells *= _SHRINK
    # Only where even the coarsest grid has too many: the largest ones.
    largest = np.argsort(-np.linalg.norm(_normals(vertices, faces), axis=1), kind="stable")
    faces = faces[np.sort(largest[:max_faces])]
    edges = np.concatenate([wires, _feature_edges(vertices, faces)])
    return MeshPreview(vertices, faces, edges[:max_edges])


def write_preview(path: Path, mesh: Mesh) -> None:
    """Write a preview of a mesh as JSON.

    Raises
    ------
    DataError
        If the file cannot be written.
    """
    write_text(path, dense_json(preview_of(mesh).to_dict()))


def _merged(
    vertices: FloatArray, faces: IntArray, cells: float
) -> tuple[FloatArray, IntArray, IntArray]:
    """Vertices of one cell become their mean; gives vertices, triangles, and what is only lines.

    Of triangles in one place one is left. One that becomes a line is a wire if no triangle has that
    side: so masts and railings don't vanish.
    """
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    low, size = vertices.min(axis=0), float(np.ptp(vertices, axis=0).max())
    places = np.floor((vertices - low) * (cells / max(size, 1e-300)) + 0.5).astype(np.int64)
    centers, cell = merge_vertices(vertices, places)
    faces = cell[faces]
    ordered = np.sort(faces, axis=1)
    solid = (ordered[:, 0] != ordered[:, 1]) & (ordered[:, 1] != ordered[:, 2])
    _, first = np.unique(ordered[solid], axis=0, return_index=True)
    thin = ordered[~solid][:, [0, 2]]
    thin = np.unique(thin[thin[:, 0] != thin[:, 1]], axis=0)
    faces = faces[solid][np.sort(first)]
    sides = _sides(faces)
    wires = thin[~np.isin(thin @ [len(centers), 1], sides @ [len(centers), 1])]
    kept, places = np.unique(np.concatenate([faces.ravel(), wires.ravel()]), return_inverse=True)
    faces, wires = np.split(places, [faces.size])
    return centers[kept], faces.reshape(-1, 3), wires.reshape(-1, 2)


def _sides(faces: IntArray) -> IntArray:
    """The sides of triangles, (3 m, 2) int, the lower vertex first."""
    return np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)


def _normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Normals of the triangles with twice their area as length, (m, 3) float."""
    corners = vertices[faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _feature_edges(vertices: FloatArray, faces: IntArray) -> IntArray:
    """Edges where the surface bends or ends, (k, 2) int, the longest first."""
    if not len(faces):
        return np.empty((0, 2), dtype=np.int64)
    normals = _normals(vertices, faces)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    edges, edge, count = np.unique(_sides(faces), axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(edge.ravel(), kind="stable")
    owner = np.tile(np.arange(len(faces)), 3)[order]
    start = np.concatenate([[0], np.cumsum(count)[:-1]])
    flat = np.zeros(len(edges), dtype=bool)
    pairs = count == 2
    first, second = owner[start[pairs]], owner[start[pairs] + 1]
    # Files do not agree on which way triangles face.
    bend = np.abs((normals[first] * normals[second]).sum(axis=1))
    flat[pairs] = bend > np.cos(np.radians(_CREASE_DEG))
    edges = edges[~flat]
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    return np.asarray(edges[np.argsort(-length, kind="stable")])


def _base64(values: npt.NDArray[Any], kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode("ascii")
