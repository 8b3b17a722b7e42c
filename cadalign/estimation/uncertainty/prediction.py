"""Predicted projections: their derivatives by an alignment and a focal length, and covariances."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import perspective
from cadalign.solvers.projection import ray_derivatives

_UNKNOWNS = 10  # of a result's covariance, focal length included


def projection_jacobian(points_3d: FloatArray, camera: Camera, alignment: Alignment) -> FloatArray:
    """Derivatives (n, 2, 10) of projected points, in the order of `cadalign.Result.covariance`.

    In pixels per rad, model unit, and unit of a logarithm. Refuses points behind the camera.
    """
    in_camera = alignment.apply(points_3d)
    if not (in_camera[:, 2] > 0).all():
        raise InputError("a point lies behind the camera", where="points_3d")
    rays = perspective(in_camera)
    of_rays = np.zeros((len(rays), 2, _UNKNOWNS))
    # The kernel knows the first axis, and gives the derivatives by the scales of the other two.
    for order, last in (([0, 1, 2], [7, 8]), ([2, 0, 1], [6, 7])):
        ordered = Alignment(
            alignment.rotation[:, order],
            alignment.translation,
            alignment.scale[order],
            is_valid=True,
        )
        of_rays[:, :, [0, 1, 2, 3, 4, 5, *last]] = ray_derivatives(
            np.ascontiguousarray(points_3d[:, order], float), ordered.packed
        )
    to_pixels = np.diag([camera.fx, camera.fy]) @ camera.distortion_jacobian(rays)
    jacobian = to_pixels @ of_rays
    jacobian[:, :, 9] = camera.pixels_from_normalized(rays) - (camera.cx, camera.cy)
    return np.asarray(jacobian)


def predicted_covariances(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariances (n, 2, 2) [px^2] of predicted projections, without a measurement's own noise.

    Parameters
    ----------
    jacobian : (n, 2, 10) float
        See `projection_jacobian`.
    covariance : (9, 9) or (10, 10) float
        Covariance of the unknowns, without the focal length where that is known.
    """
    jacobian = jacobian[:, :, : len(covariance)]
    return np.asarray(jacobian @ covariance @ jacobian.transpose(0, 2, 1))
