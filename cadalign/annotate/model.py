"""CAD model in the annotator: exact points on its mesh that clicks go to, and its display."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray, as_floats
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import InputError
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.raycaster import FaceArray, RayCaster
from cadalign.geometry.simplify import mesh_edges, simplify
from cadalign.render.drawing.canvas import bytes_from_linear
from cadalign.render.raycast.surface import coincident_faces
from cadalign.render.scene import Scene

MOST_FACES = 150_000  # that are displayed
# Depth beneath the surface at which markers can still be clicked [diagonals]: keypoints sit in
# corners, where rays to them graze other parts. The page uses the same value.
_BENEATH = 0.02
_MOST_TRIED = 40  # vertices near a click, of which the first visible one is taken
CORNER, CREASE, SMOOTH = range(3)
_CREASE_DEG = 30.0
_BEND = 2 * np.sin(np.radians(_CREASE_DEG / 2))  # length of the sum of unit vectors along a crease
_MOST_FACES = 400_000  # whose creases are searched for
_WELD = 1e-6  # distance of vertices in one place [diagonals]
_JUMP = 0.05  # in depth, that makes a silhouette of one part before another [diagonals]
_RINGS, _SPOKES = 8, 24
_BISECTIONS = 14


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
        return _placed(start + distance[0] * along)

    def is_seen(self, origin: npt.ArrayLike, xyz: npt.ArrayLike) -> bool:
        """True if a point on the surface, or slightly beneath it, is visible from ``origin``."""
        start = as_floats(origin, name="origin", shape=(3,))
        sight = as_floats(xyz, name="xyz", shape=(3,)) - start
        length = float(np.linalg.norm(sight))
        if not length > 0:
            return True
        _, distance = self.scene.caster.first_hits(start, sight[None])
        return bool(distance[0] >= 1 - _BENEATH * self.diagonal / length)

    @cached_property
    def snap_points(self) -> SnapPoints:
        """Vertices that clicks snap to."""
        return SnapPoints.of_mesh(self.scene.mesh, self.diagonal)

    @cached_property
    def displayed(self) -> tuple[Mesh, npt.NDArray[np.float32], BoolArray]:
        """The triangles that are displayed: simplified, of those in one place one for each side.

        With them linear colours and opacities (m, 4), and those (m,) of which another one shows the
        back.
        """
        small = simplify(self.scene.mesh, max_faces=MOST_FACES)
        alike, opposite = coincident_faces(small.vertices, small.faces)
        first = np.flatnonzero(alike == np.arange(len(alike)))
        weights = np.full((len(first), 3), 1 / 3, dtype=np.float32)
        triangles: FaceArray = small.source[first].astype(np.int32)
        color = self.scene.surface.color(triangles, weights)
        mesh = Mesh(small.vertices, small.faces[first])
        return mesh, color, opposite[first] != alike[first]

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
                return _placed(rim)
        return _placed(points.xyz[seen[0]]) if seen else None


def _placed(xyz: FloatArray) -> ModelKeypoint:
    """A keypoint without a name."""
    x, y, z = xyz.tolist()
    return ModelKeypoint(name="", xyz=(x, y, z))


def display_bytes(model: ClickableModel) -> bytes:
    """Encode the model for display, simplified to at most `MOST_FACES` triangles.

    First the length of a JSON header (uint32, little-endian, a multiple of 4 with padding), and the
    header with ``shown`` and ``all``, the numbers of faces; then positions (faces, 3, 3) float32 in
    display coordinates, normals (faces, 3, 3) float32, and sRGB colours (faces, 3) uint8.
    """
    mesh, color, _ = model.displayed
    shown = Mesh(model.to_display(mesh.vertices), mesh.faces)
    header = json.dumps({"shown": len(mesh.faces), "all": len(model.scene.mesh.faces)}).encode()
    header += b" " * (-len(header) % 4)
    return b"".join(
        [
            len(header).to_bytes(4, "little"),
            header,
            shown.triangles.astype("<f4").tobytes(),
            Scene(shown).corner_normals.astype("<f4").tobytes(),
            bytes_from_linear(color[:, :3]).tobytes(),
        ]
    )


def detail_bytes(model: ClickableModel, creases: FloatArray) -> bytes:
    """Encode what `display_bytes` leaves out, of the same triangles.

    Creases (k, 2, 3) [model units] as float32 in display coordinates, their number (uint32) before
    them; opacities (faces,) uint8; and sides (faces,) uint8, which are 1 for a triangle that only
    its front shows, since another one lies in its place, wound the other way.
    """
    _, color, is_doubled = model.displayed
    opacity = np.round(255 * np.clip(color[:, 3], 0, 1)).astype(np.uint8)
    return b"".join(
        [
            len(creases).to_bytes(4, "little"),
            model.to_display(creases).astype("<f4").tobytes(),
            opacity.tobytes(),
            is_doubled.astype(np.uint8).tobytes(),
        ]
    )


@dataclass(frozen=True, eq=False)
class SnapPoints:
    """Vertices of a mesh (n, 3), and their kinds (n,).

    A corner ends a crease or is where creases meet at an angle.
    """

    xyz: FloatArray
    kind: npt.NDArray[np.int8]

    @classmethod
    def of_mesh(cls, mesh: Mesh, diagonal: float) -> SnapPoints:
        """Find and sort the vertices; those of very large meshes all count as smooth."""
        used = np.unique(mesh.faces)
        grid = np.round((mesh.vertices[used] - mesh.vertices[used[0]]) / (_WELD * diagonal))
        _, kept, place = np.unique(grid, axis=0, return_index=True, return_inverse=True)
        xyz = mesh.vertices[used[kept]]
        kind = np.full(len(xyz), SMOOTH, dtype=np.int8)
        if len(mesh.faces) <= _MOST_FACES:
            number = np.zeros(len(mesh.vertices), dtype=np.int64)
            number[used] = place.ravel()
            kind = _kinds(xyz, number[mesh.faces])
        return cls(xyz, kind)

    def near(self, origin: FloatArray, direction: FloatArray, reach: float) -> IntArray:
        """Vertices in a cone about a ray, best first: by kind, then by angle.

        ``direction`` is a unit vector, ``reach`` the tangent of the cone's half angle.
        """
        sight = self.xyz - origin
        along = sight @ direction
        beside = np.linalg.norm(sight - along[:, None] * direction, axis=1)
        inside = np.flatnonzero((along > 0) & (beside <= reach * along))
        angle = beside[inside] / along[inside]
        return inside[np.lexsort([angle, self.kind[inside]])]


def find_rim(
    caster: RayCaster, origin: FloatArray, direction: FloatArray, reach: float, diagonal: float
) -> FloatArray | None:
    """The silhouette's nearest point (3,) in a cone about a ray.

    That is the border of the surface, or of a part before a farther one. None if there is none.
    """
    right = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    right /= np.linalg.norm(right)
    up = np.cross(right, direction)
    angle = 2 * np.pi * np.arange(_SPOKES) / _SPOKES
    ring = np.cos(angle)[:, None] * right + np.sin(angle)[:, None] * up

    def cast(offsets: FloatArray) -> FloatArray:
        face, distance = caster.first_hits(origin, direction + offsets)
        return np.where(face < 0, np.inf, distance)

    (middle,) = cast(np.zeros((1, 3)))
    is_outside = bool(np.isinf(middle))

    def crossed(distance: FloatArray) -> BoolArray:
        return np.isfinite(distance) if is_outside else distance > middle + _JUMP * diagonal

    for radius in reach * np.arange(1, _RINGS + 1) / _RINGS:
        distance = cast(radius * ring)
        other = crossed(distance)
        if not other.any():
            continue
        spoke = ring[int(np.argmax(other))]
        near, far = (0.0, radius)
        best = None
        for _ in range(_BISECTIONS):
            half = (near + far) / 2
            found = cast(half * spoke[None])
            beyond = bool(crossed(found)[0])
            near, far = (near, half) if beyond else (half, far)
            if beyond == is_outside:  # on the near surface
                best = origin + found[0] * (direction + half * spoke)
        return best
    return None


def _kinds(xyz: FloatArray, faces: IntArray) -> npt.NDArray[np.int8]:
    kind = np.full(len(xyz), SMOOTH, dtype=np.int8)
    a, b, c = faces.T
    solid = faces[(a != b) & (b != c) & (a != c)]
    if not len(solid):
        return kind
    edges = mesh_edges(xyz, solid, crease_angle=_CREASE_DEG)
    ends = edges.ends[edges.creased]
    along = xyz[ends[:, 1]] - xyz[ends[:, 0]]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    degree = np.bincount(ends.ravel(), minlength=len(xyz))
    total = np.zeros_like(xyz)
    np.add.at(total, ends[:, 0], along)
    np.add.at(total, ends[:, 1], -along)
    bent = np.linalg.norm(total, axis=1) > _BEND
    kind[degree > 0] = CREASE
    kind[(degree == 1) | (degree > 2) | ((degree == 2) & bent)] = CORNER
    return kind
