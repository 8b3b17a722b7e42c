"""Axes of other programs and the up direction in a camera's frame: the only place for either.

The camera's axes are OpenCV's (x right, y down, z forward) or, where said so, OpenGL's (x right,
y up, z backward), which NeRF, ARKit and ARCore use. OpenGL's image begins at the border of the
corner pixel, cadalign's at the pixel's centre, `cadalign.geometry.pixels.PIXEL_CENTRE` from there.
Up directions are found from gravity or a pose.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats
from cadalign.errors import InputError, quote
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import PIXEL_CENTRE
from cadalign.geometry.rotations import nearest_rotation

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


_AXES = {"opencv": np.ones(3), "opengl": OPENGL_AXES}


def up_from_gravity(gravity: npt.ArrayLike, *, axes: str = "opencv") -> FloatArray:
    """The up direction (3,), of unit length, from gravity in the camera's frame.

    Parameters
    ----------
    gravity : (3,) float
        Direction in which things fall, of any length. An accelerometer at rest reports the
        opposite, unless its system turns the sign, as iOS does.
    axes : {"opencv", "opengl"}
        Axes of the vector.

    Raises
    ------
    InputError
        If it is zero or not finite, or the axes are unknown.

    Examples
    --------
    >>> up_from_gravity([0.0, 9.81, 0.0]).tolist()
    [0.0, -1.0, 0.0]
    """
    if axes not in _AXES:
        raise InputError(f"unknown axes {quote(axes)}", where="axes", fix="give opencv or opengl")
    down = as_floats(gravity, name="gravity", shape=(3,)) * _AXES[axes]
    length = float(np.linalg.norm(down))
    if not length > 0:
        raise InputError("a direction must not be zero", where="gravity")
    return np.asarray(0.0 - down / length)


def up_from_pose(
    world_from_cam: npt.ArrayLike,
    *,
    world_up: npt.ArrayLike = (0.0, 1.0, 0.0),
    axes: str = "opencv",
) -> FloatArray:
    """The up direction (3,) in the camera's frame, from its pose in a world whose up is known.

    Parameters
    ----------
    world_from_cam : (3, 3) or (4, 4) float
        Rotation, or pose, of the camera: ARKit's ``camera.transform`` with ``axes="opengl"``.
    world_up : (3,) float
        Up in the world; ARKit's and ARCore's is y.
    axes
        As for `up_from_gravity`.

    Raises
    ------
    InputError
        If a shape is wrong, a value is not finite, the direction is zero, or the axes are unknown.

    Examples
    --------
    >>> up_from_pose(np.eye(4), axes="opengl").tolist()
    [0.0, -1.0, 0.0]
    """
    size = 3 if np.shape(world_from_cam) == (3, 3) else 4
    given = as_floats(world_from_cam, name="world_from_cam", shape=(size, size))
    rotation = nearest_rotation(given[:3, :3], where="world_from_cam")
    up = as_floats(world_up, name="world_up", shape=(3,))
    return up_from_gravity(-(rotation.T @ up), axes=axes)
