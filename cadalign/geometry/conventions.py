"""Axes and pixel centres of other programs, and their conversion: the only place for either.

OpenGL's camera (also NeRF's) looks along -z with y up, where cadalign's looks along
+z with y down. Its image begins at the border of the corner pixel, as COLMAP's does, where
cadalign's begins at the pixel's centre, `PIXEL_CENTRE` from there in x and y.
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import PIXEL_CENTRE, rescaled_pixels

__all__ = [
    "OPENGL_AXES",
    "OPENGL_FLIP",
    "PIXEL_CENTRE",
    "alignment_from_opengl",
    "opengl_from_model",
    "opengl_projection",
    "rescaled_pixels",
    "resized_camera",
]

OPENGL_AXES = np.array([1.0, -1.0, -1.0])
"""Signs of OpenGL's camera axes in cadalign's: multiply coordinates (n, 3) to go either way."""

OPENGL_FLIP = np.diag([*OPENGL_AXES, 1.0])
"""Motion (4, 4) between the axes of the two cameras, either way."""


def resized_camera(camera: Camera, width: int, height: int) -> Camera:
    """The camera of an image that was resized to so many pixels; see `Camera.resized`."""
    return camera.resized(width, height)


def opengl_from_model(cam_from_model: Alignment) -> FloatArray:
    """The model-view matrix: stretched, posed, in OpenGL's camera axes; (4, 4) float.

    Examples
    --------
    >>> from cadalign import Alignment
    >>> opengl_from_model(Alignment(np.eye(3), [1, 2, 3], [1, 1, 1]))[:, 3].tolist()
    [1.0, -2.0, -3.0, 1.0]
    """
    return np.asarray(OPENGL_FLIP @ cam_from_model.cam_from_model)


def alignment_from_opengl(opengl_from_world: FloatArray) -> Alignment:
    """Convert a rigid model-view matrix (4, 4) to a pose in cadalign's axes; scale 1.

    Raises
    ------
    InputError
        If the matrix is not a rotation and a translation.
    """
    matrix = OPENGL_FLIP @ opengl_from_world
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-9:
        raise InputError("the last row is not (0, 0, 0, 1)", where="transform")
    return Alignment(matrix[:3, :3], matrix[:3, 3], np.ones(3))


def opengl_projection(
    camera: Camera,
    *,
    near: float,
    far: float,
    window: tuple[int, int, int, int] | None = None,
) -> FloatArray:
    """The projection matrix (4, 4) of a camera; its lens distortion has no place in one.

    It leads from OpenGL's camera axes to clip coordinates, between the depths ``near`` and ``far``.
    The window (left, top, width, height) [px] fills the viewport; by default all of the image does.

    Examples
    --------
    >>> from cadalign import Camera
    >>> camera = Camera(width=4, height=2, fx=2, fy=2, cx=1.5, cy=0.5)
    >>> clip = opengl_projection(camera, near=1, far=3) @ (0, 0, -1, 1)
    >>> (clip / clip[3]).tolist()
    [0.0, 0.0, -1.0, 1.0]
    """
    left, top, width, height = window or (0, 0, camera.width, camera.height)
    # A pixel's x in the window, from its border, is fx X / Z + border_x.
    border_x = camera.cx + PIXEL_CENTRE - left
    border_y = camera.cy + PIXEL_CENTRE - top
    return np.array(
        [
            [2 * camera.fx / width, 0, 1 - 2 * border_x / width, 0],
            [0, 2 * camera.fy / height, 2 * border_y / height - 1, 0],
            [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, -1, 0],
        ],
        dtype=float,
    )
