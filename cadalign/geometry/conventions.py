"""Axes of other programs and the up direction in a camera's frame: the only place for either.

The camera's axes are OpenCV's (x right, y down, z forward) or, where said so, OpenGL's (x right,
y up, z backward), which NeRF, ARKit and ARCore use.
Up directions are found from gravity or a pose.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats
from cadalign.errors import InputError, quote
from cadalign.geometry.rotations import nearest_rotation

OPENGL_AXES = np.array([1.0, -1.0, -1.0])
"""Signs of OpenGL's camera axes in cadalign's: multiply coordinates (n, 3) to go either way."""

OPENGL_FLIP = np.diag([*OPENGL_AXES, 1.0])
"""Motion (4, 4) between the axes of the two cameras, either way."""


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
