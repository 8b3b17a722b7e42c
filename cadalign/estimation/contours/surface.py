"""Surfaces whose rims are sought: the model's own mesh, or training models' warped, at a state.

For a mesh that is only similar to the object, there is its convex hull, too. What lies between
legs, or a hole, differs from object to object more than the outermost points do, which keypoints
and the box describe. The silhouette of a convex hull is the convex hull of the silhouette, so that
masks and meshes compare by their hulls as they do by themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol, cast

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.estimation.contours.rows import PointRows
from cadalign.estimation.model import Model
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.raycaster import EmbreeEngine, RayCaster, face_normals
from cadalign.io.meshes.load import load_mesh
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import TrainingShapes
from cadalign.shapes.warp import LinearWarp, linear_warp
from cadalign.solvers.joint.evidence import Shape, State, points_of

_QHULL = "QJ Pp"  # joggled, for a flat mesh has a hull, too
_MOST_MESHES = 3  # training models that are tried, the nearest ones


class PosedSurface(Protocol):
    """A surface at one state of the shape, before its stretch."""

    @property
    def caster(self) -> RayCaster:
        """The ray hierarchy."""

    def rows(self, points: FloatArray, face: IntArray) -> PointRows:
        """Rows of ``points`` (n, 3) on the triangles ``face`` (n,)."""


class Surface(Protocol):
    """A mesh that follows the shape; ``is_exact`` where it is that of the object."""

    @property
    def is_exact(self) -> bool:
        """True if rim and contour differ by the errors of the contour alone."""

    def at(self, shape: Shape, state: State) -> PosedSurface:
        """The mesh at a state."""


class RigidSurface:
    """The surface of an exact or stretched model; it is the same at all states."""

    is_exact = True

    def __init__(self, mesh: Mesh) -> None:
        self.caster = caster_of(mesh)

    def at(self, shape: Shape, state: State) -> PosedSurface:
        """See `Surface`."""
        return self

    def rows(self, points: FloatArray, face: IntArray) -> PointRows:
        """See `PosedSurface`."""
        return PointRows(points, np.zeros((0, len(points), 3)))


class WarpedSurface:
    """A mesh whose keypoints are warped to the object's.

    ``source`` (n, 3) are the mesh's keypoints, ``rows`` (n,) their numbers in the shape.
    """

    is_exact = False

    def __init__(self, mesh: Mesh, source: FloatArray, rows: IntArray) -> None:
        self._mesh, self._rows = mesh, rows
        self._warp = linear_warp(mesh.vertices, mesh.bounds, source)

    def at(self, shape: Shape, state: State) -> PosedSurface:
        """See `Surface`."""
        points = points_of(shape, state) / np.exp(state.log_scales)
        bounds = np.sort(points[-2:], axis=0)
        vertices = self._warp.apply(points[self._rows], bounds)
        mesh = Mesh(vertices, self._mesh.faces)
        return Warped(mesh, self._warp, self._rows, shape.modes, state.coefficients)


class Warped:
    """A mesh at one state, its vertices warped; ``modes`` and ``coefficients`` of the shape."""

    def __init__(
        self,
        mesh: Mesh,
        warp: LinearWarp,
        rows: IntArray,
        modes: FloatArray,
        coefficients: FloatArray,
    ) -> None:
        self.caster = caster_of(mesh)
        self._mesh, self._warp, self._rows = mesh, warp, rows
        self._modes, self._coefficients = modes, coefficients

    def rows(self, points: FloatArray, face: IntArray) -> PointRows:
        """See `PosedSurface`."""
        corners = self._mesh.faces[face]
        shares = _barycentric(self._mesh.vertices[corners], points)[:, :, None]
        here = LinearWarp(*((shares * each[corners]).sum(axis=1) for each in self._warp))
        count = len(self._modes)
        modes = np.zeros((count, len(points), 3))
        for k, mode in enumerate(self._modes):
            modes[k] = here.derivative(mode[self._rows], mode[-2:])
        # What the keypoints' own displacements move is part of the mean.
        return PointRows(points - np.tensordot(self._coefficients, modes, axes=1), modes)


def caster_of(mesh: Mesh) -> RayCaster:
    """The ray hierarchy of a mesh."""
    return RayCaster(mesh, face_normals(mesh.triangles), engine=EmbreeEngine)


def _barycentric(triangles: FloatArray, points: FloatArray) -> FloatArray:
    """Barycentric coordinates (n, 3) of points (n, 3) on triangles (n, 3, 3)."""
    edges = triangles[:, 1:] - triangles[:, :1]
    gram = edges @ edges.swapaxes(1, 2)
    right = (edges @ (points - triangles[:, 0])[:, :, None])[:, :, 0]
    determinant = gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] ** 2
    safe = np.where(determinant > 0, determinant, np.inf)
    first = (gram[:, 1, 1] * right[:, 0] - gram[:, 0, 1] * right[:, 1]) / safe
    second = (gram[:, 0, 0] * right[:, 1] - gram[:, 0, 1] * right[:, 0]) / safe
    shares = np.column_stack([1 - first - second, first, second])
    shares = np.clip(shares, 0.0, 1.0)
    return np.asarray(shares / shares.sum(axis=1, keepdims=True))


class ConvexSurface:
    """The convex hull of a mesh whose keypoints are warped to the object's.

    ``source`` (n, 3) are the mesh's keypoints, ``rows`` (n,) their numbers in the shape.
    """

    is_exact = False

    def __init__(self, mesh: Mesh, source: FloatArray, rows: IntArray) -> None:
        outer = np.unique(_hull_faces(mesh.vertices))
        self._rows = rows
        self._warp = linear_warp(mesh.vertices[outer], mesh.bounds, source)

    def at(self, shape: Shape, state: State) -> PosedSurface:
        """See `Surface`."""
        points = points_of(shape, state) / np.exp(state.log_scales)
        vertices = self._warp.apply(points[self._rows], np.sort(points[-2:], axis=0))
        mesh = Mesh(vertices, _hull_faces(vertices))
        return Warped(mesh, self._warp, self._rows, shape.modes, state.coefficients)


def _hull_faces(vertices: FloatArray) -> IntArray:
    from scipy.spatial import ConvexHull  # takes longer to import than all that is compiled

    return cast(IntArray, ConvexHull(vertices, qhull_options=_QHULL).simplices.astype(np.int64))


class Choice(NamedTuple):
    """Surfaces, the likeliest first; ``hulls`` are their convex hulls, none of an exact one."""

    surfaces: list[Surface]
    hulls: list[Surface]


def surfaces_of(model: Model | ShapeModel, points_3d: FloatArray, where: str) -> Choice:
    """Surfaces for a shape whose keypoints are about ``points_3d`` (m, 3), the nearest first.

    Raises
    ------
    InputError
        If there is no mesh; the mask ``where`` wants one.
    DataError
        If a mesh cannot be read.
    """
    if isinstance(model, Model):
        if model.mesh is None:
            fix = "give it: Model(..., mesh=cadalign.datasets.load_mesh(path))"
            raise InputError("the model has no mesh, which a mask wants", where=where, fix=fix)
        if model.shape_sigma is None:
            return Choice([RigidSurface(model.mesh)], [])
        points = cast(FloatArray, model.points_3d)
        return _warped([(model.mesh, points, np.arange(len(points)))])
    nearest = _nearest_with_mesh(model, points_3d, where)
    return _warped([_of_training(alone) for alone in nearest])


def _warped(given: Sequence[tuple[Mesh, FloatArray, IntArray]]) -> Choice:
    return Choice(
        [WarpedSurface(*each) for each in given], [ConvexSurface(*each) for each in given]
    )


def _nearest_with_mesh(
    model: ShapeModel, points_3d: FloatArray, where: str
) -> list[TrainingShapes]:
    """Training models with a mesh, each alone, whose keypoints are nearest."""
    training = model.training
    rows = []
    if training is not None:
        rows = [row for row, path in enumerate(training.mesh_paths) if path is not None]
    if training is None or not rows:
        fix = "learn it from a data set with meshes, such as KeypointNet beside ShapeNet's models"
        raise InputError("no training model has a mesh, which a mask wants", where=where, fix=fix)
    gaps = training.points_3d[rows].astype(np.float64) - points_3d
    squares = (gaps**2).sum(axis=2)
    known = np.isfinite(squares)
    sums = np.where(known, squares, 0.0).sum(axis=1)
    distances = np.where(known.any(axis=1), sums / np.maximum(known.sum(axis=1), 1), np.inf)
    order = np.argsort(distances, kind="stable")[:_MOST_MESHES]
    return [
        TrainingShapes(
            (training.model_ids[row],),
            training.points_3d[row : row + 1],
            (training.mesh_paths[row],),
        )
        for row in (rows[k] for k in order)
    ]


def _of_training(alone: TrainingShapes) -> tuple[Mesh, FloatArray, IntArray]:
    source = alone.points_3d[0].astype(np.float64)
    known = np.flatnonzero(np.isfinite(source).all(axis=1))
    return load_mesh(cast(Path, alone.mesh_paths[0])), source[known], known
