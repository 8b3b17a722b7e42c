"""Warping of meshes, such that their keypoints come to given places."""

from __future__ import annotations

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.geometry.mesh import Mesh


def warp_mesh(mesh: Mesh, source: FloatArray, target: FloatArray) -> Mesh:
    raise InputError("not yet")
