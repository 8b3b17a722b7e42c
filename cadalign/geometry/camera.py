"""The calibrated camera: project camera-frame points to pixels and back.

Solvers use rays (u, v, 1). A wide lens also sees directions at 90 degrees or more off its axis,
for which no such ray exists. Its frame is therefore turned until the keypoints lie in front of it,
and the estimate is turned back. This works unless the object surrounds the camera.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, as_floats, as_points
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.calibration import COLMAP_PARAMS as COLMAP_PARAMS
from cadalign.geometry.calibration import Calibration
from cadalign.geometry.pixels import (
    distort,
    image_of,
    largest_angle,
    perspective,
    rays_of_image,
    undistort,
)


class Camera(Calibration):
    """A calibrated camera with a perspective lens or a fisheye, with or without distortion.

    Camera axes follow OpenCV: x right, y down, z forward. Integer pixel coordinates are pixel
    centres: the top-left pixel's centre is (0, 0), and the image spans [-0.5, width - 0.5].

    Parameters
    ----------
    width, height : int
        Image size [px].
    fx, fy : float
        Focal lengths [px].
    cx, cy : float
        Principal point [px].
    distortion : tuple of float, optional
        OpenCV's coefficients in OpenCV's order and shapes. For a perspective lens
        (k1, k2, p1, p2), optionally followed by k3 or by k3, k4, k5, k6; empty for no distortion.
        OpenCV's further coefficients must be 0. For a fisheye (k1, k2, k3, k4) as in
        ``cv2.fisheye``, all 0 by default.
    lens : {"perspective", "fisheye"}
        Kind of lens. A fisheye may see points beside and behind the camera. Its focal length must
        be known.
    focal_known : bool
        False if the focal lengths are placeholders; see `from_size`.

    Raises
    ------
    InputError
        If a size is not a positive integer, a focal length is missing or not positive, a value is
        not finite, or the coefficients don't fit the lens.

    Examples
    --------
    >>> camera = Camera(width=640, height=480, fx=500, fy=500, cx=319.5, cy=239.5)
    >>> camera.project([[0.0, 0.0, 2.0], [0.2, 0.0, 2.0]]).tolist()
    [[319.5, 239.5], [369.5, 239.5]]
    >>> fisheye = Camera(640, 640, fx=200, fy=200, cx=319.5, cy=319.5, lens="fisheye")
    >>> fisheye.project([[1.0, 0.0, 0.0]]).round(2).tolist()  # 90 degrees off the axis
    [[633.66, 319.5]]
    """

    def rotate(self, rotation: npt.ArrayLike) -> Camera:
        """Turn the frame of a camera with a wide lens about the camera centre.

        ``rotation`` (3, 3) maps this camera's frame to the new one. The image and the lens do not
        change, so the new frame's z axis is not the optical axis.

        Raises
        ------
        InputError
            If the lens is not wide.

        Examples
        --------
        >>> camera = Camera(640, 480, 500, 500, 319.5, 239.5, lens="fisheye")
        >>> aside = camera.rotate([[0, 0, -1], [0, 1, 0], [1, 0, 0]])  # z is the former x
        >>> bool(np.allclose(aside.project([[0, 0, 1]]), camera.project([[1, 0, 0]])))
        True
        """
        if not self.is_wide:
            raise InputError("a perspective camera cannot be turned", where="camera.lens")
        rows = as_floats(rotation, name="rotation", shape=(3, 3))
        return replace(self, turn=tuple((self.lens_from_camera @ rows.T).ravel().tolist()))

    @property
    def lens_from_camera(self) -> FloatArray:
        """Rotation (3, 3) from the camera's frame to the lens's frame; see `rotate`."""
        return np.array(self.turn).reshape(3, 3) if self.turn else np.eye(3)

    @property
    def is_wide(self) -> bool:
        """True for a lens that may see points beside and behind the camera."""
        return self.lens != "perspective"

    def sees(self, points_cam: FloatArray) -> BoolArray:
        """Mask (n,) of the camera-frame points (n, 3) that have a projection, in the image or not.

        A perspective lens sees points with z > 0, a wide lens points up to `largest_angle`.
        """
        points = points_cam @ self.lens_from_camera.T if self.turn else points_cam
        if not self.is_wide:
            return np.asarray(points[:, 2] > 0)
        angle = np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])
        return np.asarray((angle < largest_angle(self.distortion)) & points.any(axis=1))

    def project(self, points_cam: npt.ArrayLike) -> FloatArray:
        """Project camera-frame points (n, 3) to pixels (n, 2), inside the image or outside.

        Raises
        ------
        InputError
            If a point has z <= 0 (perspective lens) or lies outside the field of view (wide lens),
            or the focal length is unknown.
        """
        self.require_focal()
        points = as_points(points_cam, name="points_cam", dimension=3)
        what, which = "{} points lie behind the camera", "with z > 0"
        if self.is_wide:
            what = "{} points lie outside the lens's field of view"
            limit = np.degrees(largest_angle(self.distortion))
            which = f"less than {limit:.4g} degrees off the axis"
        fix = f"only points {which} have a projection"
        _refuse(~self.sees(points), what, fix, where="points_cam")
        return self.pixels_of_rays(points)

    def project_where_ahead(self, points_cam: FloatArray) -> FloatArray:
        """Project camera-frame points (n, 3) to pixels (n, 2), infinite for unseen points."""
        ahead = self.sees(points_cam)
        if ahead.all():
            return self.pixels_of_rays(points_cam)
        pixels = np.full((len(points_cam), 2), np.inf)
        pixels[ahead] = self.pixels_of_rays(points_cam[ahead])
        return pixels

    def pixels_of_rays(self, rays: FloatArray) -> FloatArray:
        """Pixels (n, 2) of directions (n, 3) of any length, all of which the camera `sees`."""
        with np.errstate(over="ignore", invalid="ignore"):  # far outside the lens model's range
            if self.is_wide:
                image, _ = image_of(rays @ self.lens_from_camera.T, self.lens, self.distortion)
            else:
                image = perspective(rays)
                if self.distortion:
                    image, _ = distort(image, self.lens, self.distortion)
            return image * (self.fx, self.fy) + (self.cx, self.cy)

    def projection_slopes(self, points_cam: FloatArray) -> FloatArray:
        """Derivatives (n, 2, 3) of pixels by points (n, 3), all of which the camera `sees`."""
        lens_from_camera = self.lens_from_camera
        slopes = image_of(points_cam @ lens_from_camera.T, self.lens, self.distortion)[1]
        return np.asarray(np.array([[self.fx], [self.fy]]) * (slopes @ lens_from_camera))

    def projected_covariances(self, points_cam: FloatArray, covariances: FloatArray) -> FloatArray:
        """Propagate covariances (n, 3, 3) of points to their pixels, to first order.

        The camera must see all points (n, 3). Returns covariances (n, 2, 2) [px squared].

        Examples
        --------
        >>> camera = Camera(640, 480, 500, 500, 319.5, 239.5)
        >>> camera.projected_covariances(np.array([[0.0, 0.0, 5.0]]), np.eye(3)[None]).tolist()
        [[[10000.0, 0.0], [0.0, 10000.0]]]
        """
        slopes = self.projection_slopes(points_cam)
        return np.asarray(slopes @ covariances @ slopes.swapaxes(1, 2))

    def unproject(self, points_2d: npt.ArrayLike) -> FloatArray:
        """Convert pixels (n, 2) to unit direction vectors (n, 3) in the camera frame.

        For a wide lens, z may be 0 or negative.

        Raises
        ------
        InputError
            If the lens model cannot be inverted at a pixel, or the focal length is unknown.

        Examples
        --------
        >>> camera = Camera(640, 640, fx=200, fy=200, cx=319.5, cy=319.5, lens="fisheye")
        >>> camera.unproject([[319.5 + 200 * np.pi / 4, 319.5]]).round(3).tolist()
        [[0.707, 0.0, 0.707]]
        """
        self.require_focal()
        rays, valid = self.rays_where_valid(points_2d)
        _refuse(~valid, *_NOT_INVERTIBLE)
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def rays_where_valid(self, points_2d: npt.ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Convert pixels (n, 2) to directions (n, 3), with a mask (n,) of the valid ones.

        Directions have z = 1 for a perspective lens and length 1 for a wide lens. Invalid ones
        are meaningless.
        """
        points = as_points(points_2d, name="points_2d", dimension=2)
        valid = np.full(len(points), True)
        with np.errstate(over="ignore", invalid="ignore"):  # lens polynomials
            image = (points - (self.cx, self.cy)) / (self.fx, self.fy)
            if self.is_wide:
                rays, valid = rays_of_image(image, self.distortion)
                return np.asarray(rays @ self.lens_from_camera), valid
            if self.distortion:
                image, valid = undistort(image, self.lens, self.distortion)
        return _homogeneous(image), valid

    def normalize(self, points_2d: npt.ArrayLike) -> FloatArray:
        """Convert pixels (n, 2) to normalised image coordinates (n, 2), without distortion.

        The direction of a pixel's ray is (u, v, 1).

        Raises
        ------
        InputError
            If the lens model cannot be inverted at a pixel (far outside the calibrated image), a
            ray is 90 degrees or more off the z axis (see `unproject`), or the focal length is
            unknown.
        """
        self.require_focal()
        rays, valid = self.rays_where_valid(points_2d)
        _refuse(~valid, *_NOT_INVERTIBLE)
        what = "the rays of {} pixels are 90 degrees or more off the z axis"
        _refuse(rays[:, 2] <= 0, what, "these have no normalised coordinates; use unproject")
        return perspective(rays)

    def normalize_where_valid(self, points_2d: npt.ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Convert pixels (n, 2) to normalised image coordinates where the lens can be inverted.

        Returns coordinates (n, 2) as `normalize` does, and a mask (n,) of the valid ones. Invalid
        coordinates are finite but meaningless.
        """
        rays, valid = self.rays_where_valid(points_2d)
        behind = rays[:, 2] <= 0
        rays[behind] = (0.0, 0.0, 1.0)
        return perspective(rays), np.asarray(valid & ~behind)

    def pixels_from_normalized(self, normalized: FloatArray) -> FloatArray:
        """Convert normalised image coordinates (n, 2) to pixels (n, 2)."""
        return self.pixels_of_rays(_homogeneous(normalized))

    def distortion_jacobian(self, normalized: FloatArray) -> FloatArray:
        """Derivatives (n, 2, 2) of pixels / focal length by normalised coordinates (n, 2)."""
        if not self.distortion:
            return np.broadcast_to(np.eye(2), (len(normalized), 2, 2))
        if self.is_wide:
            slopes = self.projection_slopes(_homogeneous(normalized))[:, :, :2]
            return np.asarray(slopes / np.array([[self.fx], [self.fy]]))
        return distort(normalized, self.lens, self.distortion)[1]


def needs_facing(cameras: Sequence[Camera]) -> bool:
    """True if any camera has a wide lens and its frame has not been turned yet."""
    return True in [camera.is_wide and not camera.turn for camera in cameras]


def _homogeneous(normalized: FloatArray) -> FloatArray:
    return np.column_stack([normalized, np.ones(len(normalized))])


def _refuse(odd: BoolArray, what: str, fix: str, *, where: str = "points_2d") -> None:
    """Raise an InputError if any row of ``odd`` (n,) is True; ``what`` has a slot for the count."""
    rows = np.flatnonzero(odd)
    if len(rows):
        what = what.format(f"{len(rows)} of {len(odd)}")
        raise InputError(f"{what}, the first is point {rows[0]}", where=where, fix=fix)


_NOT_INVERTIBLE = (
    "the lens distortion cannot be undone at {} pixels",
    "these lie outside the area in which the lens model is valid; drop them",
)
_MOST_OFF_AXIS = 85.0  # angle between a ray and the facing axis [degrees]
_OBJECT_HALF_ANGLE = 60.0  # keypoints farther from the object's direction are outliers [degrees]
_CANDIDATES = 200
_ROUNDS = 64
_RESULT_UNKNOWNS = 10  # of a result's covariance, focal length included


def face_pixels(camera: Camera, points_2d: FloatArray) -> Camera:
    """Turn a camera with a wide lens so that its z axis faces pixels (n, 2), or most of them.

    A perspective or already turned camera is returned unchanged. ``lens_from_camera`` of the
    result rotates estimates back to the original frame.
    """
    if not needs_facing([camera]):
        return camera
    rays, valid = camera.rays_where_valid(points_2d)
    axis = _facing_axis(rays[valid]) if valid.any() else np.array([0.0, 0.0, 1.0])
    across = np.cross([0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0], axis)
    across /= np.linalg.norm(across)
    return camera.rotate([across, np.cross(axis, across), axis])


def _facing_axis(rays: FloatArray) -> FloatArray:
    """Axis of the narrowest cone around unit vectors (n, 3), or around most of them."""
    axis = _cone_axis(rays)
    if (rays @ axis).min() > math.cos(math.radians(_MOST_OFF_AXIS)):
        return axis
    candidates = rays[:: math.ceil(len(rays) / _CANDIDATES)]
    near = candidates @ rays.T > math.cos(math.radians(_OBJECT_HALF_ANGLE))
    return _cone_axis(rays[near[near.sum(axis=1).argmax()]])


def _cone_axis(rays: FloatArray) -> FloatArray:
    """Axis of the narrowest cone around unit vectors: the direction of their ball's centre.

    The smallest enclosing ball is found by Badoiu and Clarkson's iteration ("Smaller core-sets for
    balls", 2003).
    """
    center = rays.mean(axis=0)
    for k in range(_ROUNDS):
        farthest = rays[((rays - center) ** 2).sum(axis=1).argmax()]
        center = center + (farthest - center) / (k + 2)
    length = float(np.linalg.norm(center))
    return np.asarray(center / length) if length > 0 else rays[0]


def rays_ahead(points_2d: FloatArray, camera: Camera, *, clips: bool = False) -> FloatArray:
    """Normalised coordinates (n, 2) of pixels (n, 2) in the frame of a camera of `face_pixels`.

    ``clips`` moves rays more than 85 degrees off the z axis to 85 degrees; otherwise they raise
    InputError. So do pixels at which the lens model cannot be inverted.
    """
    rays = camera.unproject(points_2d)
    border = math.radians(_MOST_OFF_AXIS)
    beside = rays[:, 2] < math.cos(border)
    if not clips:
        what = "the keypoints surround the camera: {} lie more than "
        what += f"{_MOST_OFF_AXIS:g} degrees off their central direction"
        fix = "give keypoints on one side of the camera, or, if these are outliers, use ransac"
        _refuse(beside, what, fix)
    across = rays[beside, :2] / np.linalg.norm(rays[beside, :2], axis=1, keepdims=True)
    rays[beside, :2], rays[beside, 2] = math.sin(border) * across, math.cos(border)
    return perspective(rays)


def rotate_alignment(alignment: Alignment, rotation: FloatArray) -> Alignment:
    """Transform an alignment by the ``rotation`` (3, 3) from its camera frame to a new one."""
    turned = rotation @ alignment.rotation, rotation @ alignment.translation
    return Alignment(*turned, alignment.scale, is_valid=True)


def rotate_poses(packed: FloatArray, rotation: FloatArray) -> FloatArray:
    """Transform packed poses (..., 15) by the ``rotation`` (3, 3) to a new camera frame."""
    turned = packed.copy()
    columns = packed[..., :9].reshape(*packed.shape[:-1], 3, 3)
    turned[..., :9] = (rotation @ columns).reshape(*packed.shape[:-1], 9)
    turned[..., 9:12] = packed[..., 9:12] @ rotation.T
    return turned


def rotate_covariance(covariance: FloatArray, rotation: FloatArray) -> FloatArray:
    """Transform a pose's covariance (..., m, m), m >= 6, by the ``rotation`` (3, 3)."""
    turn = np.eye(covariance.shape[-1])
    turn[:3, :3] = turn[3:6, 3:6] = rotation
    return np.asarray(turn @ covariance @ turn.T)


def projection_jacobian(points_3d: FloatArray, camera: Camera, alignment: Alignment) -> FloatArray:
    """Derivatives (n, 2, 10) of projected points by the unknowns of `cadalign.Result.covariance`.

    Units: pixels per rad, per model unit, and per unit of a logarithm. Raises InputError if a point
    lies behind the camera.
    """
    in_camera = alignment.apply(points_3d)
    if not camera.sees(in_camera).all():
        raise InputError("a point lies behind the camera", where="points_3d")
    stretched = points_3d * alignment.scale
    turned = stretched @ alignment.rotation.T
    jacobian = np.empty((len(points_3d), 2, _RESULT_UNKNOWNS))
    by_point = camera.projection_slopes(in_camera)
    jacobian[:, :, :3] = np.cross(turned[:, None], by_point)
    jacobian[:, :, 3:6] = by_point
    jacobian[:, :, 6:9] = by_point @ (alignment.rotation * stretched[:, None])
    jacobian[:, :, 9] = camera.pixels_of_rays(in_camera) - (camera.cx, camera.cy)
    return jacobian
