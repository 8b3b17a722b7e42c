"""Poses of a model without stretch: those that reproject 3 points exactly, and reflected ones."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import inlined, kernel
from cadalign.solvers.alignment import Objective
from cadalign.solvers.constants import POSE_SIZE, UNKNOWNS, ScalePrior
from cadalign.solvers.evidence import KeypointEvidence, take_keypoints
from cadalign.solvers.linalg import Triple, copy_into, cross, dot
from cadalign.solvers.polynomial import ROOTS_ROWS, real_roots
from cadalign.solvers.ransac import score_pose
from cadalign.solvers.search import refine
from cadalign.solvers.unknowns import pack_pose

MAX_POSES = 8
_DEGREE = 4
_LARGEST_RATIO = 30.0  # of depths
_TOUCHING = 1e-4
_EXACT = 1e-6
_ZERO = 1e-12
_AXIS_STEPS = 8  # of the power method
_SAMPLE_ITERATIONS = 4


@kernel
def p3p_memory() -> FloatArray:
    """Scratch space for any number of calls of `p3p_kernel`."""
    return np.empty((ROOTS_ROWS, 2 * _DEGREE))


@kernel
def p3p_kernel(
    points: FloatArray, rays: FloatArray, chosen: IntArray, memory: FloatArray, poses: FloatArray
) -> int:
    """Pack the poses from the points with the 3 numbers ``chosen`` into ``poses`` (8, 15).

    ``points`` (n, 3) are seen at normalised image coordinates ``rays`` (n, 2). The depths are d,
    (1 + e p) d and (1 + e q) d, where e is the chord between two of the rays, so that p and q are
    of one size near and far. The triangle's sides give two conics in p and q, whose difference is
    linear in p: q is the root of a quartic, as the ratio of depths is in Grunert's of 1841. Returns
    the number of poses.
    """
    first, second, third = chosen[0], chosen[1], chosen[2]
    a, b, c = _point(points, first), _point(points, second), _point(points, third)
    x, y, z = _unit_ray(rays, first), _unit_ray(rays, second), _unit_ray(rays, third)
    side, chord = _apart(a, c), _apart(x, z)
    if not min(side, chord) > 0.0:
        return 0
    e = np.sqrt(chord)
    near, far = _apart(x, y), _apart(y, z)
    ratio, g = _apart(a, b) / side, near / e
    excess = ratio - _apart(b, c) / side
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
    if (
        abs(memory[0, 0]) < _ZERO and found < 2 * _DEGREE
    ):  # a triangle seen along its axis of symmetry
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
                seen = _scaled(x, depths[0]), _scaled(y, depths[1]), _scaled(z, depths[2])
                count += _pack_motion((a, b, c), seen, poses[count])
    return count


@inlined
def _point(rows: FloatArray, i: int) -> Triple:
    return rows[i, 0], rows[i, 1], rows[i, 2]


@inlined
def _unit_ray(rays: FloatArray, i: int) -> Triple:
    u, v = rays[i, 0], rays[i, 1]
    inverse = 1.0 / np.sqrt(u * u + v * v + 1.0)
    return u * inverse, v * inverse, inverse


@inlined
def _scaled(vector: Triple, factor: float) -> Triple:
    return vector[0] * factor, vector[1] * factor, vector[2] * factor


@inlined
def _minus(first: Triple, second: Triple) -> Triple:
    return first[0] - second[0], first[1] - second[1], first[2] - second[2]


@inlined
def _apart(first: Triple, second: Triple) -> float:
    """The square of the distance of two points."""
    difference = _minus(first, second)
    return dot(difference, difference)


@inlined
def _unit(vector: Triple) -> Triple:
    return _scaled(vector, 1.0 / np.sqrt(dot(vector, vector)))


@kernel
def _pack_motion(
    model: tuple[Triple, Triple, Triple], seen: tuple[Triple, Triple, Triple], pose: FloatArray
) -> bool:
    """Pack the motion of a triangle onto a congruent one; False for points in one line."""
    rotation, shift = np.empty((3, 3)), np.empty(3)
    from_x, from_z = _unit(_minus(model[2], model[0])), _minus(model[1], model[0])
    from_z = _unit(cross(from_x, from_z))
    from_y = cross(from_z, from_x)
    to_x, to_z = _unit(_minus(seen[2], seen[0])), _minus(seen[1], seen[0])
    to_z = _unit(cross(to_x, to_z))
    to_y = cross(to_z, to_x)
    for i in range(3):
        for j in range(3):
            rotation[i, j] = to_x[i] * from_x[j] + to_y[i] * from_y[j] + to_z[i] * from_z[j]
        shift[i] = seen[0][i] - (
            rotation[i, 0] * model[0][0]
            + rotation[i, 1] * model[0][1]
            + rotation[i, 2] * model[0][2]
        )
    pack_pose(rotation, shift, np.ones(3), pose)
    return bool(np.isfinite(pose).all())


@kernel
def reflect(points: FloatArray, pose: FloatArray, other: FloatArray) -> None:
    """Write the pose that looks like another one from afar: depths and the least axis reversed.

    ``points`` (n, 3) are centred. The image from afar stays if depths are reversed, which mirrors
    the model; its mirror image in the plane that the points are nearest to is most like it.
    """
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        xx, xy, xz = xx + x * x, xy + x * y, xz + x * z
        yy, yz, zz = yy + y * y, yz + y * z, zz + z * z
    # The adjugate's largest eigenvector is the moments' least one.
    first = (yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy)
    second = (first[1], xx * zz - xz * xz, xy * xz - xx * yz)
    third = (first[2], second[2], xx * yy - xy * xy)
    axis = first if first[0] > max(second[1], third[2]) else second
    axis = third if third[2] > max(first[0], second[1]) else axis
    for _ in range(_AXIS_STEPS):
        axis = _unit((dot(first, axis), dot(second, axis), dot(third, axis)))
    sight = _unit((pose[9], pose[10], pose[11]))
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


@kernel
def rigid_hypotheses(
    keypoints: KeypointEvidence, draws: IntArray, limit: float
) -> tuple[FloatArray, FloatArray]:
    """Poses (S, 15) of samples (S, k) of keypoints, and their truncated scores (S,) on all.

    The pose of a sample is the one from its first three keypoints that fits all of it best, after a
    few steps; where there is none, the score is infinite.
    """
    free = np.ones(UNKNOWNS)
    free[6:] = 0.0
    memory, solutions = p3p_memory(), np.empty((MAX_POSES, POSE_SIZE))
    poses, scores = np.empty((draws.shape[0], POSE_SIZE)), np.full(draws.shape[0], np.inf)
    for s in range(draws.shape[0]):
        sample = take_keypoints(keypoints, draws[s])
        objective = Objective(free, sample, ScalePrior(0.0, 0.0))
        found = p3p_kernel(keypoints.points, keypoints.rays, draws[s], memory, solutions)
        least = np.inf
        for k in range(found):
            cost, _, _ = refine(objective, _SAMPLE_ITERATIONS, solutions[k])
            if cost < least:
                least = cost
                copy_into(poses[s], solutions[k])
        if least < np.inf:
            scores[s] = score_pose(keypoints, poses[s], limit, np.inf, 0.0, 1.0)[0]
    return poses, scores
