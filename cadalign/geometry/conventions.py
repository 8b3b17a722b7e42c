"""Axes of other programs and the up direction in a camera's frame: the only place for either.

The camera's axes are OpenCV's (x right, y down, z forward) or, where said so, OpenGL's (x right,
y up, z backward), which NeRF, ARKit and ARCore use.
Up directions are found from gravity, pitch and roll, a pose, vertical edges.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats, as_positive, is_number
from cadalign.errors import InputError, quote
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import nearest_rotation

OPENGL_AXES = np.array([1.0, -1.0, -1.0])
"""Signs of OpenGL's camera axes in cadalign's: multiply coordinates (n, 3) to go either way."""

OPENGL_FLIP = np.diag([*OPENGL_AXES, 1.0])
"""Motion (4, 4) between the axes of the two cameras, either way."""


_AXES = {"opencv": np.ones(3), "opengl": OPENGL_AXES}
_LEAST_ANGLE = 1e-6  # between two edges' planes, at which they have no direction in common [rad]


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


def up_from_pitch_roll(pitch_deg: float, roll_deg: float = 0.0) -> FloatArray:
    """The up direction (3,) of a camera held with a pitch and a roll.

    Parameters
    ----------
    pitch_deg : float
        Elevation of the viewing direction above the horizon [degrees]; negative looks down.
    roll_deg : float
        Rotation of the camera about its viewing direction, clockwise as the photographer sees it
        [degrees]: the photo's content turns the other way.

    Raises
    ------
    InputError
        If an angle is not finite.

    Examples
    --------
    >>> np.abs(up_from_pitch_roll(90.0)).round(12).tolist()
    [0.0, 0.0, 1.0]
    >>> up_from_pitch_roll(0.0, 30.0).round(3).tolist()
    [-0.5, -0.866, 0.0]
    """
    for name, angle in (("pitch_deg", pitch_deg), ("roll_deg", roll_deg)):
        if not is_number(angle):
            raise InputError(f"{quote(angle)} is not an angle", where=name)
    pitch, roll = np.radians([pitch_deg, roll_deg])
    level = np.cos(pitch)
    up = [-np.sin(roll) * level, -np.cos(roll) * level, np.sin(pitch)]
    return np.array(up) + 0.0


def up_from_vertical_edges(
    camera: Camera, edges: npt.ArrayLike, *, sigma: float = 1.0, pitch_sigma_deg: float = 30.0
) -> tuple[FloatArray, FloatArray]:
    """The up direction and its covariance, from the two ends of each of some vertical edges.

    An edge and the camera span a plane that holds the up direction. One edge leaves the direction
    in that plane open: a camera is then taken to look along the horizon, to some 30 degrees. Two
    edges or more determine it: their planes meet in it.

    Parameters
    ----------
    camera : Camera
    edges : (2, 2) or (k, 2, 2) float
        Two pixels on each edge, in any order [px].
    sigma : float
        Standard deviation of a pixel [px].
    pitch_sigma_deg : float
        Standard deviation of the camera's pitch about the horizon [degrees].

    Returns
    -------
    up : (3,) float
        Unit vector in the camera's frame; the one that points up in an upright photo.
    covariance : (3, 3) float
        Covariance [degrees squared], of rank 2: the ``up_sigma_deg`` of `cadalign.View`.

    Raises
    ------
    InputError
        If the two pixels of an edge coincide.

    Examples
    --------
    >>> camera = Camera(640, 480, 500, 500, 319.5, 239.5)
    >>> up, covariance = up_from_vertical_edges(camera, [[319.5, 50.0], [319.5, 450.0]])
    >>> up.tolist()
    [0.0, -1.0, 0.0]
    >>> np.sqrt(covariance.diagonal()).round(1).tolist()
    [0.2, 0.0, 30.0]
    """
    up, covariance, _ = vertical_direction(camera, edges, sigma, pitch_sigma_deg)
    return up, covariance


def vertical_direction(
    camera: Camera, edges: npt.ArrayLike, sigma: float, pitch_sigma_deg: float
) -> tuple[FloatArray, FloatArray, float]:
    """Direction and covariance of `up_from_vertical_edges`, and the chi-square of the edges."""
    as_positive(sigma, name="sigma")
    as_positive(pitch_sigma_deg, name="pitch_sigma_deg")
    shape = (2, 2) if np.ndim(edges) == 2 else (None, 2, 2)
    clicks = as_floats(edges, name="edges", shape=shape).reshape(-1, 2, 2)
    if not len(clicks):
        raise InputError("none is given", where="edges")
    found = [_plane(camera, ends, sigma, number) for number, ends in enumerate(clicks)]
    normals, deviations = zip(*found, strict=True)
    # The forward direction is level to within the pitch's sigma: a plane like those of edges.
    rows = np.array([*normals, [0.0, 0.0, 1.0]])
    planes = np.array([*deviations, np.eye(3) * np.radians(pitch_sigma_deg) ** 2])
    up = np.array([0.0, -1.0, 0.0])
    for _ in range(10):
        variances = np.einsum("i,nij,j->n", up, planes, up)
        weighted = rows / np.sqrt(variances)[:, None]
        values, vectors = np.linalg.eigh(weighted.T @ weighted)
        up = vectors[:, 0] * (-1.0 if vectors[1, 0] > 0 else 1.0)
    if values[1] <= _LEAST_ANGLE**2 * values[2]:
        fix = "give edges at different places in the photo"
        raise InputError("the edges have no one direction in common", where="edges", fix=fix)
    across = vectors[:, 1:] / np.sqrt(values[1:])
    covariance = np.asarray(np.degrees(np.degrees(across @ across.T)))
    return up + 0.0, covariance, max(0.0, float(values[0]))


def _plane(
    camera: Camera, ends: FloatArray, sigma: float, number: int
) -> tuple[FloatArray, FloatArray]:
    """Unit normal (3,) of the plane of an edge and the camera, and its covariance (3, 3)."""
    rays = np.concatenate([camera.normalize(ends), np.ones((2, 1))], axis=1)
    normal = np.cross(rays[0], rays[1])
    length = float(np.linalg.norm(normal))
    if not length > 0:
        raise InputError("its two pixels coincide", where=f"edges[{number}]")
    covariance = np.zeros((3, 3))
    of_ray = np.diag([sigma / camera.fx, sigma / camera.fy, 0.0]) ** 2
    for ray in rays:
        cross = np.cross(np.eye(3), ray) / length  # lens distortion changes it little
        covariance += cross.T @ of_ray @ cross
    return normal / length, covariance
