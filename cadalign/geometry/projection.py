"""Perspective projection of camera-frame points; that of the kernels is in `cadalign.solvers`."""

from __future__ import annotations

from cadalign.arrays import FloatArray
from cadalign.geometry.alignment import Alignment


def perspective(points_cam: FloatArray) -> FloatArray:
    """Normalised image coordinates (n, 2) of points (n, 3); not finite at depth 0."""
    return points_cam[:, :2] / points_cam[:, 2:]


def model_rays(cam_from_model: Alignment) -> tuple[FloatArray, FloatArray]:
    """Camera rays in the model's frame: their origin (3,), and a matrix (3, 3) for directions.

    The matrix takes (u, v, 1) to the direction whose parameter is the depth in the camera.
    """
    model_from_ray = cam_from_model.rotation.T / cam_from_model.scale[:, None]
    return -model_from_ray @ cam_from_model.translation, model_from_ray
