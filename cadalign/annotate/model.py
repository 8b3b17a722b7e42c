"""The CAD model: exact points on its full mesh, whatever is shown of it."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray, as_floats
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.render.scene import Scene
from cadalign.render.views.visibility import visible_keypoints

_SAMPLES = 96
_SAMPLED_FROM = 20_000
_NEAREST_SAMPLES = 2e-3  # in diagonals
# How far beneath the surface a marker's point may lie to be clicked on, in diagonals: keypoints sit
# in corners, where rays to them graze other parts. The page shows and takes markers by the same.
_BENEATH = 0.02
_EXACT = 1e-6


class CadModel:
    """A mesh that can be clicked on.

    Parameters
    ----------
    mesh : Mesh

    Attributes
    ----------
    scene : Scene
    center : (3,) float
        The middle of its bounding box [model units].
    diagonal : float
        The length of the box's diagonal [model units].

    Raises
    ------
    InputError
        If the mesh is a single point.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.scene = Scene(mesh)
        low, high = self.scene.bounds
        self.center: FloatArray = (low + high) / 2
        self.diagonal = self.scene.diagonal
        if not self.diagonal > 0:
            raise InputError("all its vertices are in one place", where=mesh.source)

    def to_display(self, xyz: npt.ArrayLike) -> FloatArray:
        """Model coordinates (..., 3) as the page has them: centred, with a diagonal of 1."""
        return np.asarray((np.asarray(xyz, dtype=float) - self.center) / self.diagonal)

    def from_display(self, xyz: npt.ArrayLike) -> FloatArray:
        """The model coordinates (..., 3) of the page's."""
        return np.asarray(np.asarray(xyz, dtype=float) * self.diagonal + self.center)

    def pick(self, origin: npt.ArrayLike, direction: npt.ArrayLike) -> ModelKeypoint | None:
        """The first point of the surface on a ray.

        Parameters
        ----------
        origin, direction : (3,) float
            In model coordinates.

        Returns
        -------
        ModelKeypoint or None
            None where the ray misses.

        Raises
        ------
        InputError
            If the ray is not made of finite numbers, or its direction is zero.
        """
        start = as_floats(origin, name="origin", shape=(3,))
        along = as_floats(direction, name="direction", shape=(3,))
        if not along.any():
            raise InputError("is zero", where="direction")
        face, distance = self.scene.caster.first_hits(start, along[None])
        if face[0] < 0 or not np.isfinite(distance[0]):
            return None
        return self._on_triangle(int(face[0]), start + distance[0] * along)

    def is_seen(self, origin: npt.ArrayLike, xyz: npt.ArrayLike) -> bool:
        """Whether a point on the model, or little beneath its surface, is seen from a place."""
        start = as_floats(origin, name="origin", shape=(3,))
        sight = as_floats(xyz, name="xyz", shape=(3,)) - start
        length = float(np.linalg.norm(sight))
        if not length > 0:
            return True
        _, distance = self.scene.caster.first_hits(start, sight[None])
        return bool(distance[0] >= 1 - _BENEATH * self.diagonal / length)

    def visible(
        self, points: FloatArray, camera: Camera, alignment: Alignment
    ) -> npt.NDArray[np.bool_]:
        """Which points (k, 3) a camera sees of the stretched model."""
        return visible_keypoints(self.scene, points, camera, alignment)

    @cached_property
    def samples(self) -> tuple[ModelKeypoint, ...]:
        """Corners all over the model, far from each other: vertices by farthest-point sampling.

        The first is the vertex farthest from the centre, so that extremes come first.
        """
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

    def _on_triangle(self, triangle: int, xyz: FloatArray) -> ModelKeypoint:
        """A point of a triangle, with the file's face number and that face's barycentrics.

        Of a polygon its first triangle counts, also for points on its others: their weights are
        negative in part. Where a polygon is not flat that names no point of it, and is left out.
        """
        mesh = self.scene.mesh
        face = int(mesh.polygon[triangle])
        corners = mesh.vertices[mesh.faces[self._first_triangle(mesh.polygon, face)]]
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

    @staticmethod
    def _first_triangle(polygon: IntArray, face: int) -> int:
        return int(np.searchsorted(polygon, face))
