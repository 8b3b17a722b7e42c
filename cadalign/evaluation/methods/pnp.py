"""OpenCV's and PoseLib's solvers as methods.

They estimate the pose of the model as it is, without a stretch, as do programs for known objects.
A lens distortion is removed before they are called.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from cadalign.errors import CadalignError, DegenerateError
from cadalign.evaluation.methods.method import Method, MethodInput
from cadalign.geometry.alignment import Alignment

_INLIER_BOUND = 3.5  # standard deviations, as of the built-in robust methods


def _solve_pnp(given: MethodInput, *, flag: str) -> Alignment:
    """The pose of ``cv2.solvePnP`` with one of its flags."""
    import cv2

    rays, flags = given.camera.normalize(given.points_2d), int(getattr(cv2, flag))
    try:
        is_found, vector, shift = cv2.solvePnP(given.points_3d, rays, np.eye(3), None, flags=flags)
    except cv2.error as error:
        raise DegenerateError(f"OpenCV: {error.err}") from None
    if not is_found:
        raise DegenerateError("OpenCV finds no pose")
    rotation = np.asarray(cv2.Rodrigues(vector)[0], dtype=float)
    return Alignment(rotation, np.asarray(shift, dtype=float).ravel(), np.ones(3))


def _poselib_pose(given: MethodInput) -> Alignment:
    """The pose of PoseLib's LO-RANSAC on the minimal solver P3P, refined on the inliers."""
    try:
        import poselib
    except ImportError:
        raise CadalignError("PoseLib is not installed", fix="pip install poselib") from None
    camera = given.camera
    focal, center = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    pinhole = {
        "model": "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "params": [*focal.tolist(), *center.tolist()],
    }
    pixels = camera.normalize(given.points_2d) * focal + center
    how: dict[str, Any] = {"max_reproj_error": _INLIER_BOUND * given.sigma}
    pose, found = poselib.estimate_absolute_pose(pixels, given.points_3d, pinhole, how, {})
    if not sum(found["inliers"]):
        raise DegenerateError("PoseLib finds no pose")
    return Alignment(np.asarray(pose.R), np.asarray(pose.t), np.ones(3))


_SOLVERS: dict[str, Callable[[MethodInput], Alignment]] = {
    "opencv-epnp": partial(_solve_pnp, flag="SOLVEPNP_EPNP"),
    "opencv-sqpnp": partial(_solve_pnp, flag="SOLVEPNP_SQPNP"),
    "opencv-iterative": partial(_solve_pnp, flag="SOLVEPNP_ITERATIVE"),
    "poselib": _poselib_pose,
}
PNP_METHODS = {name: Method(name, solve, is_general=True) for name, solve in _SOLVERS.items()}
