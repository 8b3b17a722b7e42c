"""Perspective projection of camera-frame points; that of the kernels is in `cadalign.solvers`."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import perspective

__all__ = ["model_rays", "perspective", "projected_covariances"]


def projected_covariances(
    points_cam: FloatArray, covariances: FloatArray, camera: Camera
) -> FloatArray:
    """Covariances (n, 2, 2) [px squared] of the projections of uncertain points, to first order.

    Parameters
    ----------
    points_cam : (n, 3) float
        In the camera's frame, where it sees them.
    covariances : (n, 3, 3) float
        Covariances of these points.
    camera : Camera

    Examples
    --------
    >>> camera = Camera(640, 480, 500, 500, 319.5, 239.5)
    >>> projected_covariances(np.array([[0.0, 0.0, 5.0]]), np.eye(3)[None], camera).tolist()
    [[[10000.0, 0.0], [0.0, 10000.0]]]
    """
    jacobian = camera.projection_slopes(points_cam)
    return np.asarray(jacobian @ covariances @ jacobian.swapaxes(1, 2))


def model_rays(cam_from_model: Alignment) -> tuple[FloatArray, FloatArray]:
    """Camera rays in the model's frame: their origin (3,), and a matrix (3, 3) for directions.

    The matrix takes (u, v, 1) to the direction whose parameter is the depth in the camera.
    """
    model_from_ray = cam_from_model.rotation.T / cam_from_model.scale[:, None]
    return -model_from_ray @ cam_from_model.translation, model_from_ray
