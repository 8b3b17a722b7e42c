"""Samples of a surface: random points, and points far apart."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.geometry.mesh import Mesh


def random_points(mesh: Mesh, count: int) -> tuple[IntArray, FloatArray]:
    """Random points of a mesh, evenly over its surface, the same every time.

    Triangles (n,) and the points (n, 3) on them; none for a mesh without any area.
    """
    first, second, third = np.moveaxis(mesh.triangles, 1, 0)
    areas = np.linalg.norm(np.cross(second - first, third - first), axis=1)
    if not areas.sum() > 0:
        return np.empty(0, dtype=np.int64), np.empty((0, 3))
    rng = np.random.default_rng(0)
    faces = rng.choice(len(areas), count, p=areas / areas.sum())
    weights = rng.dirichlet(np.ones(3), count)
    return faces, np.asarray(np.einsum("nk,nkd->nd", weights, mesh.triangles[faces]))


def farthest_rows(
    points: FloatArray, count: int, *, center: FloatArray, apart: float = 0.0
) -> IntArray:
    """Numbers of at most so many points (n, 3), each the farthest from those before it.

    The first is the farthest from the centre (3,). Points that are not farther ``apart`` from all
    earlier ones are left out.

    Examples
    --------
    >>> points = np.array([[0.0, 0, 0], [5, 0, 0], [1, 0, 0], [5, 0, 0]])
    >>> farthest_rows(points, 3, center=points.mean(axis=0)).tolist()
    [0, 1, 2]
    """
    chosen: list[int] = []
    distance = np.linalg.norm(points - center, axis=1)
    nearest = np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)) and distance.max() > apart:
        chosen.append(int(distance.argmax()))
        gaps = np.linalg.norm(points - points[chosen[-1]], axis=1)
        nearest = distance = np.minimum(nearest, gaps)
    return np.array(chosen, dtype=np.int64)
