"""OpenGL's axes and matrices: the only place for either.

A camera's axes are OpenCV's (x right, y down, z forward) and, where said so, OpenGL's (x right,
y up, z backward), which NeRF, ARKit and ARCore use. OpenGL's image begins at the border of the
corner pixel, cadalign's at the pixel's centre, `cadalign.geometry.pixels.PIXEL_CENTRE` from there.
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import PIXEL_CENTRE

OPENGL_AXES = np.array([1.0, -1.0, -1.0])
"""Signs of OpenGL's camera axes in cadalign's: multiply coordinates (n, 3) to go either way."""

OPENGL_FLIP = np.diag([*OPENGL_AXES, 1.0])
"""Motion (4, 4) between the axes of the two cameras, either way."""


def opengl_from_model(cam_from_model: Alignment) -> FloatArray:
    """The model-view matrix: stretched, posed, in OpenGL's camera axes; (4, 4) float.

    Examples
    --------
    >>> from cadalign import Alignment
    >>> opengl_from_model(Alignment(np.eye(3), [1, 2, 3], [1, 1, 1]))[:, 3].tolist()
    [1.0, -2.0, -3.0, 1.0]
    """
    return np.asarray(OPENGL_FLIP @ cam_from_model.cam_from_model)


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
