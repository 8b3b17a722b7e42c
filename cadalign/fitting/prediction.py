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

_WITHOUT_FOCAL, _WITH_FOCAL = UNKNOWNS, UNKNOWNS + 1


def projection_jacobian(
    points_3d: FloatArray,
    camera: Camera,
    alignment: Alignment,
    *,
    known_axis: str = "x",
    unknowns: int = _WITHOUT_FOCAL,
) -> FloatArray:
    """Derivatives of projected points by the unknowns, in the order of `FitResult.covariance`.

    Parameters
    ----------
    points_3d : (n, 3) float
        Model points, in front of the camera [model units].
    camera : Camera
    alignment : Alignment
    known_axis : {"x", "y", "z"}
    unknowns : int
        8, or 9 with the logarithm of the focal length.

    Returns
    -------
    (n, 2, unknowns) float
        [px] per rad, model unit, and unit of a logarithm.

    Raises
    ------
    InputError
        If the number of unknowns is another, or a point lies behind the camera.

    Examples
    --------
    >>> camera = Camera.from_fov(640, 480, fov_x=60.0)
    >>> pose = Alignment(np.eye(3), [0, 0, 4], [1, 1, 1])
    >>> float(projection_jacobian(np.zeros((1, 3)), camera, pose)[0, 0, 3] / camera.fx)
    0.25
    """
    if unknowns not in (_WITHOUT_FOCAL, _WITH_FOCAL):
        raise InputError(f"{unknowns} is neither 8 nor 9", where="unknowns")
    rays = _rays_ahead(points_3d, alignment)
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
    if unknowns == _WITH_FOCAL:
        off_center = camera.pixels_from_normalized(rays) - (camera.cx, camera.cy)
        jacobian = np.concatenate([jacobian, off_center[:, :, None]], axis=2)
    return np.asarray(jacobian)


def _rays_ahead(points_3d: FloatArray, alignment: Alignment) -> FloatArray:
    in_camera = alignment.apply(points_3d)
    if not (in_camera[:, 2] > 0).all():
        raise InputError("a point lies behind the camera", where="points_3d")
    return perspective(in_camera)


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
