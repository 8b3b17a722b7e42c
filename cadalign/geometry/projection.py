"""Derivatives of projected points by an alignment, and covariances of predicted projections."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

_UNKNOWNS = 10  # of a result's covariance, focal length included


def projection_jacobian(points_3d: FloatArray, camera: Camera, alignment: Alignment) -> FloatArray:
    """Derivatives (n, 2, 10) of projected points, in the order of `cadalign.Result.covariance`.

    In pixels per rad, model unit, and unit of a logarithm. Refuses points behind the camera.
    """
    in_camera = alignment.apply(points_3d)
    if not camera.sees(in_camera).all():
        raise InputError("a point lies behind the camera", where="points_3d")
    stretched = points_3d * alignment.scale
    turned = stretched @ alignment.rotation.T
    jacobian = np.empty((len(points_3d), 2, _UNKNOWNS))
    by_point = camera.projection_slopes(in_camera)
    jacobian[:, :, :3] = np.cross(turned[:, None], by_point)
    jacobian[:, :, 3:6] = by_point
    jacobian[:, :, 6:9] = by_point @ (alignment.rotation * stretched[:, None])
    jacobian[:, :, 9] = camera.pixels_of_rays(in_camera) - (camera.cx, camera.cy)
    return jacobian


def predicted_covariances(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariances (n, 2, 2) [px^2] of predicted projections, without a measurement's own noise.

    By the `projection_jacobian` and the covariance of the unknowns (m, m), the first of its 10.
    """
    jacobian = jacobian[:, :, : len(covariance)]
    return np.asarray(jacobian @ covariance @ jacobian.transpose(0, 2, 1))
