"""Mesh previews: models in few triangles and lines, light enough for a page."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray
from cadalign.geometry.edges import mesh_edges
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.simplify import cluster, simplify
from cadalign.io.files import dense_json, write_text

MAX_FACES = 1500
MAX_EDGES = 1500
_FINEST = 1 << 15  # cells along the longest side: the steps of 16-bit coordinates
_CREASE_DEG = 30.0


@dataclass(frozen=True, eq=False)
class MeshPreview:
    """A simplified model [model units].

    ``edges`` are pairs of vertices for a wireframe: parts too thin for triangles, creases and
    borders.
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
    """Simplify a mesh to at most so many triangles and lines, by merging vertices on a grid.

    Examples
    --------
    >>> square = Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    >>> preview = preview_of(square)
    >>> len(preview.faces), len(preview.edges)  # the diagonal is no crease
    (2, 4)
    """
    small = cluster(mesh, cells=_FINEST)
    if len(small.faces) > max_faces:
        small = simplify(mesh, max_faces=max_faces)
    edges = mesh_edges(small.vertices, small.faces, crease_angle=_CREASE_DEG)
    creases = edges.ends[edges.creased]
    length = np.linalg.norm(small.vertices[creases[:, 0]] - small.vertices[creases[:, 1]], axis=1)
    longest = creases[np.argsort(-length, kind="stable")]
    lines = np.concatenate([small.wires, longest])[:max_edges]
    return MeshPreview(small.vertices, small.faces, lines)


def write_preview(path: Path, mesh: Mesh) -> None:
    """Write a preview of a mesh as JSON."""
    write_text(path, dense_json(preview_of(mesh).to_dict()))


def _base64(values: npt.NDArray[Any], kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode("ascii")
