"""Frames that face the keypoints of a wide lens, in which their rays have image coordinates.

Estimates are made with rays (u, v, 1), which directions beside and behind the camera's plane lack.
The keypoints of an object that does not surround the camera lie to one side of it: the camera is
turned about its centre until they lie in front, and what is found is turned back.
"""

from __future__ import annotations

import math

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera, needs_facing
from cadalign.geometry.pixels import perspective

_REACH = 85.0  # of rays off the facing axis [degrees]
_OF_OBJECT = 60.0  # half the angle under which an object is seen that stray keypoints go beyond
_CANDIDATES = 200
_ROUNDS = 64


def require_perspective(camera: Camera, what: str) -> None:
    """Refuse a wide lens for ``what`` does without frames that face the keypoints."""
    if camera.is_wide:
        fix = "undistort the photo, or crop it to a pinhole's view"
        raise InputError(f"{what} takes no {camera.lens} lens", where="camera.lens", fix=fix)


def faced(camera: Camera, points_2d: FloatArray) -> Camera:
    """The camera turned to pixels (n, 2); a pinhole, or one that is turned, as it is.

    ``lens_from_camera`` is the rotation that turns back what is found in its frame. Where the
    pixels' rays are too far apart, it faces most of them.
    """
    if not needs_facing([camera]):
        return camera
    rays, valid = camera.rays_where_valid(points_2d)
    axis = _axis_amid(rays[valid]) if valid.any() else np.array([0.0, 0.0, 1.0])
    across = np.cross([0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0], axis)
    across /= np.linalg.norm(across)
    return camera.turned([across, np.cross(axis, across), axis])


def _axis_amid(rays: FloatArray) -> FloatArray:
    """The axis of the narrowest cone about unit vectors (n, 3), or about most of them."""
    axis = _cone_axis(rays)
    if (rays @ axis).min() > math.cos(math.radians(_REACH)):
        return axis
    candidates = rays[:: math.ceil(len(rays) / _CANDIDATES)]
    near = candidates @ rays.T > math.cos(math.radians(_OF_OBJECT))
    return _cone_axis(rays[near[near.sum(axis=1).argmax()]])


def _cone_axis(rays: FloatArray) -> FloatArray:
    """The axis of the narrowest cone: the centre of the smallest ball that holds the unit vectors.

    By Badoiu and Clarkson's iteration ("Smaller core-sets for balls", 2003).
    """
    center = rays.mean(axis=0)
    for k in range(_ROUNDS):
        farthest = rays[((rays - center) ** 2).sum(axis=1).argmax()]
        center = center + (farthest - center) / (k + 2)
    length = float(np.linalg.norm(center))
    return np.asarray(center / length) if length > 0 else rays[0]


def rays_ahead(points_2d: FloatArray, camera: Camera, *, clips: bool = False) -> FloatArray:
    """Rays (n, 2) of the pixels (n, 2) of a wide lens, in the frame that the camera faces.

    With ``clips``, rays beside the frame's field are moved to its border: those of outliers.
    Raises InputError if the lens model cannot be inverted at a pixel, or a ray lies beside the
    field.
    """
    rays = camera.unproject(points_2d)
    border = math.radians(_REACH)
    beside = np.flatnonzero(rays[:, 2] < math.cos(border))
    if len(beside) and not clips:
        raise InputError(
            f"the keypoints surround the camera: {len(beside)} of {len(rays)} lie more than "
            f"{_REACH:g} degrees off the direction amid them, the first is point {beside[0]}",
            where="points_2d",
            fix="give keypoints on one side of the camera, or, if these are outliers, ransac",
        )
    across = rays[beside, :2] / np.linalg.norm(rays[beside, :2], axis=1, keepdims=True)
    rays[beside, :2], rays[beside, 2] = math.sin(border) * across, math.cos(border)
    return perspective(rays)


def turned_alignment(alignment: Alignment, rotation: FloatArray) -> Alignment:
    """The alignment in a camera frame to which ``rotation`` (3, 3) leads."""
    turned = rotation @ alignment.rotation, rotation @ alignment.translation
    return Alignment(*turned, alignment.scale, is_valid=True)


def turned_poses(packed: FloatArray, rotation: FloatArray) -> FloatArray:
    """Packed poses (..., 15) in a camera frame to which ``rotation`` (3, 3) leads."""
    turned = packed.copy()
    columns = packed[..., :9].reshape(*packed.shape[:-1], 3, 3)
    turned[..., :9] = (rotation @ columns).reshape(*packed.shape[:-1], 9)
    turned[..., 9:12] = packed[..., 9:12] @ rotation.T
    return turned


def turned_covariance(covariance: FloatArray, rotation: FloatArray) -> FloatArray:
    """A covariance (..., m, m) of rotation vector, translation and others in such a frame."""
    turn = np.eye(covariance.shape[-1])
    turn[:3, :3] = turn[3:6, 3:6] = rotation
    return np.asarray(turn @ covariance @ turn.T)
