"""CAD model in the annotator: its clicked points, its display, and its lines."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.annotate.files import LastContent, keypoints_file, refuse_other_source
from cadalign.annotate.keypoints import KeypointRegistry, ObjectShape, positions_of
from cadalign.arrays import BoolArray, FloatArray, IntArray, as_floats
from cadalign.datasets.model_keypoints import ModelKeypoint, ModelKeypoints
from cadalign.errors import InputError
from cadalign.estimation.result import Result
from cadalign.geometry.alignment import BOX_EDGES, Alignment, Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.raycaster import FaceArray
from cadalign.geometry.simplify import cluster, mesh_edges, simplify
from cadalign.io.files import require_utf8
from cadalign.io.meshes.files import load_mesh
from cadalign.render.scene import Scene
from cadalign.render.surface import coincident_faces
from cadalign.render.viewpoints import visible_keypoints
from cadalign.shapes.warp import warp_mesh

_MOST_FACES = 150_000  # on display
_SAME_PLACE = 1e-6  # largest distance of points that count as the same [diagonals]
_MOST_DRAWN = 30_000
_MOST_CREASES = 1500
_MOST_LINES = 3000
_CREASE_DEG = 30.0
_LONGEST = 1 / 24  # line [diagonals]: each line is drawn or hidden as a whole
_BOX_PIECES = 16  # of the longest edge


@dataclass(frozen=True, eq=False)
class Wireframe:
    """Lines of a model, prepared once; ``scene`` is the surface that hides them."""

    scene: Scene
    _mesh: Mesh  # simplified, each vertex once
    _creases: IntArray  # (k, 2) vertices of edges that always show
    _smooth: IntArray  # (k, 2) of edges that show only on the silhouette
    _opposite: IntArray  # (k, 2) third corners of the two triangles at each
    _piece: float  # length of a line [model units]

    @classmethod
    def from_scene(cls, scene: Scene) -> Wireframe:
        """Find the lines of a model."""
        small = simplify(scene.mesh, max_faces=_MOST_DRAWN)
        # Faces of real models rarely share vertices: merge vertices in one place.
        welded = cluster(Mesh(small.vertices, small.faces), cells=1e6)
        # A duplicate face would turn all its edges into creases.
        alike, opposite = coincident_faces(welded.vertices, welded.faces)
        single = np.minimum(alike, opposite) == np.arange(len(alike))
        mesh = Mesh(welded.vertices, welded.faces[single])
        edges = mesh_edges(mesh.vertices, mesh.faces, crease_angle=_CREASE_DEG)
        creases, smooth = edges.ends[edges.creased], ~edges.creased
        length = np.linalg.norm(np.diff(mesh.vertices[creases], axis=1)[:, 0], axis=1)
        longest = np.sort(np.argsort(-length, kind="stable")[:_MOST_CREASES])
        ends, third, piece = edges.ends[smooth], edges.opposite[smooth], _LONGEST * scene.diagonal
        return cls(scene, mesh, creases[longest], ends, third, piece)

    @property
    def creases(self) -> FloatArray:
        """Creases and borders, (k, 2, 3) float [model units]."""
        return self._mesh.vertices[self._creases]

    def warp(self, source: FloatArray, target: FloatArray, bounds: FloatArray) -> Wireframe:
        """Warp the lines, and the mesh that hides them, by `cadalign.shapes.warp.warp_mesh`."""
        warped = warp_mesh(self._mesh, source, target, bounds=bounds)
        return replace(self, scene=Scene(warped), _mesh=warped)

    def project(self, camera: Camera, alignment: Alignment) -> FloatArray:
        """Project the visible lines of the stretched model to pixels (k, 2, 2)."""
        vertices = self._mesh.vertices
        eye = alignment.inverse(np.zeros((1, 3)))[0]
        ends = vertices[self._smooth]
        outline = ends[_is_outline(ends, vertices[self._opposite], eye)]
        lines = np.concatenate([vertices[self._creases], outline])
        lines = split_lines(lines, self._piece)[:_MOST_LINES]
        if not len(lines):
            return np.empty((0, 2, 2))
        seen = visible_keypoints(self.scene, lines.mean(axis=1), camera, alignment)
        return project_lines(lines[seen], camera, alignment)


def box_lines(bounds: FloatArray, camera: Camera, alignment: Alignment) -> FloatArray:
    """Project the edges of the stretched model's box, in pieces, to pixels (k, 2, 2)."""
    corners = Box.from_model(bounds, alignment).corners
    ends = corners[np.array(BOX_EDGES)]
    piece = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).max() / _BOX_PIECES
    return project_lines(split_lines(ends, piece), camera, Alignment.identity())


def project_lines(lines: FloatArray, camera: Camera, alignment: Alignment) -> FloatArray:
    """Project lines (k, 2, 3) to (k, 2, 2) [px]; drop those with an end behind the camera."""
    ends = alignment.apply(lines.reshape(-1, 3)).reshape(-1, 2, 3)
    near = 1e-6 * np.abs(alignment.translation).max(initial=1.0)
    ends = ends[(ends[:, :, 2] > near).all(axis=1)]
    if not len(ends):
        return np.empty((0, 2, 2))
    return camera.project(ends.reshape(-1, 3)).reshape(-1, 2, 2)


def _is_outline(ends: FloatArray, opposite: FloatArray, eye: FloatArray) -> BoolArray:
    """Find the silhouette edges: both triangles on one side, seen from the eye, (e,) bool.

    ``ends`` (e, 2, 3) and the third corners ``opposite`` (e, 2, 3) are compared, not the normals:
    triangles of real models face either way. Stretching does not change sides, so model coordinates
    suffice.
    """
    start = ends[:, 0]
    sight = np.cross(start - eye, ends[:, 1] - eye)
    sides = np.einsum("eck,ek->ec", opposite - start[:, None], sight)
    return np.asarray(sides[:, 0] * sides[:, 1] > 0)


def split_lines(lines: FloatArray, piece: float) -> FloatArray:
    """Split lines (k, 2, 3) into pieces that are at most ``piece`` long."""
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


class ClickableModel:
    """A mesh that can be clicked on; centre and diagonal are its box's [model units]."""

    miss_message = "That click missed the model."
    """Message for a click that picks nothing."""

    def __init__(self, mesh: Mesh) -> None:
        self.scene = Scene(mesh)
        low, high = self.scene.bounds
        self.center: FloatArray = (low + high) / 2
        self.diagonal = self.scene.diagonal
        if not self.diagonal > 0:
            raise InputError("all vertices of the mesh coincide", where=mesh.source)

    @cached_property
    def wireframe(self) -> Wireframe:
        """The lines of the model."""
        return Wireframe.from_scene(self.scene)

    @property
    def creases(self) -> FloatArray:
        """The lines that always show, (k, 2, 3) float [model units]."""
        return self.wireframe.creases

    def to_display(self, xyz: npt.ArrayLike) -> FloatArray:
        """Turn model coordinates (..., 3) into the page's: centred, with a diagonal of 1."""
        return np.asarray((np.asarray(xyz, dtype=float) - self.center) / self.diagonal)

    def from_display(self, xyz: npt.ArrayLike) -> FloatArray:
        """Turn the page's coordinates (..., 3) into model coordinates."""
        return np.asarray(np.asarray(xyz, dtype=float) * self.diagonal + self.center)

    def pick(self, origin: npt.ArrayLike, direction: npt.ArrayLike) -> ModelKeypoint | None:
        """Intersect a ray, in model coordinates, with the surface; None if it misses."""
        start = as_floats(origin, name="origin", shape=(3,))
        along = as_floats(direction, name="direction", shape=(3,))
        if not along.any():
            raise InputError("the vector is zero", where="direction")
        face, distance = self.scene.caster.first_hits(start, along[None])
        if face[0] < 0 or not np.isfinite(distance[0]):
            return None
        x, y, z = (start + distance[0] * along).tolist()
        return ModelKeypoint(name="", xyz=(x, y, z))

    @cached_property
    def display_bytes(self) -> bytes:
        """The model for display, simplified to at most 150,000 triangles.

        The numbers of faces and of creases (uint32); positions (faces, 3, 3), normals (faces, 3, 3)
        and linear colours (faces, 3, 3) of corners, and creases (k, 2, 3), all float32,
        little-endian, in display coordinates. Only one of several coincident triangles is kept.
        """
        small = simplify(self.scene.mesh, max_faces=_MOST_FACES)
        alike, opposite = coincident_faces(small.vertices, small.faces)
        first = np.flatnonzero(np.minimum(alike, opposite) == np.arange(len(alike)))
        triangles: FaceArray = small.source[first].astype(np.int32)
        weights = np.full((len(first), 3), 1 / 3, dtype=np.float32)
        color = self.scene.surface.color(triangles, weights)[:, None, :3]
        shown = Mesh(self.to_display(small.vertices), small.faces[first])
        creases = self.to_display(self.creases)
        arrays = (
            shown.triangles,
            Scene(shown).corner_normals,
            np.broadcast_to(color, (len(first), 3, 3)),
            creases,
        )
        counts = np.array([len(first), len(creases)], dtype="<u4")
        return counts.tobytes() + b"".join(each.astype("<f4").tobytes() for each in arrays)


@dataclass(eq=False)
class MarkedModel:
    """A model that can be clicked on, its keypoints and their file, and the objects' shape.

    Without ``path`` and ``keypoints_path`` it is the skeleton of a learned shape.
    """

    cad: ClickableModel
    registry: KeypointRegistry
    shape: ObjectShape
    path: Path | None = None
    keypoints_path: Path | None = None
    content: LastContent = field(default_factory=LastContent)  # of the keypoints file

    @property
    def is_skeleton(self) -> bool:
        """True for the skeleton of a learned shape."""
        return self.path is None

    @property
    def can_exchange(self) -> bool:
        """True if the model is the skeleton of a category, which can be exchanged for another."""
        return self.is_skeleton and self.shape.category is not None

    @property
    def numbers(self) -> dict[Any, int]:
        """Semantic ids of the keypoints by the shape's ids or names of them."""
        return {self.shape.id_of(point): number for number, point in self.registry}

    def lines(self, result: Result) -> FloatArray:
        """Project the visible lines of the estimated object to pixels (k, 2, 2)."""
        if self.is_skeleton:
            lines = split_lines(result.points_3d[result.lines], _LONGEST * self.cad.diagonal)
            return project_lines(lines, result.camera, result.alignment)
        wireframe, numbers = self.cad.wireframe, self.numbers
        if self.shape.learned is not None:  # move known keypoints to their estimates
            rows = [row for row, label in enumerate(result.ids) if label in numbers]
            source = positions_of(self.registry[numbers[result.ids[row]]] for row in rows)
            wireframe = wireframe.warp(source, result.points_3d[rows], result.bounds)
        return wireframe.project(result.camera, result.alignment)

    def write_keypoints(self, used: frozenset[int]) -> None:
        """Write all keypoints that are in use or from files; raises DataError on failure."""
        registry, path = self.registry, self.keypoints_path
        if path is None:
            return
        self.content.refuse_changed(path)
        kept = (point for number, point in registry if number in registry.file_ids | used)
        ModelKeypoints(tuple(kept), self.path).save(path)
        self.content.note(path)


def open_model(
    path: Path, folder: Path, *, keypoints: Path | None = None, shape: ObjectShape
) -> MarkedModel:
    """Open a model, and read its keypoints.

    ``keypoints`` is its keypoint file, by default beside it; changes are written into ``folder``.
    New keypoints do not get ids of the shape.
    """
    require_utf8(path)
    cad = ClickableModel(load_mesh(path))
    own, content = keypoints_file(path, folder), LastContent()
    content.note(own)
    reserved = (label for label in shape.ids if isinstance(label, int))
    registry = KeypointRegistry(reserved=reserved, tolerance=_SAME_PLACE * cad.diagonal)
    for source in dict.fromkeys((keypoints or keypoints_file(path, path.parent), own)):
        if source == keypoints or source.exists():
            read = ModelKeypoints.load(source)
            if source == own:
                refuse_other_source("model", read.model, path, where=own)
            registry.merge(read.keypoints)
    return MarkedModel(cad, registry, shape, path, own, content)
