"""CAD models of a data set of photos, each read once while its photos come one after another."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist

from cadalign.arrays import FloatArray
from cadalign.datasets.photos.photo import CadModel, NamedPoints
from cadalign.errors import DataError
from cadalign.geometry.mesh import Mesh
from cadalign.render.scene import Scene

_KEPT = 16
_ON_SURFACE = 2000  # points among which farthest ones are sought, beside the vertices
_MOST_OF_HULL = 1000  # points whose distances are compared


@dataclass(frozen=True)
class Cad:
    """A CAD model of the data set in a folder.

    Parameters
    ----------
    root : str
        The folder.
    model_id : str
    model : CadModel
        Where it is read from.
    """

    root: str
    model_id: str
    model: CadModel = field(compare=False, repr=False)

    @property
    def scene(self) -> Scene:
        """The mesh; raises DataError if there is none, or it cannot be read."""
        return _scene(self)

    @property
    def has_mesh(self) -> bool:
        """True if there is a mesh that can be read."""
        try:
            return bool(self.scene.mesh.faces.size)
        except DataError:
            return False

    @property
    def bounds(self) -> FloatArray | None:
        """The bounding box (2, 3): the annotation's, the mesh's or that of the keypoints."""
        if self.model.bounds is not None:
            return np.asarray(self.model.bounds)
        if self.has_mesh:
            return np.asarray(self.scene.bounds)
        points = self.model.load_keypoints()
        return (
            None if points is None else np.array([points.xyz.min(axis=0), points.xyz.max(axis=0)])
        )

    @property
    def diameter(self) -> float:
        """The largest distance of two points: the data set's, or that of the mesh's vertices."""
        if self.model.diameter is not None:
            return self.model.diameter
        return _diameter(self)

    @property
    def hull_vertices(self) -> FloatArray:
        """The vertices (n, 3) of the mesh's convex hull; of a flat mesh all of them."""
        return _hull(self)

    def spread_points(self, count: int) -> NamedPoints:
        """Farthest-point samples of the mesh's surface, named by their numbers."""
        return _spread(self, count)


@lru_cache(maxsize=_KEPT)
def _scene(cad: Cad) -> Scene:
    return Scene(cad.model.load_mesh())


@lru_cache(maxsize=_KEPT)
def _spread(cad: Cad, count: int) -> NamedPoints:
    points = np.vstack([cad.scene.used_vertices, _surface_points(cad.scene.mesh)])
    xyz = farthest_points(points, count)
    return NamedPoints(tuple(str(row) for row in range(len(xyz))), xyz)


def _surface_points(mesh: Mesh) -> FloatArray:
    """Random points of a mesh, evenly over its surface, the same every time."""
    first, second, third = np.moveaxis(mesh.triangles, 1, 0)
    areas = np.linalg.norm(np.cross(second - first, third - first), axis=1)
    if not areas.sum() > 0:
        return np.empty((0, 3))
    rng = np.random.default_rng(0)
    faces = rng.choice(len(areas), _ON_SURFACE, p=areas / areas.sum())
    weights = rng.dirichlet(np.ones(3), _ON_SURFACE)
    return np.asarray(np.einsum("nk,nkd->nd", weights, mesh.triangles[faces]))


@lru_cache(maxsize=_KEPT)
def _hull(cad: Cad) -> FloatArray:
    vertices = cad.scene.used_vertices
    try:
        return np.asarray(vertices[ConvexHull(vertices).vertices])
    except QhullError:
        return vertices


@lru_cache(maxsize=_KEPT)
def _diameter(cad: Cad) -> float:
    points = farthest_points(cad.hull_vertices, _MOST_OF_HULL)
    return float(pdist(points).max())


def farthest_points(points: FloatArray, count: int) -> FloatArray:
    """At most so many points (n, 3), each the farthest from those before it.

    The first is the farthest from the mean. Points that coincide with an earlier one are left out.

    Examples
    --------
    >>> farthest_points(np.array([[0.0, 0, 0], [5, 0, 0], [1, 0, 0], [5, 0, 0]]), 3)[:, 0].tolist()
    [0.0, 5.0, 1.0]
    """
    chosen: list[int] = []
    distance = np.linalg.norm(points - points.mean(axis=0), axis=1)
    nearest = np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)) and distance.max() > 0:
        chosen.append(int(distance.argmax()))
        gaps = np.linalg.norm(points - points[chosen[-1]], axis=1)
        nearest = distance = np.minimum(nearest, gaps)
    return points[chosen]
