"""Mirror planes of a model, and the mirrored points on its surface."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from trimesh.triangles import closest_point

from cadalign.arrays import FloatArray, IntArray
from cadalign.geometry.mesh import Mesh

_AXES = (0, 2)  # left and right, front and back; y is up
_SAMPLES = 60_000
_TESTED = 4_000
_NEAR = 0.015  # of a mirrored point to the surface [diagonals]
_SHARE = 0.97  # of the surface that must have its mirror image
_APART = 0.05  # least distance of a point and its mirror image [diagonals]
_CANDIDATES = 8  # samples near a point, on whose triangles the nearest one is searched for


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
        number = rng.choice(len(triangles), _SAMPLES, p=area / area.sum())
        u, v = rng.random((2, _SAMPLES, 1))
        flip = u + v > 1
        u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
        points = a[number] + u * (b - a)[number] + v * (c - a)[number]
        tree = cKDTree(points)
        axes = []
        for axis in _AXES:
            image = _reflect(points[:_TESTED], axis, center)
            gaps, _ = tree.query(image)
            if np.mean(gaps <= _NEAR * diagonal) >= _SHARE:
                axes.append(axis)
        return cls(triangles, center, diagonal, tuple(axes), tree, number)

    def image(self, point: Iterable[float]) -> tuple[int, FloatArray] | None:
        """The mirror image of a point: its triangle and place (3,) on the surface.

        None if the model has no such plane, the point lies on it, or the surface is not there.
        """
        xyz = np.array(list(point), dtype=float)
        for axis in self.axes:
            wanted = _reflect(xyz[None], axis, self.center)
            if np.linalg.norm(wanted[0] - xyz) < _APART * self.diagonal:
                continue
            _, rows = self._tree.query(wanted[0], k=_CANDIDATES)
            candidates = np.unique(self._sampled[rows])
            places: FloatArray = closest_point(  # type: ignore[no-untyped-call]
                self.triangles[candidates], np.repeat(wanted, len(candidates), axis=0)
            )
            gaps = np.linalg.norm(places - wanted, axis=1)
            best = int(np.argmin(gaps))
            if gaps[best] <= _NEAR * self.diagonal:
                return int(candidates[best]), places[best]
        return None


def _reflect(points: FloatArray, axis: int, center: FloatArray) -> FloatArray:
    image = points.copy()
    image[:, axis] = 2 * center[axis] - image[:, axis]
    return image
