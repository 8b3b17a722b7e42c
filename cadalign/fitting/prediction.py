"""Derivatives and covariances of projected keypoints, by the unknowns of a fit."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.projection import perspective
from cadalign.solvers.constants import UNKNOWNS
from cadalign.solvers.projection import ray_derivatives


def projection_jacobian(
    points_3d: FloatArray,
    camera: Camera,
    alignment: Alignment,
    *,
    known_axis: str,
    unknowns: int,
) -> FloatArray:
    """Derivatives (n, 2, unknowns) of projected points, in the order of `FitResult.covariance`.

    In pixels per rad, model unit, and unit of a logarithm; 9 unknowns include that of the focal
    length. Refuses points behind the camera.
    """
    if unknowns not in (UNKNOWNS, UNKNOWNS + 1):
        raise InputError(f"{unknowns} is neither 8 nor 9", where="unknowns")
    in_camera = alignment.apply(points_3d)
    if not (in_camera[:, 2] > 0).all():
        raise InputError("a point lies behind the camera", where="points_3d")
    rays = perspective(in_camera)
    # The kernel takes the known axis first, and has the scales of the other two in cyclic order.
    first = "xyz".index(known_axis)
    order = [first, (first + 1) % 3, (first + 2) % 3]
    ordered = Alignment(
        alignment.rotation[:, order], alignment.translation, alignment.scale[order], is_valid=True
    )
    of_rays = ray_derivatives(np.ascontiguousarray(points_3d[:, order], float), ordered.packed)
    if order[1] > order[2]:
        of_rays = of_rays[:, :, [0, 1, 2, 3, 4, 5, 7, 6]]
    to_pixels = np.diag([camera.fx, camera.fy]) @ camera.distortion_jacobian(rays)
    jacobian = to_pixels @ of_rays
    if unknowns > UNKNOWNS:
        off_center = camera.pixels_from_normalized(rays) - (camera.cx, camera.cy)
        jacobian = np.concatenate([jacobian, off_center[:, :, None]], axis=2)
    return np.asarray(jacobian)


def predicted_covariances(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariances (n, 2, 2) [px^2] of predicted projections, without a measurement's own noise.

    Parameters
    ----------
    jacobian : (n, 2, k) float
        See `projection_jacobian`.
    covariance : (k, k) float
        Of the unknowns.
    """
    return np.asarray(jacobian @ covariance @ jacobian.transpose(0, 2, 1))
