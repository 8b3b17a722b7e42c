"""Perspective projection of camera-frame points; that of the kernels is in `cadalign.solvers`."""

from __future__ import annotations

from cadalign.arrays import FloatArray


def perspective(points_cam: FloatArray) -> FloatArray:
    """Normalised image coordinates (n, 2) of points (n, 3); not finite at depth 0."""
    return points_cam[:, :2] / points_cam[:, 2:]
