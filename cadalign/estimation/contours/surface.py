"""Surfaces whose rims are sought: the model's own mesh, or training models' warped, at a state."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import cast

import numpy as np
from scipy.spatial import ConvexHull

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.estimation.model import Model
from cadalign.geometry.mesh import Mesh, barycentric_of
from cadalign.geometry.raycaster import RayCaster
from cadalign.io.meshes.files import load_mesh
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.warp import LinearWarp, linear_warp
from cadalign.solvers.joint.evidence import Shape, State, points_of

_QHULL = "QJ Pp"  # joggled, for a flat mesh has a hull, too


class RigidSurface:
    """The surface of an exact or stretched model, the same at all states; it ``is_exact``."""

    is_exact = True

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.caster = RayCaster(mesh)

    def at(self, shape: Shape, state: State) -> PosedSurface:
        """The mesh at a state."""
        return self

    def rows(self, points: FloatArray, face: IntArray) -> tuple[FloatArray, FloatArray]:
        """Mean (n, 3) and modes (K, n, 3) of ``points`` (n, 3) on the triangles ``face`` (n,)."""
        return points, np.zeros((0, len(points), 3))


class WarpedSurface:
    """A mesh, or hull, warped from keypoints ``source`` (n, 3) to ``rows`` (n,) of the shape."""

    is_exact = False

    def __init__(self, mesh: Mesh, source: FloatArray, rows: IntArray, *, is_hull: bool) -> None:
        self.mesh = mesh
        self._rows, self._is_hull = rows, is_hull
        used = np.unique(_hull_faces(mesh.vertices)) if is_hull else slice(None)
        self._warp = linear_warp(mesh.vertices[used], mesh.bounds, source)

    def at(self, shape: Shape, state: State) -> PosedSurface:
        """See `RigidSurface`."""
        points = points_of(shape, state) / np.exp(state.log_scales)
        vertices = self._warp.apply(points[self._rows], np.sort(points[-2:], axis=0))
        mesh = Mesh(vertices, _hull_faces(vertices) if self._is_hull else self.mesh.faces)
        return Warped(mesh, self._warp, self._rows, shape.modes, state.coefficients)


@dataclass(frozen=True, eq=False)
class Warped:
    """A mesh at one state, its vertices warped; ``modes`` and ``coefficients`` of the shape."""

    mesh: Mesh
    warp: LinearWarp
    keypoints: IntArray
    modes: FloatArray
    coefficients: FloatArray

    @cached_property
    def caster(self) -> RayCaster:
        return RayCaster(self.mesh)

    def rows(self, points: FloatArray, face: IntArray) -> tuple[FloatArray, FloatArray]:
        """See `RigidSurface`."""
        corners = self.mesh.faces[face]
        shares = _barycentric(self.mesh.vertices[corners], points)[:, :, None]
        here = LinearWarp(*((shares * each[corners]).sum(axis=1) for each in self.warp))
        modes = np.zeros((len(self.modes), len(points), 3))
        for k, mode in enumerate(self.modes):
            modes[k] = here.derivative(mode[self.keypoints], mode[-2:])
        # What the keypoints' own displacements move is part of the mean.
        return points - np.tensordot(self.coefficients, modes, axes=1), modes


rigid_surface = lru_cache(maxsize=32)(RigidSurface)
"""The surface of a mesh that is met again, its rays prepared once."""

PosedSurface = RigidSurface | Warped
"""A surface at one state of the shape, before its stretch."""
Surface = RigidSurface | WarpedSurface
"""A mesh that follows the shape."""


def _barycentric(triangles: FloatArray, points: FloatArray) -> FloatArray:
    """Barycentric coordinates (n, 3) of points (n, 3) on triangles (n, 3, 3)."""
    shares = barycentric_of(triangles, points)
    shares = np.clip(np.where(np.isfinite(shares), shares, 1 / 3), 0.0, 1.0)
    return np.asarray(shares / shares.sum(axis=1, keepdims=True))


def _hull_faces(vertices: FloatArray) -> IntArray:
    return cast(IntArray, ConvexHull(vertices, qhull_options=_QHULL).simplices.astype(np.int64))


def surface_of(
    model: Model | ShapeModel, points_3d: FloatArray, where: str, *, is_hull: bool = False
) -> Surface:
    """The surface of a shape whose keypoints are about ``points_3d`` (m, 3).

    A learned shape has the mesh of the nearest training model. Raises InputError where there is no
    mesh, which the mask or photo ``where`` needs; DataError if it cannot be read.
    """
    wanting = "a photo" if where.endswith("image") else "a mask"
    if isinstance(model, ShapeModel):
        return WarpedSurface(*_nearest_with_mesh(model, points_3d, where, wanting), is_hull=is_hull)
    if model.mesh is None:
        fix = "give it: Model(..., mesh=cadalign.load_mesh(path))"
        raise InputError(f"the model has no mesh, which {wanting} needs", where=where, fix=fix)
    if model.shape_sigma is None:
        return rigid_surface(model.mesh)
    points = cast(FloatArray, model.points_3d)
    return WarpedSurface(model.mesh, points, np.arange(len(points)), is_hull=is_hull)


def _nearest_with_mesh(
    model: ShapeModel, points_3d: FloatArray, where: str, wanting: str
) -> tuple[Mesh, FloatArray, IntArray]:
    training = model.training
    rows = [] if training is None else training.rows_with_mesh
    if training is None or not rows:
        fix = "learn it from a data set with meshes, such as KeypointNet beside ShapeNet's models"
        what = f"no training model has a mesh, which {wanting} needs"
        raise InputError(what, where=where, fix=fix)
    squares = ((training.points_3d[rows].astype(np.float64) - points_3d) ** 2).sum(axis=2)
    known = np.isfinite(squares)
    sums = np.where(known, squares, 0.0).sum(axis=1)
    distances = np.where(known.any(axis=1), sums / np.maximum(known.sum(axis=1), 1), np.inf)
    row = rows[int(distances.argmin())]
    source = training.points_3d[row].astype(np.float64)
    known = np.flatnonzero(np.isfinite(source).all(axis=1))
    return _mesh_at(cast(Path, training.mesh_paths[row])), source[known], known


_mesh_at = lru_cache(maxsize=16)(load_mesh)
