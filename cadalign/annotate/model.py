"""CAD model in the annotator: exact points on its full mesh, its display, and its lines."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from cadalign.annotate.snapping import CREASE, MirrorPlanes, SnapPoints, find_rim
from cadalign.arrays import BoolArray, FloatArray, IntArray, as_floats
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import BOX_EDGES, Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh, cluster, mesh_edges, simplify
from cadalign.geometry.raycaster import FaceArray
from cadalign.render.drawing.color import bytes_from_linear
from cadalign.render.raycast.surface import coincident_faces
from cadalign.render.scene import Scene
from cadalign.render.viewpoints import visible_keypoints
from cadalign.shapes.warp import warp_mesh

MOST_FACES = 150_000  # that are displayed
_SAMPLES = 96
_SAMPLED_FROM = 20_000
_NEAREST_SAMPLES = 2e-3  # in diagonals
# Depth beneath the surface at which markers can still be clicked [diagonals]: keypoints sit in
# corners, where rays to them graze other parts. The page uses the same value.
_BENEATH = 0.02
_EXACT = 1e-6
_MOST_TRIED = 40  # vertices near a click, of which the first visible one is taken
_MOST_LINE_FACES = 30_000
_MOST_CREASES = 1500
_MOST_LINES = 3000
_CREASE_DEG = 30.0
_LONGEST = 1 / 24  # of a line [diagonals]: each is drawn or hidden as a whole
_BOX_PIECES = 16


@dataclass(frozen=True, eq=False)
class Displayed:
    """Triangles as they are displayed: simplified, and of those in one place one for each side.

    ``color`` (m, 4) is linear, with the opacity; ``is_doubled`` (m,) are those of which another one
    shows the back.
    """

    mesh: Mesh
    color: npt.NDArray[np.float32]
    is_doubled: BoolArray


class ClickableModel:
    """A mesh that can be clicked on; centre and diagonal are its box's [model units]."""

    def __init__(self, mesh: Mesh) -> None:
        self.scene = Scene(mesh)
        low, high = self.scene.bounds
        self.center: FloatArray = (low + high) / 2
        self.diagonal = self.scene.diagonal
        if not self.diagonal > 0:
            raise InputError("all vertices of the mesh coincide", where=mesh.source)

    def to_display(self, xyz: npt.ArrayLike) -> FloatArray:
        """Turn model coordinates (..., 3) into the page's: centred, with a diagonal of 1."""
        return np.asarray((np.asarray(xyz, dtype=float) - self.center) / self.diagonal)

    def from_display(self, xyz: npt.ArrayLike) -> FloatArray:
        """Turn the page's coordinates (..., 3) into model coordinates."""
        return np.asarray(np.asarray(xyz, dtype=float) * self.diagonal + self.center)

    def pick(
        self, origin: npt.ArrayLike, direction: npt.ArrayLike, *, snap: float = 0.0
    ) -> ModelKeypoint | None:
        """Intersect a ray, in model coordinates, with the surface; None if it misses.

        With ``snap``, the tangent of half the angle of a cone about the ray, the point is a visible
        corner in the cone, else a vertex of a crease, else on the silhouette, else a vertex.
        """
        start = as_floats(origin, name="origin", shape=(3,))
        along = as_floats(direction, name="direction", shape=(3,))
        if not along.any():
            raise InputError("the vector is zero", where="direction")
        if snap > 0:
            snapped = self._snapped(start, along / np.linalg.norm(along), snap)
            if snapped is not None:
                return snapped
        face, distance = self.scene.caster.first_hits(start, along[None])
        if face[0] < 0 or not np.isfinite(distance[0]):
            return None
        return self._on_triangle(int(face[0]), start + distance[0] * along)

    def is_seen(self, origin: npt.ArrayLike, xyz: npt.ArrayLike) -> bool:
        """True if a point on the surface, or slightly beneath it, is visible from ``origin``."""
        start = as_floats(origin, name="origin", shape=(3,))
        sight = as_floats(xyz, name="xyz", shape=(3,)) - start
        length = float(np.linalg.norm(sight))
        if not length > 0:
            return True
        _, distance = self.scene.caster.first_hits(start, sight[None])
        return bool(distance[0] >= 1 - _BENEATH * self.diagonal / length)

    def mirrored(self, xyz: npt.ArrayLike) -> ModelKeypoint | None:
        """The mirror image of a point of a symmetric model; None without one."""
        image = self.mirror_planes.image(as_floats(xyz, name="xyz", shape=(3,)))
        return None if image is None else self._on_triangle(*image)

    @cached_property
    def mirror_planes(self) -> MirrorPlanes:
        """Planes that take the model to itself."""
        return MirrorPlanes.of_mesh(self.scene.mesh, self.center, self.diagonal)

    @cached_property
    def snap_points(self) -> SnapPoints:
        """Vertices that clicks snap to."""
        return SnapPoints.of_mesh(self.scene.mesh, self.diagonal)

    @cached_property
    def samples(self) -> tuple[ModelKeypoint, ...]:
        """Vertices by farthest-point sampling, starting with the one farthest from the centre."""
        mesh = self.scene.mesh
        used, first = np.unique(mesh.faces, return_index=True)
        step = -(-len(used) // _SAMPLED_FROM)
        used, first = used[::step], first[::step]
        points = mesh.vertices[used]
        gaps = np.linalg.norm(points - self.center, axis=1)
        chosen: list[int] = []
        for _ in range(min(_SAMPLES, len(points))):
            farthest = int(np.argmax(gaps))
            if chosen and gaps[farthest] <= _NEAREST_SAMPLES * self.diagonal:
                break
            own = np.linalg.norm(points - points[farthest], axis=1)
            gaps = np.minimum(gaps, own) if chosen else own
            chosen.append(farthest)
        return tuple(self._on_triangle(int(first[row]) // 3, points[row]) for row in chosen)

    @cached_property
    def sample_points(self) -> FloatArray:
        """The positions of `samples`, (k, 3) float."""
        return np.array([point.xyz for point in self.samples])

    @cached_property
    def light_scene(self) -> Scene:
        """The mesh with at most as many faces as are displayed, for what need not be exact."""
        mesh = self.scene.mesh
        if len(mesh.faces) <= MOST_FACES:
            return self.scene
        small = simplify(mesh, max_faces=MOST_FACES)
        return Scene(Mesh(small.vertices, small.faces))

    @cached_property
    def displayed(self) -> Displayed:
        """The triangles that are displayed."""
        small = simplify(self.scene.mesh, max_faces=MOST_FACES)
        alike, opposite = coincident_faces(small.vertices, small.faces)
        first = np.flatnonzero(alike == np.arange(len(alike)))
        weights = np.full((len(first), 3), 1 / 3, dtype=np.float32)
        triangles: FaceArray = small.source[first].astype(np.int32)
        color = self.scene.surface.color(triangles, weights)
        mesh = Mesh(small.vertices, small.faces[first])
        return Displayed(mesh, color, opposite[first] != alike[first])

    def _snapped(
        self, origin: FloatArray, direction: FloatArray, reach: float
    ) -> ModelKeypoint | None:
        points = self.snap_points
        seen = [
            row
            for row in points.near(origin, direction, reach)[:_MOST_TRIED].tolist()
            if self.is_seen(origin, points.xyz[row])
        ]
        if not seen or points.kind[seen[0]] > CREASE:
            rim = find_rim(self.scene.caster, origin, direction, reach, self.diagonal)
            if rim is not None:
                return self._on_triangle(*rim)
        return (
            self._on_triangle(int(points.triangle[seen[0]]), points.xyz[seen[0]]) if seen else None
        )

    def _on_triangle(self, triangle: int, xyz: FloatArray) -> ModelKeypoint:
        """Make a keypoint of a point on a triangle, with the file's face number and barycentrics.

        Barycentrics refer to the first triangle of a polygon: on its other triangles some weights
        are negative. They are left out if the polygon is not flat.
        """
        mesh = self.scene.mesh
        face = int(mesh.polygon[triangle])
        corners = mesh.vertices[mesh.faces[np.searchsorted(mesh.polygon, face)]]
        edges = (corners[1:] - corners[0]).T
        if np.linalg.matrix_rank(edges) == 2:
            first, second = np.linalg.lstsq(edges, xyz - corners[0], rcond=None)[0]
            weights = np.array([1 - first - second, first, second])
        else:
            weights = np.array([1.0, 0.0, 0.0])
        x, y, z = xyz.tolist()
        if np.linalg.norm(weights @ corners - xyz) > _EXACT * self.diagonal:
            return ModelKeypoint(name="", xyz=(x, y, z))
        a, b, c = weights.tolist()
        return ModelKeypoint(name="", xyz=(x, y, z), face_index=face, barycentric=(a, b, c))


def display_bytes(model: ClickableModel) -> bytes:
    """Encode the model for display, simplified to at most `MOST_FACES` triangles.

    First the length of a JSON header (uint32, little-endian, a multiple of 4 with padding), and the
    header with ``shown`` and ``all``, the numbers of faces; then positions (faces, 3, 3) float32 in
    display coordinates, normals (faces, 3, 3) float32, and sRGB colours (faces, 3) uint8.
    """
    displayed = model.displayed
    mesh = displayed.mesh
    shown = Mesh(model.to_display(mesh.vertices), mesh.faces)
    header = json.dumps({"shown": len(mesh.faces), "all": len(model.scene.mesh.faces)}).encode()
    header += b" " * (-len(header) % 4)
    return b"".join(
        [
            len(header).to_bytes(4, "little"),
            header,
            shown.triangles.astype("<f4").tobytes(),
            Scene(shown).corner_normals.astype("<f4").tobytes(),
            bytes_from_linear(displayed.color[:, :3]).tobytes(),
        ]
    )


def detail_bytes(model: ClickableModel, creases: FloatArray) -> bytes:
    """Encode what `display_bytes` leaves out, of the same triangles.

    Creases (k, 2, 3) [model units] as float32 in display coordinates, their number (uint32) before
    them; opacities (faces,) uint8; and sides (faces,) uint8, which are 1 for a triangle that only
    its front shows, since another one lies in its place, wound the other way.
    """
    opacity = np.round(255 * np.clip(model.displayed.color[:, 3], 0, 1)).astype(np.uint8)
    return b"".join(
        [
            len(creases).to_bytes(4, "little"),
            model.to_display(creases).astype("<f4").tobytes(),
            opacity.tobytes(),
            model.displayed.is_doubled.astype(np.uint8).tobytes(),
        ]
    )


@dataclass(frozen=True, eq=False)
class _Edges:
    """Smooth edges, which show only on the silhouette, and creases, which always show.

    As numbers of vertices: of their ends (k, 2), and of the third corners (k, 2) of the triangles
    beside smooth ones.
    """

    smooth: IntArray
    beside: IntArray
    creases: IntArray


@dataclass(frozen=True, eq=False)
class Wireframe:
    """Lines of a model, prepared once; ``scene`` is the surface that hides them."""

    scene: Scene
    _mesh: Mesh  # simplified, each vertex once
    _edges: _Edges
    _piece: float  # length of a line [model units]

    @classmethod
    def of_model(cls, model: ClickableModel) -> Wireframe:
        """The lines of a model as it is."""
        small = simplify(model.scene.mesh, max_faces=_MOST_LINE_FACES)
        # Faces of real models seldom share vertices: weld those in one place.
        welded = cluster(Mesh(small.vertices, small.faces), cells=1e6)
        # A face that is written twice would make a crease of each of its sides.
        alike, opposite = coincident_faces(welded.vertices, welded.faces)
        single = np.minimum(alike, opposite) == np.arange(len(alike))
        mesh = Mesh(welded.vertices, welded.faces[single])
        return cls(model.scene, mesh, _find_edges(mesh), _LONGEST * model.diagonal)

    @property
    def creases(self) -> FloatArray:
        """The lines that always show, (k, 2, 3) float [model units]."""
        return self._mesh.vertices[self._edges.creases]

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
        vertices, edges = self._mesh.vertices, self._edges
        eye = alignment.inverse(np.zeros((1, 3)))[0]
        ends = vertices[edges.smooth]
        outline = ends[_is_outline(ends, vertices[edges.beside], eye)]
        lines = np.concatenate([vertices[edges.creases], outline])
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


def _find_edges(mesh: Mesh) -> _Edges:
    edges = mesh_edges(mesh.vertices, mesh.faces, crease_angle=_CREASE_DEG)
    creases = edges.ends[edges.creased]
    length = np.linalg.norm(mesh.vertices[creases[:, 1]] - mesh.vertices[creases[:, 0]], axis=1)
    longest = np.argsort(-length, kind="stable")
    smooth = ~edges.creased
    return _Edges(
        edges.ends[smooth], edges.opposite[smooth], creases[np.sort(longest[:_MOST_CREASES])]
    )


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
