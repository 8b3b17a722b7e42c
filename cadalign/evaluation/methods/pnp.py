"""OpenCV's and PoseLib's solvers as methods: examples of registered functions.

They estimate the pose of the model as it is, without a stretch, as do programs for known objects.
A lens distortion is removed before they are called.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import cv2
import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, DegenerateError
from cadalign.evaluation.methods.registry import register_method
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

OPENCV_FLAGS = {
    "opencv-epnp": cv2.SOLVEPNP_EPNP,
    "opencv-sqpnp": cv2.SOLVEPNP_SQPNP,
    "opencv-iterative": cv2.SOLVEPNP_ITERATIVE,
}
_INLIER_BOUND = 3.5  # standard deviations, as of the built-in robust methods


def solve_pnp(
    points_3d: FloatArray, points_2d: FloatArray, camera: Camera, *, flag: int
) -> Alignment:
    """The pose of ``cv2.solvePnP`` with one of its flags."""
    rays = camera.normalize(points_2d)
    try:
        is_found, vector, shift = cv2.solvePnP(points_3d, rays, np.eye(3), None, flags=flag)
    except cv2.error as error:
        raise DegenerateError(f"OpenCV: {error.err}") from None
    if not is_found:
        raise DegenerateError("OpenCV finds no pose")
    rotation = np.asarray(cv2.Rodrigues(vector)[0], dtype=float)
    return Alignment(rotation, np.asarray(shift, dtype=float).ravel(), np.ones(3))


def poselib_pose(
    points_3d: FloatArray, points_2d: FloatArray, camera: Camera, *, sigma: float
) -> Alignment:
    """The pose of PoseLib's LO-RANSAC on the minimal solver P3P, refined on the inliers."""
    try:
        import poselib
    except ImportError:
        raise CadalignError("PoseLib is not installed", fix="pip install poselib") from None
    focal, center = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    pinhole = {
        "model": "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "params": [*focal.tolist(), *center.tolist()],
    }
    pixels = camera.normalize(points_2d) * focal + center
    how: dict[str, Any] = {"max_reproj_error": _INLIER_BOUND * sigma}
    pose, found = poselib.estimate_absolute_pose(pixels, points_3d, pinhole, how, {})
    if not sum(found["inliers"]):
        raise DegenerateError("PoseLib finds no pose")
    return Alignment(np.asarray(pose.R), np.asarray(pose.t), np.ones(3))


for _name, _flag in OPENCV_FLAGS.items():
    register_method(_name, partial(solve_pnp, flag=_flag))
register_method("poselib", poselib_pose)
