"""Minimal solvers: all alignments that reproject 4 points exactly, all poses that reproject 3.

Poses are of a model without stretch; `reflect` gives the pose that looks alike from afar.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import inline, kernel
from cadalign.solvers.constants import POSE_SIZE
from cadalign.solvers.linalg import (
    Triple,
    copy_into,
    cross,
    dot,
    multiply,
    normalize,
    polish_rotation,
    second_moments,
    subtract,
)
from cadalign.solvers.polynomial import ROOTS_ROWS, real_roots
from cadalign.solvers.quadrics import (
    INTERSECTION_ROWS,
    POINTS,
    QUADRICS,
    hadamard,
    intersect_quadrics,
)
from cadalign.solvers.unknowns import pack_pose

MAX_SOLUTIONS = 8
MAX_POSES = 8
"""Largest number of poses of three points, without stretch."""
_DEGREE = 4  # of the P3P polynomial
_LARGEST_RATIO = 30.0  # of two depths of P3P
_TOUCHING = 1e-4  # see `real_roots`
_EXACT = 1e-6  # largest residual of a second P3P solution for one root
_ZERO = 1e-12  # constant coefficient that counts as a root at zero
_AXIS_STEPS = 8  # of the power method

# Largest cosine between columns of a rotation. The quadrics' residuals are relative to their
# summands, so short columns can be far from orthogonal despite small residuals.
_ORTHOGONAL = 1e-4


# Rows of the scratch memory, after those of `intersect_quadrics`.
_SAMPLE = INTERSECTION_ROWS  # 4 points
_RAYS = _SAMPLE + 4  # their unit rays
_WEIGHTS = _RAYS + 4  # see `_column_weights`
_PARTS = _WEIGHTS + 3  # see `_split_columns`
_ROWS = _PARTS + 12


def ap4p(
    points_3d: npt.ArrayLike, rays: npt.ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Solve anisotropic PnP from 4 points, without checking the input's values.

    The four depths are the only unknowns. The columns of ``R diag(scale)`` are linear in them.
    Orthogonality of the columns gives three homogeneous quadrics, which intersect in at most 8
    points; see `cadalign.solvers.quadrics`.

    Parameters
    ----------
    points_3d : (4, 3) float
        Model points that span a volume.
    rays : (4, 2) or (4, 3) float
        Normalised image coordinates (u, v), or directions of any length.

    Returns
    -------
    rotations : (k, 3, 3) float
    translations : (k, 3) float
    scales : (k, 3) float
        (1, s_y, s_z).

    The k = 0 to 8 solutions have positive depths, and are sorted by their stretch (sum of squared
    log scales), least first. Points in one plane have no solution.
    """
    points = np.ascontiguousarray(points_3d, dtype=np.float64)
    directions = np.ascontiguousarray(rays, dtype=np.float64)
    if directions.shape[1] == 2:
        directions = np.column_stack([directions, np.ones(4)])
    solutions = np.empty((MAX_SOLUTIONS, POSE_SIZE))
    count = ap4p_kernel(points, directions, solutions)
    found = solutions[:count]
    found = found[np.isfinite(found).all(axis=1)]
    found = found[np.argsort((np.log(found[:, 12:]) ** 2).sum(axis=1), kind="stable")]
    return found[:, :9].reshape(-1, 3, 3), found[:, 9:12].copy(), found[:, 12:].copy()


@kernel
def ap4p_kernel(points: FloatArray, rays: FloatArray, solutions: FloatArray) -> int:
    """Compiled `ap4p`: pack the solutions into ``solutions`` (8, 15), return their number."""
    memory = minimal_memory()
    for i in range(4):
        _write_point(points, i, (rays[i, 0], rays[i, 1], rays[i, 2]), memory, i)
    return _solve_four(memory, solutions)


@kernel
def minimal_memory() -> FloatArray:
    return np.empty((_ROWS, 16))


@kernel
def solve_subset(
    points: FloatArray,
    rays: FloatArray,
    chosen: IntArray,
    memory: FloatArray,
    solutions: FloatArray,
) -> int:
    """Like `ap4p_kernel`, for the 4 points with the indices ``chosen``."""
    for i in range(4):
        c = chosen[i]
        _write_point(points, c, (rays[c, 0], rays[c, 1], 1.0), memory, i)
    return _solve_four(memory, solutions)


@inline
def _write_point(points: FloatArray, i: int, ray: Triple, memory: FloatArray, row: int) -> None:
    direction = normalize(ray)
    for c in range(3):
        memory[_SAMPLE + row, c] = points[i, c]
        memory[_RAYS + row, c] = direction[c]


@inline
def _solve_four(memory: FloatArray, solutions: FloatArray) -> int:
    if not _column_weights(memory):
        return 0
    _split_columns(memory)
    _orthogonality_quadrics(memory)
    found = intersect_quadrics(memory)
    count = 0
    for k in range(found):
        if count < MAX_SOLUTIONS and _pack_solution(memory, POINTS + k, solutions, count):
            count += 1
    return count


@inline
def _column_weights(memory: FloatArray) -> bool:
    """Write the weights of camera-frame points in the columns of R diag(s); False if coplanar."""
    a, b, c = _difference(memory, 1), _difference(memory, 2), _difference(memory, 3)
    bc, ca, ab = cross(b, c), cross(c, a), cross(a, b)
    determinant = dot(a, bc)
    squares = 1.0  # product of squared lengths along the axes
    for j in range(3):
        squares *= a[j] * a[j] + b[j] * b[j] + c[j] * c[j]
    if not abs(determinant) > 1e-9 * np.sqrt(squares):
        return False
    scale = 1.0 / determinant
    for j in range(3):
        x, y, z = scale * bc[j], scale * ca[j], scale * ab[j]
        row = _WEIGHTS + j
        memory[row, 0], memory[row, 1], memory[row, 2], memory[row, 3] = -(x + y + z), x, y, z
    return True


@inline
def _difference(memory: FloatArray, i: int) -> Triple:
    return subtract(_triple(memory, _SAMPLE + i), _triple(memory, _SAMPLE))


@inline
def _split_columns(memory: FloatArray) -> None:
    """Write the columns' derivatives by the unknowns: column j is the sum of e_k times row 4 j + k.

    The unknowns are e = H d / 2, with the depths d and the Hadamard matrix H. The depths of an
    object are similar, so polynomials in their ratios suffer cancellation near 1; in e they are
    evaluated near 0. Positive depths imply |e_k| < e_0.
    """
    for j in range(3):
        for c in range(3):
            part = hadamard(
                memory[_WEIGHTS + j, 0] * memory[_RAYS, c],
                memory[_WEIGHTS + j, 1] * memory[_RAYS + 1, c],
                memory[_WEIGHTS + j, 2] * memory[_RAYS + 2, c],
                memory[_WEIGHTS + j, 3] * memory[_RAYS + 3, c],
            )
            for k in range(4):
                memory[_PARTS + 4 * j + k, c] = part[k]


@inline
def _orthogonality_quadrics(memory: FloatArray) -> None:
    """Write the quadrics that vanish for orthogonal columns, with largest coefficient 1."""
    for row in range(3):
        j, k = _PARTS + 4 * (row // 2), _PARTS + 4 * ((row + 3) // 2)
        largest = 0.0
        entry = 0
        for i in range(4):
            for m in range(i, 4):
                value = dot(_triple(memory, j + i), _triple(memory, k + m))
                if m > i:
                    value += dot(_triple(memory, j + m), _triple(memory, k + i))
                memory[QUADRICS + row, entry] = value
                largest = max(largest, abs(value))
                entry += 1
        scale = 1.0 / largest
        for entry in range(10):
            memory[QUADRICS + row, entry] *= scale


@inline
def _triple(memory: FloatArray, row: int) -> Triple:
    return memory[row, 0], memory[row, 1], memory[row, 2]


@kernel
def _pack_solution(memory: FloatArray, row: int, solutions: FloatArray, count: int) -> bool:
    """Pack rotation, translation and scale; False for a reflection or an inexact solution."""
    columns = np.empty((3, 3))
    for j in range(3):
        for i in range(3):
            total = 0.0
            for k in range(4):
                total += memory[_PARTS + 4 * j + k, i] * memory[row, k]
            columns[i, j] = total
    a, b, c = _column(columns, 0), _column(columns, 1), _column(columns, 2)
    if not dot(cross(a, b), c) > 0:
        return False
    lengths = (np.sqrt(dot(a, a)), np.sqrt(dot(b, b)), np.sqrt(dot(c, c)))
    cosine = max(
        max(abs(dot(a, b)) / (lengths[0] * lengths[1]), abs(dot(b, c)) / (lengths[1] * lengths[2])),
        abs(dot(c, a)) / (lengths[2] * lengths[0]),
    )
    if not cosine < _ORTHOGONAL:
        return False
    for j in range(3):
        for i in range(3):
            columns[i, j] /= lengths[j]
    pose = solutions[count]
    rotation = pose[:9].reshape(3, 3)
    polish_rotation(columns, rotation)
    for j in range(3):
        pose[12 + j] = lengths[j] / lengths[0]
    depths = hadamard(memory[row, 0], memory[row, 1], memory[row, 2], memory[row, 3])
    for i in range(3):
        total = 0.0
        for k in range(4):
            total += depths[k] * memory[_RAYS + k, i] / lengths[0]
            for j in range(3):
                total -= rotation[i, j] * pose[12 + j] * memory[_SAMPLE + k, j]
        pose[9 + i] = total / 4.0
    return True


@inline
def _column(matrix: FloatArray, j: int) -> Triple:
    return matrix[0, j], matrix[1, j], matrix[2, j]


# Without stretch ----------------------------------------------------------------------------------


@kernel
def p3p_memory() -> FloatArray:
    return np.empty((ROOTS_ROWS, 2 * _DEGREE))


@kernel
def p3p_kernel(
    points: FloatArray, rays: FloatArray, chosen: IntArray, memory: FloatArray, poses: FloatArray
) -> int:
    """Pack the poses of 3 ``chosen`` points into ``poses`` (8, 15); returns their number.

    The depths are d, (1 + e p) d and (1 + e q) d, where e is the chord between two unit rays; this
    keeps the magnitudes of p and q independent of the distance. The triangle's sides give two
    conics in p and q. Their difference is linear in p, so q is a root of a quartic (Grunert, 1841).
    """
    first, second, third = chosen[0], chosen[1], chosen[2]
    a, b, c = _triple(points, first), _triple(points, second), _triple(points, third)
    x, y, z = _unit_ray(rays, first), _unit_ray(rays, second), _unit_ray(rays, third)
    side, chord = _squared_distance(a, c), _squared_distance(x, z)
    if not min(side, chord) > 0.0:
        return 0
    e = np.sqrt(chord)
    near, far = _squared_distance(x, y), _squared_distance(y, z)
    ratio, g = _squared_distance(a, b) / side, near / e
    excess = ratio - _squared_distance(b, c) / side
    # p^2 + g p = k(q), and m(q) + p l(q) = 0
    k0, k1, k2 = ratio - near / chord, ratio * e, ratio
    m0, m1, m2 = (far - near) / chord + excess, far / e + excess * e, 1.0 + excess
    l0, l1 = (far - near) / e, far - 2.0
    # m^2 - g m l - k l^2 = 0
    n0, n1, n2 = l0 * l0, 2.0 * l0 * l1, l1 * l1
    memory[0, 0] = m0 * m0 - g * m0 * l0 - k0 * n0
    memory[0, 1] = 2.0 * m0 * m1 - g * (m0 * l1 + m1 * l0) - k0 * n1 - k1 * n0
    memory[0, 2] = 2.0 * m0 * m2 + m1 * m1 - g * (m1 * l1 + m2 * l0)
    memory[0, 2] -= k0 * n2 + k1 * n1 + k2 * n0
    memory[0, 3] = 2.0 * m1 * m2 - g * m2 * l1 - k1 * n2 - k2 * n1
    memory[0, 4] = m2 * m2 - k2 * n2
    count = 0
    found = real_roots(memory, 0, _DEGREE, _LARGEST_RATIO / e, _TOUCHING)
    is_symmetric = abs(memory[0, 0]) < _ZERO  # symmetric triangle, seen along its axis
    if is_symmetric and found < 2 * _DEGREE:
        memory[1, found] = 0.0
        found += 1
    for root in range(found):
        q = memory[1, root]
        m, n = m0 + q * (m1 + q * m2), l0 + q * l1
        half = np.sqrt(max(g * g / 4.0 + k0 + q * (k1 + q * k2), 0.0))
        is_upper = abs(m + (half - g / 2.0) * n) < abs(m - (half + g / 2.0) * n)
        for sign in (-1.0, 1.0):
            p = sign * half - g / 2.0
            if (sign > 0.0) != is_upper and abs(m + p * n) > _EXACT:
                continue
            depth = np.sqrt(side / chord / (1.0 + q * (e + q)))
            depths = depth, depth * (1.0 + e * p), depth * (1.0 + e * q)
            if count < MAX_POSES and min(depths) > 0.0:
                seen = multiply(x, depths[0]), multiply(y, depths[1]), multiply(z, depths[2])
                count += _pack_motion((a, b, c), seen, poses[count])
    return count


@inline
def _unit_ray(rays: FloatArray, i: int) -> Triple:
    return normalize((rays[i, 0], rays[i, 1], 1.0))


@inline
def _squared_distance(first: Triple, second: Triple) -> float:
    difference = subtract(first, second)
    return dot(difference, difference)


@kernel
def _pack_motion(
    model: tuple[Triple, Triple, Triple], seen: tuple[Triple, Triple, Triple], pose: FloatArray
) -> bool:
    """Pack the motion of a triangle onto a congruent one; False for collinear points."""
    rotation, shift = np.empty((3, 3)), np.empty(3)
    before, after = _frame(model), _frame(seen)
    for i in range(3):
        for j in range(3):
            rotation[i, j] = after[0][i] * before[0][j]
            rotation[i, j] += after[1][i] * before[1][j] + after[2][i] * before[2][j]
        shift[i] = seen[0][i] - dot(_triple(rotation, i), model[0])
    pack_pose(rotation, shift, np.ones(3), pose)
    return bool(np.isfinite(pose).all())


@inline
def _frame(corners: tuple[Triple, Triple, Triple]) -> tuple[Triple, Triple, Triple]:
    """Axes of a triangle: along a side, in its plane, and along its normal."""
    x = normalize(subtract(corners[2], corners[0]))
    z = normalize(cross(x, subtract(corners[1], corners[0])))
    return x, cross(z, x), z


@kernel
def reflect(points: FloatArray, pose: FloatArray, other: FloatArray) -> None:
    """Write the pose that looks alike from afar: relative depths and the thinnest axis reversed."""
    xx, xy, xz, yy, yz, zz = second_moments(points)
    # The dominant eigenvector of the adjugate is the moments' eigenvector of least value.
    first = (yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy)
    second = (first[1], xx * zz - xz * xz, xy * xz - xx * yz)
    third = (first[2], second[2], xx * yy - xy * xy)
    axis = first if first[0] > max(second[1], third[2]) else second
    axis = third if third[2] > max(first[0], second[1]) else axis
    for _ in range(_AXIS_STEPS):
        axis = normalize((dot(first, axis), dot(second, axis), dot(third, axis)))
    sight = normalize((pose[9], pose[10], pose[11]))
    copy_into(other, pose)
    for j in range(3):
        column = (pose[j], pose[3 + j], pose[6 + j])
        along = 2.0 * dot(sight, column)
        for i in range(3):
            other[3 * i + j] -= along * sight[i]
    for i in range(3):
        along = 2.0 * dot(axis, (other[3 * i], other[3 * i + 1], other[3 * i + 2]))
        for j in range(3):
            other[3 * i + j] -= along * axis[j]
