"""A view: what one image tells about an object."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats, as_points, is_number, read_only
from cadalign.errors import InputError, quote
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
    depth : (n,) float, optional
        Depths of the keypoints, their z in the camera's frame [model units]; NaN where unknown.
    depth_sigma : float or (n,) float
        Standard deviation of the depths, relative (0.005 is 0.5 %).
    up : (3,) float, optional
        The direction of the model's up axis in the camera's frame (OpenCV's: y points down),
        from an accelerometer for example; of any length.
    up_sigma_deg : float
        Its standard deviation about each axis across it [degrees].
    cam_from_rig : (4, 4) float, optional
        The camera's known pose in a frame that several views share. Where no view has one, the
        cameras moved in an unknown way between them.

    Raises
    ------
    InputError
        If shapes don't match, ids repeat, a value is NaN or infinite, or a pose is no rigid motion.

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
    depth: npt.ArrayLike | None = None
    depth_sigma: npt.ArrayLike = 0.01
    up: npt.ArrayLike | None = None
    up_sigma_deg: float = 1.0
    cam_from_rig: npt.ArrayLike | None = None

    def __post_init__(self) -> None:
        _check_camera(self.camera)
        points = np.empty((0, 2)) if np.size(self.points_2d) == 0 else self.points_2d
        points = as_points(points, name="points_2d", dimension=2)
        object.__setattr__(self, "points_2d", read_only(points))
        object.__setattr__(self, "ids", checked_ids(self.ids, len(points)))
        self._check_depth(len(points))
        self._check_up()
        if self.cam_from_rig is not None:
            object.__setattr__(self, "cam_from_rig", read_only(_rigid(self.cam_from_rig)))

    @property
    def keypoint_ids(self) -> tuple[Hashable, ...]:
        """Ids of the keypoints; see ``ids``."""
        return cast("tuple[Hashable, ...]", self.ids)

    def _check_depth(self, count: int) -> None:
        if self.depth is None:
            return
        depth = np.asarray(self.depth, dtype=np.float64)
        if depth.shape != (count,):
            raise InputError(f"shape {depth.shape}, expected ({count},)", where="depth")
        known = np.isfinite(depth)
        if (depth[known] <= 0).any():
            fix = "give NaN where it is unknown"
            raise InputError("has values that are not positive", where="depth", fix=fix)
        relative = np.asarray(self.depth_sigma, dtype=np.float64)
        if relative.shape not in ((), (count,)) or not (relative > 0).all():
            raise InputError("must be positive, one or one per keypoint", where="depth_sigma")
        object.__setattr__(self, "depth", read_only(np.where(known, depth, np.nan)))

    def _check_up(self) -> None:
        if self.up is None:
            return
        up = as_floats(self.up, name="up", shape=(3,))
        length = float(np.linalg.norm(up))
        if not length > 0:
            raise InputError("a direction must not be zero", where="up")
        if not is_number(self.up_sigma_deg) or not self.up_sigma_deg > 0:
            raise InputError(f"{quote(self.up_sigma_deg)} is not positive", where="up_sigma_deg")
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
