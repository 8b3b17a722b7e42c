"""Linear solver: anisotropic PnP as a 4 x 4 eigenproblem, in one pass over the points."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import fast_sums, kernel
from cadalign.errors import DegenerateError
from cadalign.solvers.constants import DEGENERATE, OK, OUT_OF_RANGE, POSE_SIZE, TOO_FEW
from cadalign.solvers.linalg import (
    cholesky,
    eigenvectors_4,
    nearest_rotation,
    rotation_from_quaternion,
    solve_cholesky,
)
from cadalign.solvers.unknowns import is_pose, pack_pose

MIN_POINTS = 6
SPAN_FIX = "a linear solver needs keypoints that span a volume"
_CANCELLATION = 1e-13  # relative pivot of the second moments below which it is rounding error
_FLATNESS = 1e-7  # least ratio of smallest to largest spread of points that span a volume
_NEWTON_STEPS = 10
_BLOCK = 64
_LEAST_COSINE = 0.05  # between a column of the linear map and the rotated axis


def aepnp(
    points_3d: npt.ArrayLike, rays: npt.ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Solve anisotropic PnP linearly, without checking the input's values.

    Let ``a = (1, x)`` for a point x. Its camera-frame coordinates are linear in a:
    ``(c_x . a, c_y . a, c_z . a)``. Minimise the sum of
    ``(c_x . a - u c_z . a)^2 + (c_y . a - v c_z . a)^2`` over c_x and c_y in closed form: a
    generalised symmetric 4 x 4 eigenproblem in c_z remains. Its metric is the second moments of the
    points, which removes the leading bias of noise in (u, v), so the estimate is consistent. Newton
    steps on the rotation then split the 3 x 3 block into rotation and stretch.

    Parameters
    ----------
    points_3d : (n, 3) float
        Model points, at least 6 and not in one plane.
    rays : (n, 2) or (n, 3) float
        Normalised image coordinates (u, v), or directions (x, y, z) with z > 0.

    Returns
    -------
    rotation : (3, 3) float
    translation : (3,) float
    scale : (3,) float
        (1, s_y, s_z)

    Raises
    ------
    DegenerateError
        If there are fewer than 6 points, they lie in one plane, or numbers overflow.
    """
    points = np.ascontiguousarray(points_3d, dtype=np.float64)
    directions = np.ascontiguousarray(rays, dtype=np.float64)
    pose = np.empty(POSE_SIZE)
    status = aepnp_kernel(points, directions, pose)
    if status == OUT_OF_RANGE:
        raise out_of_range_error()
    if status != OK:
        raise aepnp_error(points)
    return pose[:9].reshape(3, 3), pose[9:12], pose[12:]


def aepnp_error(points_3d: FloatArray) -> DegenerateError:
    """Error for points that `aepnp_kernel` reports as degenerate."""
    # Imported here: only errors need it.
    from cadalign.geometry.alignment import describe_plane

    if len(points_3d) < MIN_POINTS:
        return DegenerateError(
            f"{len(points_3d)} points are too few for a linear solver",
            where="points_3d",
            fix=f"give at least {MIN_POINTS}",
        )
    return DegenerateError(
        describe_plane(points_3d) or "the points lie nearly in one plane",
        where="points_3d",
        fix=SPAN_FIX,
    )


def out_of_range_error() -> DegenerateError:
    return DegenerateError(
        "the alignment overflows floating-point numbers",
        where="points_3d",
        fix="rescale the model and the image, and check for extreme values",
    )


@fast_sums
def _moments(points: FloatArray, rays: FloatArray, mean: FloatArray, products: FloatArray) -> None:
    """Write means (5,) of x, y, z, u, v and sums of centred products (10, 4).

    Rows: 11, 1x, ..., zz of (1, x, y, z); columns: times 1, u, v, u^2 + v^2.
    """
    n = points.shape[0]
    homogeneous = rays.shape[1] == 3
    sx = sy = sz = su = sv = 0.0
    for i in range(n):
        inverse = 1.0 / rays[i, 2] if homogeneous else 1.0
        sx += points[i, 0]
        sy += points[i, 1]
        sz += points[i, 2]
        su += rays[i, 0] * inverse
        sv += rays[i, 1] * inverse
    mx, my, mz, mu, mv = sx / n, sy / n, sz / n, su / n, sv / n
    mean[0], mean[1], mean[2], mean[3], mean[4] = mx, my, mz, mu, mv
    monomials = np.empty((10, _BLOCK))
    weights = np.empty((4, _BLOCK))
    monomials[0] = 1.0
    weights[0] = 1.0
    products[:] = 0.0
    for start in range(0, n, _BLOCK):
        size = min(_BLOCK, n - start)
        for b in range(size):
            i = start + b
            inverse = 1.0 / rays[i, 2] if homogeneous else 1.0
            x = points[i, 0] - mx
            y = points[i, 1] - my
            z = points[i, 2] - mz
            u = rays[i, 0] * inverse - mu
            v = rays[i, 1] * inverse - mv
            monomials[1, b], monomials[2, b], monomials[3, b] = x, y, z
            monomials[4, b], monomials[5, b], monomials[6, b] = x * x, x * y, x * z
            monomials[7, b], monomials[8, b], monomials[9, b] = y * y, y * z, z * z
            weights[1, b], weights[2, b], weights[3, b] = u, v, u * u + v * v
        for k in range(10):
            for j in range(4):
                total = 0.0
                for b in range(size):
                    total += monomials[k, b] * weights[j, b]
                products[k, j] += total


@kernel
def _unpack(products: FloatArray, column: int, matrix: FloatArray) -> None:
    """Write one column of `_moments` as a symmetric 4 x 4 matrix."""
    k = 0
    for i in range(4):
        for j in range(i, 4):
            matrix[i, j] = matrix[j, i] = products[k, column]
            k += 1


@kernel
def _whiten_matrix(factor: FloatArray, matrix: FloatArray) -> None:
    """Replace a symmetric matrix A by L^-1 A L^-T in place, for the Cholesky factor L."""
    for _ in range(2):  # multiply by L^-1 and transpose, twice
        for column in range(4):
            for i in range(4):
                total = matrix[i, column]
                for k in range(i):
                    total -= factor[i, k] * matrix[k, column]
                matrix[i, column] = total / factor[i, i]
        for i in range(4):
            for j in range(i):
                matrix[i, j], matrix[j, i] = matrix[j, i], matrix[i, j]


@kernel
def _to_points_basis(factor: FloatArray, vector: FloatArray) -> None:
    """Replace a vector c by L^-T c in place."""
    for i in range(3, -1, -1):
        total = vector[i]
        for k in range(i + 1, 4):
            total -= factor[k, i] * vector[k]
        vector[i] = total / factor[i, i]


@kernel
def _split_scale(linear: FloatArray, spread: FloatArray, rotation: FloatArray) -> FloatArray:
    """Write a rotation and return scales d (3,) > 0 with ``rotation @ diag(d)`` near ``linear``."""
    columns = np.empty((3, 3))
    for j in range(3):
        for i in range(3):
            columns[i, j] = linear[i, j] * spread[j]
    nearest_rotation(columns, rotation, np.empty((4, 4)), np.empty((4, 4)))
    curvature = np.empty((3, 3))
    slope = np.empty(3)
    torque = np.empty(3)
    turned = np.empty((3, 3))
    for _ in range(_NEWTON_STEPS):
        curvature[:] = 0.0
        slope[:] = 0.0
        for j in range(3):
            cosine = 0.0
            for i in range(3):
                a, b = (i + 1) % 3, (i + 2) % 3
                torque[i] = rotation[a, j] * columns[b, j] - rotation[b, j] * columns[a, j]
                cosine += rotation[i, j] * columns[i, j]
            for a in range(3):
                slope[a] += cosine * torque[a]
                curvature[a, a] += cosine * cosine
                for b in range(3):
                    mixed = columns[a, j] * rotation[b, j] + columns[b, j] * rotation[a, j]
                    curvature[a, b] -= torque[a] * torque[b] + 0.5 * cosine * mixed
        if not cholesky(curvature, 3, 1e-12):
            break
        solve_cholesky(curvature, 3, slope)
        rotation_from_quaternion(1.0, slope[0] / 2, slope[1] / 2, slope[2] / 2, turned)
        for j in range(3):
            x, y, z = rotation[0, j], rotation[1, j], rotation[2, j]
            for i in range(3):
                rotation[i, j] = turned[i, 0] * x + turned[i, 1] * y + turned[i, 2] * z
        if slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2 < 1e-18:
            break
    scale = np.empty(3)
    for j in range(3):
        length = cosine = 0.0
        for i in range(3):
            length += linear[i, j] ** 2
            cosine += rotation[i, j] * linear[i, j]
        scale[j] = max(cosine, _LEAST_COSINE * np.sqrt(length))
    return scale


@kernel
def aepnp_batch(
    points: FloatArray, rays: FloatArray, offsets: IntArray
) -> tuple[FloatArray, IntArray]:
    """Packed poses (B, 1, 15) and statuses (B,); problem b has rows from ``offsets[b]``."""
    count = offsets.shape[0] - 1
    poses = np.empty((count, 1, POSE_SIZE))
    statuses = np.empty(count, dtype=np.int64)
    for b in range(count):
        start, end = offsets[b], offsets[b + 1]
        statuses[b] = aepnp_kernel(points[start:end], rays[start:end], poses[b, 0])
    return poses, statuses


@kernel
def aepnp_kernel(points: FloatArray, rays: FloatArray, pose: FloatArray) -> int:
    """Compiled `aepnp`: write the packed pose (15,), return a status."""
    mean = np.empty(5)
    spread = np.empty(3)
    rows = np.empty((3, 4))
    status = affine_rows(points, rays, mean, spread, rows)
    if status != OK:
        return status
    rotation = np.empty((3, 3))
    lengths = _split_scale(rows[:, 1:], spread, rotation)
    translation = np.empty(3)
    scale = np.empty(3)
    for j in range(3):
        scale[j] = lengths[j] / lengths[0]
    for i in range(3):
        translation[i] = rows[i, 0] / lengths[0]
        for j in range(3):
            translation[i] -= rotation[i, j] * scale[j] * mean[j]
    pack_pose(rotation, translation, scale, pose)
    return OK if is_pose(pose) else OUT_OF_RANGE


@kernel
def affine_rows(
    points: FloatArray, rays: FloatArray, mean: FloatArray, spread: FloatArray, rows: FloatArray
) -> int:
    """Write the affine map (3, 4) of (1, x - mean) to the camera, up to scale; returns a status."""
    if points.shape[0] < MIN_POINTS:
        return TOO_FEW
    products = np.empty((10, 4))
    _moments(points, rays, mean, products)
    factor = np.empty((4, 4))
    _unpack(products, 0, factor)
    largest = 0.0
    for k in range(3):
        spread[k] = np.sqrt(factor[k + 1, k + 1])
        largest = max(largest, spread[k])
    if not cholesky(factor, 4, _CANCELLATION):
        return DEGENERATE
    for k in range(1, 4):
        if not factor[k, k] > _FLATNESS * largest:
            return DEGENERATE

    # With whitened a, the metric is the identity and the system is Q - U U - V V: U, V and Q are
    # the moments weighted by u, v and u^2 + v^2.
    u_matrix = np.empty((4, 4))
    v_matrix = np.empty((4, 4))
    system = np.empty((4, 4))
    _unpack(products, 1, u_matrix)
    _unpack(products, 2, v_matrix)
    _unpack(products, 3, system)
    _whiten_matrix(factor, u_matrix)
    _whiten_matrix(factor, v_matrix)
    _whiten_matrix(factor, system)
    for i in range(4):
        for j in range(i, 4):
            total = system[i, j]
            for k in range(4):
                total -= u_matrix[i, k] * u_matrix[k, j] + v_matrix[i, k] * v_matrix[k, j]
            system[i, j] = system[j, i] = total
    vectors = np.empty((4, 4))
    eigenvectors_4(system, vectors)
    best = 0
    for k in range(1, 4):
        if system[k, k] < system[best, best]:
            best = k

    for i in range(4):
        rows[2, i] = vectors[i, best]
        rows[0, i] = 0.0
        rows[1, i] = 0.0
        for k in range(4):
            rows[0, i] += u_matrix[i, k] * vectors[k, best]
            rows[1, i] += v_matrix[i, k] * vectors[k, best]
    for i in range(3):
        _to_points_basis(factor, rows[i])
    if rows[2, 0] < 0:  # the depth of the points' mean
        rows *= -1.0
    for i in range(4):
        rows[0, i] += mean[3] * rows[2, i]
        rows[1, i] += mean[4] * rows[2, i]
    return OK
