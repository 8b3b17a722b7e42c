"""Rotation matrices, rotation vectors and quaternions."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats
from cadalign.errors import InputError

_NEARLY_RIGID = 1e-2
_EXACT = 1e-12
_LAST_ROW = 1e-6


def dots(first: FloatArray, second: FloatArray) -> FloatArray:
    """Dot products (...) of vectors (..., k), equal to BLAS bit for bit."""
    return np.asarray(np.matmul(first[..., None, :], second[..., :, None])[..., 0, 0])


def lengths(vectors: FloatArray) -> FloatArray:
    """Euclidean lengths (...) of vectors (..., k), equal to `numpy.linalg.norm` bit for bit."""
    return np.sqrt(dots(vectors, vectors))


def rotation_from_vector(vector: FloatArray) -> FloatArray:
    """Convert a rotation vector (3,), axis times angle [rad], to a matrix (3, 3) (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = np.asarray(vector) / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # The half angle avoids cancellation in 1 - cos at small angles.
    square = 2 * math.sin(angle / 2) ** 2 * (cross @ cross)
    return np.asarray(np.eye(3) + math.sin(angle) * cross + square)


def by_rotation(points: FloatArray) -> FloatArray:
    """Derivatives (..., 3, 3) of points (..., 3) by a rotation vector; columns are axis x point."""
    x, y, z = np.moveaxis(points, -1, 0)
    found = np.zeros((*points.shape, 3))  # np.cross is several times slower
    found[..., 0, 1], found[..., 0, 2], found[..., 1, 2] = z, -y, x
    found[..., 1, 0], found[..., 2, 0], found[..., 2, 1] = -z, y, -x
    return found


def vector_from_rotation(rotation: FloatArray) -> FloatArray:
    """Convert a rotation matrix (3, 3) to a rotation vector (3,), axis times angle [rad]."""
    w, x, y, z = _quaternion(rotation)
    sine = math.sqrt(x * x + y * y + z * z)
    factor = 2.0 * math.atan2(sine, w) / sine if sine > 0 else 2.0
    return np.array([factor * x, factor * y, factor * z])


def _quaternion(rotation: FloatArray) -> tuple[float, float, float, float]:
    """Convert a rotation matrix (3, 3) to a unit quaternion w, x, y, z with w >= 0.

    The largest component is computed from the diagonal and determines the others (Shepperd,
    "Quaternion from rotation matrix", 1978). SciPy's conversion of a single matrix is ten times
    slower.
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    squares = (1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i)
    largest = squares.index(max(squares))
    quaternion = (
        (squares[0], h - f, c - g, d - b),
        (h - f, squares[1], d + b, c + g),
        (c - g, d + b, squares[2], f + h),
        (d - b, c + g, f + h, squares[3]),
    )[largest]
    length = math.copysign(math.hypot(*quaternion), quaternion[0])
    w, x, y, z = (each / length for each in quaternion)
    return w, x, y, z


def angles_between(first: FloatArray, second: FloatArray) -> FloatArray:
    """Angles (...) between rotation matrices (..., 3, 3) [degrees], 0 to 180.

    The chord |first - second| = sqrt(8) sin(angle / 2) is accurate at small angles, where the arc
    cosine of the trace loses half the digits. The trace gives the cosine of half the angle.
    """
    difference = first - second
    chord = lengths(difference.reshape(*difference.shape[:-2], 9)) / np.sqrt(8.0)
    cosine = np.sqrt(np.maximum(((first * second).sum(axis=(-2, -1)) + 1.0) / 4.0, 0.0))
    return np.asarray(np.degrees(2.0 * np.arctan2(chord, cosine)))


def nearest_rotation(matrix: FloatArray, *, where: str = "rotation") -> FloatArray:
    """Rotation nearest to a matrix (3, 3) that is a rotation up to 1e-2.

    Raises
    ------
    InputError
        If an entry of ``matrix @ matrix.T`` is more than 1e-2 off the identity, or the matrix is a
        reflection. ``where`` is the matrix's name in the message.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(matrix @ matrix.T - np.eye(3)).max()
    if not error <= _NEARLY_RIGID or np.linalg.det(matrix) < 0:
        fix = "its rows must be orthonormal and its determinant +1"
        raise InputError("not a rotation matrix", where=where, fix=fix)
    if error <= _EXACT:
        return matrix
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def nearest_rigid(matrix: npt.ArrayLike, *, where: str) -> FloatArray:
    """Rigid motion (4, 4) nearest to a matrix; see `nearest_rotation`.

    Raises
    ------
    InputError
        If the matrix is not a rigid motion, or its last row is not 0, 0, 0, 1.
    """
    motion = as_floats(matrix, name=where, shape=(4, 4)).copy()
    try:
        motion[:3, :3] = nearest_rotation(motion[:3, :3])
    except InputError:
        fix = "its upper left 3 x 3 must be a rotation, without scale"
        raise InputError("not a rigid motion", where=where, fix=fix) from None
    if np.abs(motion[3] - [0, 0, 0, 1]).max() > _LAST_ROW:
        raise InputError("its last row must be 0, 0, 0, 1", where=where)
    motion[3] = 0, 0, 0, 1
    return motion


def rotation_from_quat_wxyz(quat_wxyz: FloatArray) -> FloatArray:
    """Convert a quaternion (4,), scalar first and of any length, to a rotation matrix (3, 3).

    Raises InputError if the quaternion is zero or not finite.
    """
    with np.errstate(over="ignore"):
        length = np.linalg.norm(quat_wxyz)
    if not (np.isfinite(length) and length > 0):
        raise InputError(f"{quat_wxyz.tolist()} is not a rotation", where="quaternion")
    # Not by SciPy: runs are identified by the exact bits of their poses.
    w, x, y, z = quat_wxyz / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quat_wxyz_from_rotation(rotation: FloatArray) -> FloatArray:
    """Convert a rotation matrix (3, 3) to a quaternion (4,), scalar first and >= 0."""
    return np.array(_quaternion(np.asarray(rotation)))


def spread_rotations(count: int) -> FloatArray:
    """Evenly spread rotations (count, 3, 3).

    Alexa, "Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3)", CVPR 2022.
    """
    from scipy.spatial.transform import Rotation  # slow to import

    psi = 1.533751168755204288118041
    place = np.arange(count) + 0.5
    r, q = np.sqrt(place / count), np.sqrt(1 - place / count)
    alpha, beta = 2 * np.pi * place / np.sqrt(2), 2 * np.pi * place / psi
    quats = np.stack([r * np.sin(alpha), r * np.cos(alpha), q * np.sin(beta), q * np.cos(beta)], 1)
    return np.asarray(Rotation.from_quat(quats).as_matrix())
