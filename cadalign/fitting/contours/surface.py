"""The surface whose rims are sought, at a state of the joint estimate."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.raycaster import EmbreeEngine, RayCaster, face_normals
from cadalign.shapes.warp import LinearWarp, linear_warp
from cadalign.solvers.joint.evidence import Shape, State, points_of


class PointRows(NamedTuple):
    """Mean (n, 3) and modes (K, n, 3) of points of the surface, as in `Shape`."""

    mean: FloatArray
    modes: FloatArray


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
