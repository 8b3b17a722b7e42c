"""Lines of a model over the photo: creases, silhouette, and the edges of its box."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.geometry.alignment import BOX_EDGES, Alignment, Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.simplify import cluster, mesh_edges, simplify
from cadalign.render.raycast.surface import coincident_faces
from cadalign.render.scene import Scene
from cadalign.render.viewpoints import visible_keypoints
from cadalign.shapes.warp import warp_mesh

_MOST_FACES = 30_000
_MOST_CREASES = 1500
_MOST_LINES = 3000
_CREASE_DEG = 30.0
_LONGEST = 1 / 24  # of a line [diagonals]: each is drawn or hidden as a whole
_BOX_PIECES = 16


@dataclass(frozen=True, eq=False)
class Wireframe:
    """Lines of a model, prepared once; ``scene`` is the surface that hides them."""

    scene: Scene
    _mesh: Mesh  # simplified, each vertex once
    _creases: IntArray  # (k, 2) vertices of edges that always show
    _smooth: IntArray  # (k, 2) of edges that show only on the silhouette
    _beside: IntArray  # (k, 2) third corners of the triangles beside these
    _piece: float  # length of a line [model units]

    @classmethod
    def of_scene(cls, scene: Scene) -> Wireframe:
        """The lines of a model as it is."""
        small = simplify(scene.mesh, max_faces=_MOST_FACES)
        # Faces of real models seldom share vertices: weld those in one place.
        welded = cluster(Mesh(small.vertices, small.faces), cells=1e6)
        # A face that is written twice would make a crease of each of its sides.
        alike, opposite = coincident_faces(welded.vertices, welded.faces)
        single = np.minimum(alike, opposite) == np.arange(len(alike))
        mesh = Mesh(welded.vertices, welded.faces[single])
        edges = mesh_edges(mesh.vertices, mesh.faces, crease_angle=_CREASE_DEG)
        creases, smooth = edges.ends[edges.creased], ~edges.creased
        length = np.linalg.norm(np.diff(mesh.vertices[creases], axis=1)[:, 0], axis=1)
        longest = np.sort(np.argsort(-length, kind="stable")[:_MOST_CREASES])
        ends, beside, piece = edges.ends[smooth], edges.opposite[smooth], _LONGEST * scene.diagonal
        return cls(scene, mesh, creases[longest], ends, beside, piece)

    @property
    def creases(self) -> FloatArray:
        """The lines that always show, (k, 2, 3) float [model units]."""
        return self._mesh.vertices[self._creases]

    def warped(
        self, source: FloatArray, target: FloatArray, bounds: FloatArray, *, carried: FloatArray
    ) -> tuple[Wireframe, FloatArray]:
        """Warp the lines, and points on the surface (k, 3); see `cadalign.shapes.warp.warp_mesh`.

        The simplified mesh hides the lines.
        """
        mesh = self._mesh
        together = Mesh(np.concatenate([mesh.vertices, carried]), mesh.faces)
        moved = warp_mesh(together, source, target, bounds=bounds).vertices
        vertices, points = np.split(moved, [len(mesh.vertices)])
        warped = Mesh(vertices, mesh.faces)
        return replace(self, scene=Scene(warped), _mesh=warped), points

    def seen_in(self, camera: Camera, alignment: Alignment) -> FloatArray:
        """Project the lines of the stretched model that a camera sees, (k, 2, 2) float [px]."""
        vertices = self._mesh.vertices
        eye = alignment.inverse(np.zeros((1, 3)))[0]
        ends = vertices[self._smooth]
        outline = ends[_is_outline(ends, vertices[self._beside], eye)]
        lines = np.concatenate([vertices[self._creases], outline])
        lines = _cut(lines, self._piece)[:_MOST_LINES]
        if not len(lines):
            return np.empty((0, 2, 2))
        seen = visible_keypoints(self.scene, lines.mean(axis=1), camera, alignment)
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


def _is_outline(ends: FloatArray, beside: FloatArray, eye: FloatArray) -> BoolArray:
    """Find the silhouette edges: both triangles on one side, seen from the eye, (e,) bool.

    ``ends`` (e, 2, 3) and the third corners ``beside`` (e, 2, 3) are compared, not the normals:
    triangles of real models face either way. Stretching does not change sides, so model coordinates
    suffice.
    """
    start = ends[:, 0]
    sight = np.cross(start - eye, ends[:, 1] - eye)
    sides = np.einsum("eck,ek->ec", beside - start[:, None], sight)
    return np.asarray(sides[:, 0] * sides[:, 1] > 0)


def _cut(lines: FloatArray, piece: float) -> FloatArray:
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
