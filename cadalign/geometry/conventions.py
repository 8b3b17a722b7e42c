"""OpenGL's conventions, and the only place where cadalign turns its own into them.

OpenGL's camera looks along -z with y up, where cadalign's looks along +z with y down, and its image
begins at the border of the corner pixel, where cadalign's begins at the pixel's centre.
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

PIXEL_CENTRE = 0.5
"""Where OpenGL, COLMAP and NeRF programs put the centre of the top-left pixel, in x and y."""

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def opengl_from_model(cam_from_model: Alignment) -> FloatArray:
    """The model-view matrix: stretched, posed, in OpenGL's camera axes; (4, 4) float.

    Examples
    --------
    >>> opengl_from_model(Alignment(np.eye(3), [1, 2, 3], [1, 1, 1]))[:, 3].tolist()
    [1.0, -2.0, -3.0, 1.0]
    """
    return np.asarray(_FLIP @ cam_from_model.cam_from_model)


def alignment_from_opengl(opengl_from_world: FloatArray) -> Alignment:
    """Turn a rigid model-view matrix (4, 4) into a pose in cadalign's axes; scale 1.

    Raises
    ------
    InputError
        If the matrix is not a rotation and a translation.
    """
    matrix = _FLIP @ opengl_from_world
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
    """The projection matrix of a camera; its lens distortion has no place in one.

    Parameters
    ----------
    camera : Camera
    near, far : float
        Depths of the clipping planes [model units], ``0 < near < far``.
    window : tuple of 4 int, optional
        Left, top, width and height [px] of the part of the image that fills the viewport; by
        default all of it.

    Returns
    -------
    (4, 4) float
        From OpenGL's camera axes to clip coordinates.

    Examples
    --------
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
