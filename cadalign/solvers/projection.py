"""Projection of model points and its derivatives; all formulas are in this module.

``depth * (u, v, 1) = rotation @ diag(scale) @ x + translation`` for a packed pose (see
`cadalign.solvers.unknowns`). The pose is passed as a tuple of scalars, so that loops keep it in
registers. A `Motion` is a rotation, row by row, and a translation. A slope is the derivative of a
residual by a point.
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import inline, kernel
from cadalign.solvers.constants import NOT_FOUND, OK, OUT_OF_RANGE, UNKNOWNS
from cadalign.solvers.linalg import Triple, cross, dot
from cadalign.solvers.unknowns import is_pose

Scalars = tuple[float, ...]
Motion = tuple[float, ...] | FloatArray


@inline
def motion_of(pose: FloatArray) -> Motion:
    """Rotation and translation of a packed pose, as a tuple of 12 numbers."""
    rotation = (pose[0], pose[1], pose[2], pose[3], pose[4], pose[5], pose[6], pose[7], pose[8])
    return rotation + (pose[9], pose[10], pose[11])


@inline
def scalars_of(pose: FloatArray) -> Scalars:
    """A packed pose as a tuple of 15 numbers."""
    return motion_of(pose) + (pose[12], pose[13], pose[14])


@inline
def turn(motion: Motion, point: Triple) -> Triple:
    """Rotate a point."""
    x, y, z = point
    return (
        motion[0] * x + motion[1] * y + motion[2] * z,
        motion[3] * x + motion[4] * y + motion[5] * z,
        motion[6] * x + motion[7] * y + motion[8] * z,
    )


@inline
def turn_back(motion: Motion, slope: Triple) -> Triple:
    """Convert a slope by the rotated point to one by the point: multiply by the transpose."""
    x, y, z = slope
    return (
        motion[0] * x + motion[3] * y + motion[6] * z,
        motion[1] * x + motion[4] * y + motion[7] * z,
        motion[2] * x + motion[5] * y + motion[8] * z,
    )


@inline
def shift(motion: Motion, turned: Triple) -> Triple:
    """Add the translation to a rotated point."""
    return turned[0] + motion[9], turned[1] + motion[10], turned[2] + motion[11]


@inline
def ray_of(point: Triple) -> Triple:
    """Normalised image coordinates u, v and depth of a point in the camera."""
    inverse = 1.0 / point[2]
    return point[0] * inverse, point[1] * inverse, point[2]


@inline
def ray_slopes(seen: Triple, weights: Triple) -> tuple[Triple, Triple]:
    """Slopes of a u + b v and c v for ``weights`` (a, b, c), at the result of `ray_of`."""
    u, v, depth = seen
    inverse = 1.0 / depth
    e, f, h = weights[0] * inverse, weights[1] * inverse, weights[2] * inverse
    return (e, f, -(e * u + f * v)), (0.0, h, -h * v)


@inline
def slope_of_row(
    row: Triple, along: float, response: Triple, nearer: Triple, fall: float
) -> Triple:
    """Derivative of ``along = row . response`` by the point, for a constant response.

    ``row`` a is the slope of a whitened residual. With the response y, and ``nearer`` d (the
    camera's z axis over the depth), the derivative is ``fall a - (d . y) a - (a . y) d``. The last
    two terms are the decrease of rays with the depth; d = 0 for a residual of depth. ``fall`` is
    the change of the loss's weight along the row.

    Integrating over a shape of covariance S gives the residuals the covariance ``M = I + A S A'``.
    The derivative of log det M is ``2 tr(dA P A')``, with the covariance P of the shape given the
    pose. A row a of A depends on one point only. Half the derivative by this point is the sum of
    these slopes over its rows, each with its response ``y = P A'``.
    """
    shared = fall - dot(nearer, response)
    return (
        shared * row[0] - along * nearer[0],
        shared * row[1] - along * nearer[1],
        shared * row[2] - along * nearer[2],
    )


@inline
def write_motion(turned: Triple, slope: Triple, rows: FloatArray, column: int) -> None:
    """Write derivatives by rotation vector and translation into ``rows[:6, column]``."""
    rows[0, column], rows[1, column], rows[2, column] = cross(turned, slope)
    rows[3, column], rows[4, column], rows[5, column] = slope


@inline
def project_point(pose: Scalars, point: Triple) -> Triple:
    """Project a model point to normalised image coordinates u, v and depth."""
    return ray_of(shift(pose, turn(pose, stretch(pose, point))))


@inline
def stretch(pose: Scalars, point: Triple) -> Triple:
    """Multiply a point by the scale of a packed pose."""
    return point[0] * pose[12], point[1] * pose[13], point[2] * pose[14]


@inline
def write_derivatives(
    pose: Scalars,
    point: Triple,
    weights: Triple,
    rows: FloatArray,
    first: int,
    second: int,
) -> None:
    """Write derivatives (8,) of a u + b v and of c v into columns ``first`` and ``second``."""
    stretched = stretch(pose, point)
    turned = turn(pose, stretched)
    slopes = ray_slopes(ray_of(shift(pose, turned)), weights)
    write_motion(turned, slopes[0], rows, first)
    write_motion(turned, slopes[1], rows, second)
    for k in range(1, 3):
        longer = (
            pose[k] * stretched[k],
            pose[3 + k] * stretched[k],
            pose[6 + k] * stretched[k],
        )
        rows[5 + k, first] = dot(slopes[0], longer)
        rows[5 + k, second] = dot(slopes[1], longer)


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
    """Residuals (n, 2) [px] of the first poses in (B, k, 15), and statuses (B,) after checks."""
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
    """True if no coordinate is NaN or infinite; only then is 0 times their sum 0."""
    total = 0.0
    for i in range(points_3d.shape[0]):
        total += 0.0 * (points_3d[i, 0] + points_3d[i, 1] + points_3d[i, 2])
    for i in range(points_2d.shape[0]):
        total += 0.0 * (points_2d[i, 0] + points_2d[i, 1])
    return total == 0.0


@kernel
def pinhole_rays(points_2d: FloatArray, fx: float, fy: float, cx: float, cy: float) -> FloatArray:
    """Normalised image coordinates (n, 2) of pixels (n, 2), without distortion."""
    rays = np.empty((points_2d.shape[0], 2))
    for i in range(points_2d.shape[0]):
        rays[i, 0] = (points_2d[i, 0] - cx) / fx
        rays[i, 1] = (points_2d[i, 1] - cy) / fy
    return rays
