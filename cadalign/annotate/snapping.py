"""Points of a model that clicks go to: corners, creases, silhouette, vertices, mirror images."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from trimesh.triangles import closest_point

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.geometry.mesh import Mesh, mesh_edges
from cadalign.geometry.raycaster import RayCaster

CORNER, CREASE, SMOOTH = range(3)
_CREASE_DEG = 30.0
_BEND = 2 * np.sin(np.radians(_CREASE_DEG / 2))  # length of the sum of unit vectors along a crease
_MOST_FACES = 400_000  # whose creases are searched for
_WELD = 1e-6  # distance of vertices in one place [diagonals]
_JUMP = 0.05  # in depth, that makes a silhouette of one part before another [diagonals]
_RINGS, _SPOKES = 8, 24
_BISECTIONS = 14
_MIRROR_AXES = (0, 2)  # left and right, front and back; y is up
_MIRROR_SAMPLES = 60_000
_MIRROR_TESTED = 4_000
_MIRROR_NEAR = 0.015  # of a mirrored point to the surface [diagonals]
_MIRROR_SHARE = 0.97  # of the surface that must have its mirror image
_MIRROR_APART = 0.05  # least distance of a point and its mirror image [diagonals]
_MIRROR_CANDIDATES = 8  # samples near a point, on whose triangles the nearest one is searched for


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


@dataclass(frozen=True, eq=False)
class MirrorPlanes:
    """Planes across x or z through the middle of a model that take its surface to itself."""

    triangles: FloatArray  # (m, 3, 3)
    center: FloatArray
    diagonal: float
    axes: tuple[int, ...]
    _tree: cKDTree
    _sampled: IntArray  # the triangle of each point of the tree

    @classmethod
    def of_mesh(cls, mesh: Mesh, center: FloatArray, diagonal: float) -> MirrorPlanes:
        """Compare samples of the surface with their mirror images."""
        triangles = mesh.triangles
        a, b, c = triangles.transpose(1, 0, 2)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        rng = np.random.default_rng(0)
        if not area.sum() > 0:
            return cls(triangles, center, diagonal, (), cKDTree(a), np.arange(len(a)))
        number = rng.choice(len(triangles), _MIRROR_SAMPLES, p=area / area.sum())
        u, v = rng.random((2, _MIRROR_SAMPLES, 1))
        flip = u + v > 1
        u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
        points = a[number] + u * (b - a)[number] + v * (c - a)[number]
        tree = cKDTree(points)
        axes = []
        for axis in _MIRROR_AXES:
            image = _reflect(points[:_MIRROR_TESTED], axis, center)
            gaps, _ = tree.query(image)
            if np.mean(gaps <= _MIRROR_NEAR * diagonal) >= _MIRROR_SHARE:
                axes.append(axis)
        return cls(triangles, center, diagonal, tuple(axes), tree, number)

    def image(self, point: Iterable[float]) -> tuple[int, FloatArray] | None:
        """The mirror image of a point: its triangle and place (3,) on the surface.

        None if the model has no such plane, the point lies on it, or the surface is not there.
        """
        xyz = np.array(list(point), dtype=float)
        for axis in self.axes:
            wanted = _reflect(xyz[None], axis, self.center)
            if np.linalg.norm(wanted[0] - xyz) < _MIRROR_APART * self.diagonal:
                continue
            _, rows = self._tree.query(wanted[0], k=_MIRROR_CANDIDATES)
            candidates = np.unique(self._sampled[rows])
            places: FloatArray = closest_point(  # type: ignore[no-untyped-call]
                self.triangles[candidates], np.repeat(wanted, len(candidates), axis=0)
            )
            gaps = np.linalg.norm(places - wanted, axis=1)
            best = int(np.argmin(gaps))
            if gaps[best] <= _MIRROR_NEAR * self.diagonal:
                return int(candidates[best]), places[best]
        return None


def _reflect(points: FloatArray, axis: int, center: FloatArray) -> FloatArray:
    image = points.copy()
    image[:, axis] = 2 * center[axis] - image[:, axis]
    return image
