"""A view: what one image tells about an object."""

from __future__ import annotations

import os
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, as_floats, as_points, as_positive, read_only
from cadalign.errors import InputError
from cadalign.fitting.joint.channels import (
    checked_depth,
    checked_depth_sigma,
    checked_mask,
    checked_up_sigma,
)
from cadalign.fitting.joint.model import checked_ids
from cadalign.fitting.options import Sigma
from cadalign.geometry.camera import Camera

_ROTATION_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class View:
    """Evidence of one image about an object.

    Parameters
    ----------
    camera : Camera
        The calibrated camera.
    points_2d : (n, 2) float
        Keypoints in the image [px]; integers are pixel centres.
    ids : sequence of n int or str, optional
        The model's ids or names of these keypoints; by default its first n, in its order.
    sigma : float, (n,) float, or (n, 2, 2) float
        Standard deviation of the keypoints, of each, or covariance of each [px].
    confidences : (n,) float, optional
        Confidences of the keypoints, for a robust search.
    depth : (n,) or (h, w) float, or path, optional
        Depths of the keypoints, their z in the camera's frame, or an image of such depths that is
        registered to the photo, as an array or as a 16-bit PNG [model units, or the unit in which
        the object's size is wanted]; 0 or NaN where unknown. A depth image is sampled robustly at
        the keypoints and, with a mask and a mesh, over the visible surface.
    depth_sigma : float or (n,) float
        Standard deviation of the depths, relative (0.005 is 0.5 %).
    depth_scale : float, optional
        Units per count of a depth image; by default 0.001 for a file (millimetres to metres), 1 for
        an array of floats.
    up : (3,) float, optional
        The direction of the model's up axis in the camera's frame (OpenCV's: y points down), of any
        length; `cadalign.geometry.gravity` computes it from gravity, pitch and roll, a phone's
        pose, or clicks on vertical edges.
    up_sigma_deg : float or (3, 3) float
        Its standard deviation about each axis across it [degrees], or the covariance of the
        direction [degrees squared].
    camera_height : float, optional
        Height of the camera above the plane that the object stands on with its lowest face [the
        unit in which the object's size is wanted]. ``up`` says how the plane lies.
    camera_height_sigma : float
        Its standard deviation, relative.
    cam_from_rig : (4, 4) float, optional
        The camera's known pose in a frame that several views share. Where no view has one, the
        cameras moved in an unknown way between them.
    mask : (h, w) bool or float, or path, optional
        Pixels of the object in an image of the camera's size: True, or their probabilities in
        [0, 1], or an 8-bit grey PNG that is not zero there.
    mask_sigma : float, optional
        Standard deviation of the mask's contour along its normal [px]; None estimates it.

    Raises
    ------
    InputError
        If shapes don't match, ids repeat, a value is NaN or infinite, a pose is no rigid motion, or
        an image has another size than the camera.
    DataError
        If a file cannot be read.

    Examples
    --------
    >>> camera = Camera(640, 480, 500, 500, 319.5, 239.5)
    >>> View(camera, [[320.0, 240.0], [330.0, 250.0]], ids=["nose", "tail"]).ids
    ('nose', 'tail')
    """

    camera: Camera
    points_2d: npt.ArrayLike = ()
    ids: Sequence[Hashable] | None = None
    sigma: Sigma = 1.0
    confidences: npt.ArrayLike | None = None
    depth: npt.ArrayLike | str | os.PathLike[str] | None = None
    depth_sigma: npt.ArrayLike = 0.01
    up: npt.ArrayLike | None = None
    up_sigma_deg: npt.ArrayLike = 1.0
    cam_from_rig: npt.ArrayLike | None = None
    depth_scale: float | None = None
    camera_height: float | None = None
    camera_height_sigma: float = 0.02
    mask: npt.ArrayLike | str | os.PathLike[str] | None = None
    mask_sigma: float | None = None

    def __post_init__(self) -> None:
        _check_camera(self.camera)
        points = np.empty((0, 2)) if np.size(self.points_2d) == 0 else self.points_2d
        points = as_points(points, name="points_2d", dimension=2)
        object.__setattr__(self, "points_2d", read_only(points))
        object.__setattr__(self, "ids", checked_ids(self.ids, len(points)))
        if self.depth is not None:
            depth = checked_depth(self.depth, self.camera, len(points), self.depth_scale)
            object.__setattr__(self, "depth", read_only(depth))
        checked_depth_sigma(self.depth_sigma, self.depth, len(points))
        self._check_up()
        if self.camera_height is not None:
            height = as_positive(self.camera_height, name="camera_height")
            object.__setattr__(self, "camera_height", height)
        as_positive(self.camera_height_sigma, name="camera_height_sigma")
        if self.cam_from_rig is not None:
            object.__setattr__(self, "cam_from_rig", read_only(_rigid(self.cam_from_rig)))
        if self.mask is not None:
            object.__setattr__(self, "mask", read_only(checked_mask(self.mask, self.camera)))
        if self.mask_sigma is not None:
            as_positive(self.mask_sigma, name="mask_sigma")

    def __repr__(self) -> str:
        names = ("mask", "depth", "up", "camera_height", "cam_from_rig")
        given = [name for name in names if getattr(self, name) is not None]
        return f"View({', '.join([f'{np.shape(self.points_2d)[0]} keypoints', *given])})"

    @property
    def keypoint_ids(self) -> tuple[Hashable, ...]:
        """Ids of the keypoints; see ``ids``."""
        return cast("tuple[Hashable, ...]", self.ids)

    @property
    def depth_image(self) -> FloatArray | None:
        """The depth image (h, w), NaN where unknown; None where ``depth`` is none."""
        is_image = self.depth is not None and np.ndim(cast(FloatArray, self.depth)) == 2
        return cast(FloatArray, self.depth) if is_image else None

    @property
    def mask_image(self) -> FloatArray | BoolArray | None:
        """The mask (h, w), bool or probabilities."""
        return cast("FloatArray | BoolArray | None", self.mask)

    def _check_up(self) -> None:
        if self.up is None:
            return
        up = as_floats(self.up, name="up", shape=(3,))
        length = float(np.linalg.norm(up))
        if not length > 0:
            raise InputError("a direction must not be zero", where="up")
        checked_up_sigma(self.up_sigma_deg)
        object.__setattr__(self, "up", read_only(up / length))


def _check_camera(camera: object) -> None:
    if not isinstance(camera, Camera):
        raise InputError(f"expected a cadalign.Camera, got {type(camera).__name__}", where="camera")
    if not camera.focal_known:
        fix = "give a camera with one, for example from fit(..., focal='estimate').camera"
        raise InputError("its focal length is unknown", where="camera", fix=fix)


def _rigid(pose: npt.ArrayLike) -> FloatArray:
    """A checked rigid motion (4, 4)."""
    matrix = as_floats(pose, name="cam_from_rig", shape=(4, 4))
    rotation = matrix[:3, :3]
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        fix = "its upper left 3 x 3 must be a rotation, without scale"
        raise InputError("not a rigid motion", where="cam_from_rig", fix=fix)
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > _ROTATION_TOLERANCE:
        raise InputError("its last row must be 0, 0, 0, 1", where="cam_from_rig")
    return matrix
