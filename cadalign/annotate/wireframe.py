"""Wireframe of a stretched model over a photo: visible creases, borders and silhouette edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.annotate.model import CadModel
from cadalign.arrays import BoolArray, FloatArray
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import BOX_EDGES, Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.edges import mesh_edges
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.simplify import cluster, simplify
from cadalign.render.views.visibility import visible_keypoints

_MOST_FACES = 30_000
_MOST_CREASES = 1500
_MOST_LINES = 3000
_CREASE_DEG = 30.0
_LONGEST = 1 / 24  # of a line [diagonals]: each is drawn or hidden as a whole
_BOX_PIECES = 16


@dataclass(frozen=True, eq=False)
class _Edges:
    """Smooth edges, which show only on the silhouette, and lines that always show."""

    ends: FloatArray  # (e, 2, 3)
    beside: FloatArray  # (e, 2, 3), the third corners of the adjacent triangles
    lines: FloatArray  # (l, 2, 3)


class Wireframe:
    """Lines of a model, prepared once."""

    def __init__(self, model: CadModel) -> None:
        self._scene = model.scene
        self._piece = _LONGEST * model.diagonal
        self._edges = _find_edges(model.scene.mesh, self._piece)

    def seen_in(self, camera: Camera, alignment: Alignment) -> FloatArray:
        """Project the lines of the stretched model that a camera sees, (k, 2, 2) float [px]."""
        edges = self._edges
        eye = alignment.inverse(np.zeros((1, 3)))[0]
        outline = edges.ends[_is_outline(edges, eye)]
        lines = np.concatenate([edges.lines, _cut(outline, self._piece)])[:_MOST_LINES]
        if not len(lines):
            return np.empty((0, 2, 2))
        seen = visible_keypoints(self._scene, lines.mean(axis=1), camera, alignment)
        return _project_lines(lines[seen], camera, alignment)


def box_lines(bounds: FloatArray, camera: Camera, alignment: Alignment) -> FloatArray:
    """Project the edges of the stretched model's box, in pieces, (k, 2, 2) float [px]."""
    corners = Box.from_model(bounds, alignment).corners
    ends = corners[np.array(BOX_EDGES)]
    share = np.linspace(0, 1, _BOX_PIECES + 1)[:, None, None]
    points = (ends[:, 0] * (1 - share) + ends[:, 1] * share).transpose(1, 0, 2)
    lines = np.stack([points[:, :-1], points[:, 1:]], axis=2).reshape(-1, 2, 3)
    return _project_lines(lines, camera, Alignment.identity())


def _project_lines(lines: FloatArray, camera: Camera, alignment: Alignment) -> FloatArray:
    """Project lines (k, 2, 3) to (k, 2, 2) [px]; drop those with an end behind the camera."""
    ends = alignment.apply(lines.reshape(-1, 3)).reshape(-1, 2, 3)
    near = 1e-6 * np.abs(alignment.translation).max(initial=1.0)
    ends = ends[(ends[:, :, 2] > near).all(axis=1)]
    if not len(ends):
        return np.empty((0, 2, 2))
    return camera.project(ends.reshape(-1, 3)).reshape(-1, 2, 2)


def _is_outline(edges: _Edges, eye: FloatArray) -> BoolArray:
    """Find the silhouette edges: both triangles on one side, seen from the eye, (e,) bool.

    The third corners are compared, not the normals: triangles of real models face either way.
    Stretching does not change sides, so model coordinates suffice.
    """
    start = edges.ends[:, 0]
    sight = np.cross(start - eye, edges.ends[:, 1] - eye)
    sides = np.einsum("eck,ek->ec", edges.beside - start[:, None], sight)
    return np.asarray(sides[:, 0] * sides[:, 1] > 0)


def _find_edges(mesh: Mesh, piece: float) -> _Edges:
    small = simplify(mesh, max_faces=_MOST_FACES)
    # Faces of real models seldom share vertices: weld those in one place.
    welded = cluster(Mesh(small.vertices, small.faces), cells=1e6)
    edges = mesh_edges(welded.vertices, welded.faces, crease_angle=_CREASE_DEG)
    ends = welded.vertices[edges.ends]
    lines = ends[edges.creased]
    longest = np.argsort(-np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1), kind="stable")
    lines = lines[np.sort(longest[:_MOST_CREASES])]
    beside = welded.vertices[edges.opposite[~edges.creased]]
    return _Edges(ends[~edges.creased], beside, _cut(lines, piece))


def _cut(lines: FloatArray, piece: float) -> FloatArray:
    """Cut lines (k, 2, 3) into pieces of at most that length."""
    if not len(lines):
        return lines
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    parts = np.maximum(1, np.ceil(length / piece)).astype(np.int64)
    line = np.repeat(np.arange(len(lines)), parts)
    part = np.arange(len(line)) - np.repeat(np.cumsum(parts) - parts, parts)
    low = (part / parts[line])[:, None]
    high = ((part + 1) / parts[line])[:, None]
    start, along = lines[line, 0], lines[line, 1] - lines[line, 0]
    return np.stack([start + low * along, start + high * along], axis=1)
