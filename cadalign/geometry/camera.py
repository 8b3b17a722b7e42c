"""The calibrated camera: from camera-frame points to pixels and back; frames that face keypoints.

Estimates are made with rays (u, v, 1), which directions beside and behind the camera's plane lack.
The keypoints of an object that does not surround the camera lie to one side of it: the camera is
turned about its centre until they lie in front, and what is found is turned back.
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
    """A calibrated camera: a pinhole, with lens distortion or without, or a wide lens.

    Camera axes are OpenCV's: x right, y down, z forward. Integer pixel coordinates are pixel
    centres: the top-left pixel's centre is (0, 0), the image spans [-0.5, width - 0.5].

    Parameters
    ----------
    width, height : int
        Image size [px].
    fx, fy : float
        Focal lengths [px].
    cx, cy : float
        Principal point [px].
    distortion : tuple of float, optional
        For a perspective lens OpenCV's coefficients in OpenCV's order and shapes: (k1, k2, p1, p2),
        or with k3, or with k3, k4, k5, k6; empty for none. Its further ones must be 0. For a
        fisheye (k1, k2, k3, k4) as in ``cv2.fisheye``, 0 by default.
    lens : {"perspective", "fisheye"}
        Kind of lens. A fisheye may see points beside and behind the camera's plane; its focal
        length has to be known.
    focal_known : bool
        False for a camera whose focal lengths are placeholders; see `without_focal`.

    Raises
    ------
    InputError
        If a size is not a positive integer, a focal length is missing or not positive, a value is
        not finite, or the coefficients are not those of the lens.

    Examples
    --------
    >>> camera = Camera(width=640, height=480, fx=500, fy=500, cx=319.5, cy=239.5)
    >>> camera.project([[0.0, 0.0, 2.0], [0.2, 0.0, 2.0]]).tolist()
    [[319.5, 239.5], [369.5, 239.5]]
    >>> fisheye = Camera(640, 640, fx=200, fy=200, cx=319.5, cy=319.5, lens="fisheye")
    >>> fisheye.project([[1.0, 0.0, 0.0]]).round(2).tolist()  # 90 degrees off the axis
    [[633.66, 319.5]]
    """

    def turned(self, rotation: npt.ArrayLike) -> Camera:
        """The same camera of a wide lens, its points in a frame that is turned about its centre.

        The rotation (3, 3) leads from this camera's frame to the new one. Image and lens stay where
        they are: the new frame's z axis is not the optical axis.

        Examples
        --------
        >>> camera = Camera(640, 480, 500, 500, 319.5, 239.5, lens="fisheye")
        >>> aside = camera.turned([[0, 0, -1], [0, 1, 0], [1, 0, 0]])  # z is the former x
        >>> bool(np.allclose(aside.project([[0, 0, 1]]), camera.project([[1, 0, 0]])))
        True
        """
        if not self.is_wide:
            raise InputError("the frame of a pinhole is its own", where="camera.lens")
        rows = as_floats(rotation, name="rotation", shape=(3, 3))
        return replace(self, turn=tuple((self.lens_from_camera @ rows.T).ravel().tolist()))

    @property
    def lens_from_camera(self) -> FloatArray:
        """Rotation (3, 3) from the camera's frame to the lens's; see `turned`."""
        return np.array(self.turn).reshape(3, 3) if self.turn else np.eye(3)

    @property
    def is_wide(self) -> bool:
        """True for a lens that may see points beside and behind its plane."""
        return self.lens != "perspective"

    def sees(self, points_cam: FloatArray) -> BoolArray:
        """Say which points (n, 3) of the camera frame have a projection, in the image or not.

        For a pinhole those in front of its plane; for a wide lens those up to the angle from the
        axis at which the image of farther directions would turn back.
        """
        points = points_cam @ self.lens_from_camera.T if self.turn else points_cam
        if not self.is_wide:
            return np.asarray(points[:, 2] > 0)
        angle = np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])
        return np.asarray((angle < largest_angle(self.distortion)) & points.any(axis=1))

    def project(self, points_cam: npt.ArrayLike) -> FloatArray:
        """Project points (n, 3) of the camera frame to pixels (n, 2), in the image or beside it.

        Raises
        ------
        InputError
            If a point lies in or behind the camera's plane (z <= 0), or outside the field of a
            wide lens, or the focal length is unknown.
        """
        self.require_focal()
        points = as_points(points_cam, name="points_cam", dimension=3)
        what, which = "{} points lie behind the camera", "with z > 0"
        if self.is_wide:
            limit = np.degrees(largest_angle(self.distortion))
            what, which = (
                "{} points lie outside the lens's field",
                f"less than {limit:.4g} degrees ",
            )
            which += "off the axis"
        fix = f"only points {which} have a projection"
        _refuse(~self.sees(points), what, fix, where="points_cam")
        return self.pixels_of_rays(points)

    def project_where_ahead(self, points_cam: FloatArray) -> FloatArray:
        """Project points (n, 3) of the camera frame; infinite pixels (n, 2) where not seen."""
        ahead = self.sees(points_cam)
        if ahead.all():
            return self.pixels_of_rays(points_cam)
        pixels = np.full((len(points_cam), 2), np.inf)
        pixels[ahead] = self.pixels_of_rays(points_cam[ahead])
        return pixels

    def pixels_of_rays(self, rays: FloatArray) -> FloatArray:
        """Pixels (n, 2) of directions (n, 3) that the camera `sees`, of any length."""
        with np.errstate(over="ignore", invalid="ignore"):  # far outside the lens model's field
            if self.is_wide:
                image, _ = image_of(rays @ self.lens_from_camera.T, self.lens, self.distortion)
            else:
                image = perspective(rays)
                if self.distortion:
                    image, _ = distort(image, self.lens, self.distortion)
            return image * (self.fx, self.fy) + (self.cx, self.cy)

    def projection_slopes(self, points_cam: FloatArray) -> FloatArray:
        """Derivatives (n, 2, 3) of pixels by points (n, 3) that the camera `sees`."""
        lens_from_camera = self.lens_from_camera
        slopes = image_of(points_cam @ lens_from_camera.T, self.lens, self.distortion)[1]
        return np.asarray(np.array([[self.fx], [self.fy]]) * (slopes @ lens_from_camera))

    def projected_covariances(self, points_cam: FloatArray, covariances: FloatArray) -> FloatArray:
        """Covariances (n, 2, 2) [px squared] of projections of uncertain points, to first order.

        The points (n, 3) are some that the camera `sees`, their covariances are (n, 3, 3).

        Examples
        --------
        >>> camera = Camera(640, 480, 500, 500, 319.5, 239.5)
        >>> camera.projected_covariances(np.array([[0.0, 0.0, 5.0]]), np.eye(3)[None]).tolist()
        [[[10000.0, 0.0], [0.0, 10000.0]]]
        """
        slopes = self.projection_slopes(points_cam)
        return np.asarray(slopes @ covariances @ slopes.swapaxes(1, 2))

    def unproject(self, points_2d: npt.ArrayLike) -> FloatArray:
        """Directions of the rays of pixels (n, 2) in the camera frame, unit vectors (n, 3).

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
        _refuse(~valid, *_NOT_UNDONE)
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def rays_where_valid(self, points_2d: npt.ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Directions (n, 3) of pixels (n, 2), and where they exist (n,): elsewhere without meaning.

        They have z = 1 for a pinhole and the length 1 for a wide lens.
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
        """Turn pixels (n, 2) into normalised image coordinates, the lens distortion removed.

        These are (n, 2), such that (u, v, 1) is the direction of the pixel's ray.

        Raises
        ------
        InputError
            If the lens model cannot be inverted at a pixel (far outside the calibrated image), if
            its ray is 90 degrees or more off the z axis (see `unproject`), or the focal length is
            unknown.
        """
        self.require_focal()
        rays, valid = self.rays_where_valid(points_2d)
        _refuse(~valid, *_NOT_UNDONE)
        what = "the rays of {} pixels are 90 degrees or more off the z axis"
        _refuse(rays[:, 2] <= 0, what, "these have no normalised coordinates; use unproject")
        return perspective(rays)

    def normalize_where_valid(self, points_2d: npt.ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Turn pixels (n, 2) into normalised image coordinates where the lens can be inverted.

        Returns what `normalize` does, meaningless but finite elsewhere, and where it is valid (n,).
        """
        rays, valid = self.rays_where_valid(points_2d)
        behind = rays[:, 2] <= 0
        rays[behind] = (0.0, 0.0, 1.0)
        return perspective(rays), np.asarray(valid & ~behind)

    def pixels_from_normalized(self, normalized: FloatArray) -> FloatArray:
        """Apply lens and calibration matrix to (n, 2) normalised coordinates; gives pixels."""
        return self.pixels_of_rays(_homogeneous(normalized))

    def distortion_jacobian(self, normalized: FloatArray) -> FloatArray:
        """Derivatives (n, 2, 2) of pixels, over focal lengths, by normalised coordinates (n, 2)."""
        if not self.distortion:
            return np.broadcast_to(np.eye(2), (len(normalized), 2, 2))
        if self.is_wide:
            slopes = self.projection_slopes(_homogeneous(normalized))[:, :, :2]
            return np.asarray(slopes / np.array([[self.fx], [self.fy]]))
        return distort(normalized, self.lens, self.distortion)[1]


def needs_facing(cameras: Sequence[Camera]) -> bool:
    """True if any of the cameras has a wide lens whose frame faces nothing yet."""
    return True in [camera.is_wide and not camera.turn for camera in cameras]


def _homogeneous(normalized: FloatArray) -> FloatArray:
    return np.column_stack([normalized, np.ones(len(normalized))])


def _refuse(odd: BoolArray, what: str, fix: str, *, where: str = "points_2d") -> None:
    """Refuse rows (n,), of which ``what`` is said; its place is for their number."""
    rows = np.flatnonzero(odd)
    if len(rows):
        what = what.format(f"{len(rows)} of {len(odd)}")
        raise InputError(f"{what}, the first is point {rows[0]}", where=where, fix=fix)


_NOT_UNDONE = (
    "the lens distortion cannot be undone at {} pixels",
    "these lie outside the area in which the lens model is valid; drop them",
)
_REACH = 85.0  # of rays off the facing axis [degrees]
_OF_OBJECT = 60.0  # half the angle under which an object is seen that stray keypoints go beyond
_CANDIDATES = 200
_ROUNDS = 64
_OF_A_RESULT = 10  # unknowns of a result's covariance, focal length included


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
    beside = rays[:, 2] < math.cos(border)
    if not clips:
        what = "the keypoints surround the camera: {} lie more than "
        what += f"{_REACH:g} degrees off the direction amid them"
        fix = "give keypoints on one side of the camera, or, if these are outliers, ransac"
        _refuse(beside, what, fix)
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


def projection_jacobian(points_3d: FloatArray, camera: Camera, alignment: Alignment) -> FloatArray:
    """Derivatives (n, 2, 10) of projected points, in the order of `cadalign.Result.covariance`.

    In pixels per rad, model unit, and unit of a logarithm. Refuses points behind the camera.
    """
    in_camera = alignment.apply(points_3d)
    if not camera.sees(in_camera).all():
        raise InputError("a point lies behind the camera", where="points_3d")
    stretched = points_3d * alignment.scale
    turned = stretched @ alignment.rotation.T
    jacobian = np.empty((len(points_3d), 2, _OF_A_RESULT))
    by_point = camera.projection_slopes(in_camera)
    jacobian[:, :, :3] = np.cross(turned[:, None], by_point)
    jacobian[:, :, 3:6] = by_point
    jacobian[:, :, 6:9] = by_point @ (alignment.rotation * stretched[:, None])
    jacobian[:, :, 9] = camera.pixels_of_rays(in_camera) - (camera.cx, camera.cy)
    return jacobian
