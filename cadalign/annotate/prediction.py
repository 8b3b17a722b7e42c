"""How projected keypoints depend on the unknowns of a fit, and how well they are predicted."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.fitting.uncertainty import unknown_axes
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

_WITHOUT_FOCAL, _WITH_FOCAL = 8, 9


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
    turned = points_3d @ alignment.linear.T
    in_camera = turned + alignment.translation
    depth = in_camera[:, 2]
    if not (depth > 0).all():
        raise InputError("a point lies behind the camera", where="points_3d")
    moved = np.zeros((len(points_3d), 3, 8))
    for axis in range(3):
        moved[:, :, axis] = np.cross(np.eye(3)[axis], turned)
        moved[:, axis, 3 + axis] = 1.0
    for place, axis in enumerate(unknown_axes(known_axis)):
        moved[:, :, 6 + place] = points_3d[:, axis, None] * alignment.linear[:, axis]
    rays = in_camera[:, :2] / depth[:, None]
    of_rays = np.zeros((len(points_3d), 2, 3))
    of_rays[:, [0, 1], [0, 1]] = 1 / depth[:, None]
    of_rays[:, :, 2] = -rays / depth[:, None]
    to_pixels = np.diag([camera.fx, camera.fy]) @ camera.distortion_jacobian(rays)
    jacobian = to_pixels @ of_rays @ moved
    if unknowns == _WITH_FOCAL:
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
