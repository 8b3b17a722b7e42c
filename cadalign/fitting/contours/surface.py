"""The surface whose rims are sought, at a state of the joint estimate."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.fitting.contours.rims import caster_of
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.raycaster import RayCaster
from cadalign.solvers.joint.evidence import Evidence, State


class Surface(Protocol):
    """A mesh that follows the shape."""

    def caster(self, evidence: Evidence, state: State) -> RayCaster:
        """The ray hierarchy of the mesh at a state, before the stretch."""

    def rows(
        self, evidence: Evidence, state: State, points: FloatArray, face: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Mean (n, 3) and modes (K, n, 3), as in `Shape`, of ``points`` (n, 3) on triangles."""


class RigidSurface:
    """The surface of an exact or stretched model."""

    def __init__(self, mesh: Mesh) -> None:
        self._caster = caster_of(mesh)

    def caster(self, evidence: Evidence, state: State) -> RayCaster:
        """See `Surface`."""
        return self._caster

    def rows(
        self, evidence: Evidence, state: State, points: FloatArray, face: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """See `Surface`."""
        return points, np.zeros((len(evidence.shape.modes), len(points), 3))
