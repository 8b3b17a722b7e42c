"""Random problems with a known solution, from the AEPnP paper's simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import rotation_from_quat_wxyz

SIMULATION_CAMERA = Camera(width=640, height=480, fx=150.0, fy=150.0, cx=319.5, cy=239.5)
"""The paper's virtual camera."""


@dataclass(frozen=True, eq=False)
class SimulatedProblem:
    """Keypoints of a model (n, 3), their pixels (n, 2), and the true alignment.

    ``outliers`` (n,) masks the observations at random pixels; None without outliers.
    """

    points_3d: FloatArray
    points_2d: FloatArray
    camera: Camera
    alignment: Alignment
    outliers: BoolArray | None


def simulate_problem(
    rng: np.random.Generator,
    *,
    points: int,
    noise_px: float,
    outlier_share: float = 0.0,
    camera: Camera = SIMULATION_CAMERA,
    depth: tuple[float, float] = (4.0, 8.0),
    stretch: tuple[float, float] = (0.5, 2.0),
) -> SimulatedProblem:
    """Draw one problem of the paper's simulation.

    The object's points are uniform in the cube [-1, 1)^3, and the rotation is uniform. The model is
    the object with y and z divided by scales drawn from ``stretch``, so the true scale is (1, s_y,
    s_z). The object's centre is at a depth drawn from ``depth``, up to one unit off the optical
    axis along x and y. ``noise_px`` is the standard deviation of the Gaussian noise on each image
    coordinate. ``outlier_share`` of the observations, rounded to a whole number, are moved to
    random pixels. All randomness comes from ``rng``.

    Examples
    --------
    >>> problem = simulate_problem(np.random.default_rng(0), points=8, noise_px=0.0)
    >>> reprojected = problem.camera.project(problem.alignment.apply(problem.points_3d))
    >>> bool(np.allclose(reprojected, problem.points_2d))
    True
    """
    scale = np.array([1.0, *rng.uniform(*stretch, 2)])
    translation = np.array([*rng.uniform(-1, 1, 2), rng.uniform(*depth)])
    alignment = Alignment(random_rotation(rng), translation, scale)
    points_3d = rng.uniform(-1, 1, (points, 3)) / scale
    points_2d = camera.project(alignment.apply(points_3d))
    points_2d = points_2d + noise_px * rng.standard_normal(points_2d.shape)
    count = round(outlier_share * points)
    if not count:
        return SimulatedProblem(points_3d, points_2d, camera, alignment, None)
    outliers = np.zeros(points, dtype=bool)
    outliers[rng.choice(points, size=count, replace=False)] = True
    points_2d[outliers] = rng.uniform(-0.5, [camera.width - 0.5, camera.height - 0.5], (count, 2))
    return SimulatedProblem(points_3d, points_2d, camera, alignment, outliers)


def random_rotation(rng: np.random.Generator) -> FloatArray:
    """A rotation matrix (3, 3), uniform over all rotations."""
    return rotation_from_quat_wxyz(rng.standard_normal(4))
