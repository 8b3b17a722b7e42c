"""Projection of model points and its derivatives: the one place that has their formulas.

``depth * (u, v, 1) = rotation @ diag(scale) @ x + translation`` for a packed pose (see
`cadalign.solvers.unknowns`), given as a tuple of scalars so that loops keep it in registers.
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import inlined, kernel
from cadalign.solvers.constants import NOT_FOUND, OK, OUT_OF_RANGE, UNKNOWNS
from cadalign.solvers.unknowns import is_pose

Scalars = tuple[float, ...]
Triple = tuple[float, float, float]


@inlined
def scalars_of(pose: FloatArray) -> Scalars:
    """The 15 numbers of a packed pose as a tuple."""
    rotation = (pose[0], pose[1], pose[2], pose[3], pose[4], pose[5], pose[6], pose[7], pose[8])
    return rotation + (pose[9], pose[10], pose[11], pose[12], pose[13], pose[14])


@inlined
def project_point(pose: Scalars, point: Triple) -> Triple:
    """Project a model point; normalised image coordinates u, v, and the depth."""
    x, y, z = point[0] * pose[12], point[1] * pose[13], point[2] * pose[14]
    depth = pose[6] * x + pose[7] * y + pose[8] * z + pose[11]
    inverse = 1.0 / depth
    u = (pose[0] * x + pose[1] * y + pose[2] * z + pose[9]) * inverse
    v = (pose[3] * x + pose[4] * y + pose[5] * z + pose[10]) * inverse
    return u, v, depth


@inlined
def write_derivatives(
    pose: Scalars,
    point: Triple,
    weights: Triple,
    rows: FloatArray,
    first: int,
    second: int,
) -> None:
    """Write the derivatives by unknown k, for ``weights`` (a, b, c), into row k < 8 of ``rows``.

    Column ``first`` receives those of a u + b v, column ``second`` those of c v.
    """
    x, y, z = point[0] * pose[12], point[1] * pose[13], point[2] * pose[14]
    ax, ay, az = pose[1] * y, pose[4] * y, pose[7] * y  # by log s_y
    bx, by, bz = pose[2] * z, pose[5] * z, pose[8] * z  # by log s_z
    px = pose[0] * x + ax + bx
    py = pose[3] * x + ay + by
    pz = pose[6] * x + az + bz
    inverse = 1.0 / (pz + pose[11])
    u = (px + pose[9]) * inverse
    v = (py + pose[10]) * inverse
    # Derivatives of the pair by the camera-frame point: (e, f, -g) and (0, h, -k).
    e = weights[0] * inverse
    f = weights[1] * inverse
    g = e * u + f * v
    h = weights[2] * inverse
    k = h * v
    rows[0, first] = -f * pz - g * py
    rows[1, first] = e * pz + g * px
    rows[2, first] = f * px - e * py
    rows[3, first] = e
    rows[4, first] = f
    rows[5, first] = -g
    rows[6, first] = e * ax + f * ay - g * az
    rows[7, first] = e * bx + f * by - g * bz
    rows[0, second] = -h * pz - k * py
    rows[1, second] = k * px
    rows[2, second] = h * px
    rows[3, second] = 0.0
    rows[4, second] = h
    rows[5, second] = -k
    rows[6, second] = h * ay - k * az
    rows[7, second] = h * by - k * bz


@kernel
def ray_derivatives(points: FloatArray, pose: FloatArray) -> FloatArray:
    """Derivatives (n, 2, 8) of the normalised image coordinates of ``points`` (n, 3)."""
    derivatives = np.empty((points.shape[0], 2, UNKNOWNS))
    scalars = scalars_of(pose)
    for i in range(points.shape[0]):
        point = (points[i, 0], points[i, 1], points[i, 2])
        write_derivatives(scalars, point, (1.0, 0.0, 1.0), derivatives[i].T, 0, 1)
    return derivatives


@kernel
def reproject_batch(
    points: FloatArray,
    points_2d: FloatArray,
    offsets: IntArray,
    poses: FloatArray,
    cameras: FloatArray,
    statuses: IntArray,
) -> tuple[FloatArray, IntArray]:
    """Projected minus observed pixels (n, 2) of the first pose of every problem.

    Problem b has the rows ``offsets[b]`` to ``offsets[b + 1]``; ``poses`` (B, k, 15) are packed;
    ``cameras`` (1 or B, 4) holds fx, fy, cx, cy. Also returns the statuses (B,), in which a solved
    problem with a point behind the camera becomes NOT_FOUND, and one that overflows OUT_OF_RANGE.
    """
    residuals = np.empty((points.shape[0], 2))
    checked = statuses.copy()
    for b in range(offsets.shape[0] - 1):
        pose = scalars_of(poses[b, 0])
        nearest = np.inf
        squares = 0.0
        camera = cameras[b if cameras.shape[0] > 1 else 0]
        for i in range(offsets[b], offsets[b + 1]):
            u, v, depth = project_point(pose, (points[i, 0], points[i, 1], points[i, 2]))
            nearest = min(nearest, depth)
            residuals[i, 0] = u * camera[0] + camera[2] - points_2d[i, 0]
            residuals[i, 1] = v * camera[1] + camera[3] - points_2d[i, 1]
            squares += residuals[i, 0] ** 2 + residuals[i, 1] ** 2
        if checked[b] == OK:
            if not nearest > 0:
                checked[b] = NOT_FOUND
            elif not (squares < np.inf and is_pose(poses[b, 0])):
                checked[b] = OUT_OF_RANGE
    return residuals, checked


@kernel
def all_finite(points_3d: FloatArray, points_2d: FloatArray) -> bool:
    """True if no coordinate is NaN or infinite: a sum of zeros is zero only then."""
    total = 0.0
    for i in range(points_3d.shape[0]):
        total += 0.0 * (points_3d[i, 0] + points_3d[i, 1] + points_3d[i, 2])
    for i in range(points_2d.shape[0]):
        total += 0.0 * (points_2d[i, 0] + points_2d[i, 1])
    return total == 0.0


@kernel
def pinhole_rays(points_2d: FloatArray, fx: float, fy: float, cx: float, cy: float) -> FloatArray:
    """Normalised image coordinates (n, 2) of pixels (n, 2), for a lens without distortion."""
    rays = np.empty((points_2d.shape[0], 2))
    for i in range(points_2d.shape[0]):
        rays[i, 0] = (points_2d[i, 0] - cx) / fx
        rays[i, 1] = (points_2d[i, 1] - cy) / fy
    return rays
