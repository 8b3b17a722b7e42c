"""Snapping of clicks on the model to its corners, creases, silhouette and vertices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.geometry.edges import mesh_edges
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.raycaster import RayCaster

CORNER, CREASE, SMOOTH = range(3)
_CREASE_DEG = 30.0
_BEND = 2 * np.sin(np.radians(_CREASE_DEG / 2))  # length of the sum of unit vectors along a crease
_MOST_FACES = 400_000  # whose creases are searched for
_WELD = 1e-6  # distance of vertices in one place [diagonals]
_JUMP = 0.05  # in depth, that makes a silhouette of one part before another [diagonals]
_RINGS, _SPOKES = 8, 24
_BISECTIONS = 14


@dataclass(frozen=True, eq=False)
class SnapPoints:
    """Vertices of a mesh (n, 3), a triangle at each (n,), and their kinds (n,).

    A corner ends a crease or is where creases meet at an angle.
    """

    xyz: FloatArray
    triangle: IntArray
    kind: npt.NDArray[np.int8]

    @classmethod
    def of_mesh(cls, mesh: Mesh, diagonal: float) -> SnapPoints:
        """Find and sort the vertices; those of very large meshes all count as smooth.

        Examples
        --------
        >>> square = Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
        >>> SnapPoints.of_mesh(square, 2**0.5).kind.tolist()
        [0, 0, 0, 0]
        """
        used, first = np.unique(mesh.faces, return_index=True)
        grid = np.round((mesh.vertices[used] - mesh.vertices[used[0]]) / (_WELD * diagonal))
        _, kept, place = np.unique(grid, axis=0, return_index=True, return_inverse=True)
        xyz, triangle = mesh.vertices[used[kept]], first[kept] // 3
        kind = np.full(len(xyz), SMOOTH, dtype=np.int8)
        if len(mesh.faces) <= _MOST_FACES:
            number = np.zeros(len(mesh.vertices), dtype=np.int64)
            number[used] = place.ravel()
            kind = _kinds(xyz, number[mesh.faces])
        return cls(xyz, triangle, kind)

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
) -> tuple[int, FloatArray] | None:
    """The silhouette's nearest point in a cone about a ray: a triangle and the point on it.

    That is the border of the surface, or of a part before a farther one. None if there is none.
    """
    right = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    right /= np.linalg.norm(right)
    up = np.cross(right, direction)
    angle = 2 * np.pi * np.arange(_SPOKES) / _SPOKES
    ring = np.cos(angle)[:, None] * right + np.sin(angle)[:, None] * up

    def cast(offsets: FloatArray) -> tuple[IntArray, FloatArray]:
        face, distance = caster.first_hits(origin, direction + offsets)
        return np.asarray(face), np.where(face < 0, np.inf, distance)

    _, (middle,) = cast(np.zeros((1, 3)))
    is_outside = bool(np.isinf(middle))

    def crossed(distance: FloatArray) -> BoolArray:
        return np.isfinite(distance) if is_outside else distance > middle + _JUMP * diagonal

    for radius in reach * np.arange(1, _RINGS + 1) / _RINGS:
        _, distance = cast(radius * ring)
        other = crossed(distance)
        if not other.any():
            continue
        spoke = ring[int(np.argmax(other))]
        near, far = (0.0, radius)
        best = None
        for _ in range(_BISECTIONS):
            half = (near + far) / 2
            face, found = cast(half * spoke[None])
            beyond = bool(crossed(found)[0])
            near, far = (near, half) if beyond else (half, far)
            if beyond == is_outside:  # on the near surface
                best = int(face[0]), origin + found[0] * (direction + half * spoke)
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
