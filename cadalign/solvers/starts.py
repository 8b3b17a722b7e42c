"""Starts of a search for alignments, from minimal solvers and from a grid of rotations."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import kernel
from cadalign.solvers.linalg import (
    cholesky,
    cross,
    dot,
    rotation_from_quaternion,
    second_moments,
    solve_cholesky,
    subtract,
    triple,
)
from cadalign.solvers.minimal import MAX_SOLUTIONS, minimal_memory, solve_subset
from cadalign.solvers.unknowns import pack_pose

_DRAWS_PER_SUBSET = 4
_LEAST_DEPTH = 1e-9


@kernel
def minimal_starts(
    points: FloatArray, rays: FloatArray, subsets: IntArray, count: int, poses: FloatArray
) -> int:
    """Write all minimal solutions of the first ``count`` subsets (S, 4); returns their number."""
    memory = minimal_memory()
    found = 0
    for s in range(count):
        room = poses[found : found + MAX_SOLUTIONS]
        found += solve_subset(points, rays, subsets[s], memory, room)
    return found


@kernel
def choose_subsets(points: FloatArray, subsets: IntArray) -> int:
    """Fill ``subsets`` (k, 3 or 4) with all, or k of large area or volume; returns their number."""
    n = points.shape[0]
    wanted, size = subsets.shape
    draw = np.arange(size)
    total = 1
    for k in range(size):
        total = total * (n - k) // (k + 1)
    if total <= wanted:
        for row in range(total):
            for k in range(size):
                subsets[row, k] = draw[k]
            next_subset(draw, n)
        return int(total)
    volumes = np.full(wanted, -1.0)
    state = np.uint64(88172645463325252)
    for _ in range(_DRAWS_PER_SUBSET * wanted):
        k = 0
        while k < size:  # xorshift with a fixed seed, so results are reproducible
            state ^= state << np.uint64(13)
            state ^= state >> np.uint64(7)
            state ^= state << np.uint64(17)
            index = np.int64((state >> np.uint64(11)) % np.uint64(n))
            fresh = True
            for m in range(k):
                fresh = fresh and draw[m] != index
            if fresh:
                draw[k] = index
                k += 1
        volume = _extent(points, draw)
        worst = 0
        for m in range(1, wanted):
            if volumes[m] < volumes[worst]:
                worst = m
        if volume > volumes[worst]:
            volumes[worst] = volume
            for m in range(size):
                subsets[worst, m] = draw[m]
    return int(wanted)


@kernel
def _extent(points: FloatArray, chosen: IntArray) -> float:
    """6 times the volume of a tetrahedron, or 4 times the squared area of a triangle."""
    first = triple(points[chosen[0]])
    u, v = subtract(triple(points[chosen[1]]), first), subtract(triple(points[chosen[2]]), first)
    normal = cross(u, v)
    if chosen.shape[0] == 3:
        return dot(normal, normal)
    return abs(dot(subtract(triple(points[chosen[3]]), first), normal))


@kernel
def relief(points: FloatArray, rays: FloatArray, whitening: FloatArray) -> float:
    """Approximate RMS distance of centred points (n, 3) from their plane, in sigmas of rays."""
    a, p, q, b, r, c = second_moments(points)
    minors = a * b - p * p + a * c - q * q + b * c - r * r
    determinant = a * (b * c - r * r) - p * (p * c - q * r) + q * (p * r - b * q)
    information = 0.0
    for i in range(whitening.shape[0]):
        information += whitening[i, 0] * whitening[i, 2] / whitening.shape[0]
    if not minors > 0.0:
        return 0.0
    share = max(determinant, 0.0) / minors / (a + b + c)
    return float(np.sqrt(share * (rays[:, 0].var() + rays[:, 1].var()) * information))


@kernel
def rotation_starts(points: FloatArray, rays: FloatArray, poses: FloatArray) -> int:
    """Write poses (k, 15) of the unstretched model at k evenly spread rotations.

    Rotations lie on a super-Fibonacci spiral (Alexa, "Super-Fibonacci spirals: fast,
    low-discrepancy sampling of SO(3)", 2022). The translation follows from linear equations, also
    for coplanar points. Returns the number of poses.
    """
    wanted = poses.shape[0]
    rotation = np.empty((3, 3))
    matrix = np.empty((3, 3))
    right = np.empty(3)
    coordinate_of = np.ones(3)
    found = 0
    for k in range(wanted):
        s = (k + 0.5) / wanted
        alpha = 2.0 * np.pi * (k + 0.5) / np.sqrt(2.0)
        beta = 2.0 * np.pi * (k + 0.5) / 1.533751168755204288118041
        low, high = np.sqrt(s), np.sqrt(1.0 - s)
        w, x, y, z = (
            low * np.sin(alpha),
            low * np.cos(alpha),
            high * np.sin(beta),
            high * np.cos(beta),
        )
        rotation_from_quaternion(w, x, y, z, rotation)
        matrix[:] = 0.0
        right[:] = 0.0
        for i in range(points.shape[0]):
            u, v = rays[i, 0], rays[i, 1]
            x = y = z = 0.0
            for j in range(3):
                x += rotation[0, j] * points[i, j]
                y += rotation[1, j] * points[i, j]
                z += rotation[2, j] * points[i, j]
            # t_x - u t_z = u z - x and t_y - v t_z = v z - y
            p, q = u * z - x, v * z - y
            matrix[0, 0] += 1.0
            matrix[1, 1] += 1.0
            matrix[2, 0] -= u
            matrix[2, 1] -= v
            matrix[2, 2] += u * u + v * v
            right[0] += p
            right[1] += q
            right[2] -= u * p + v * q
        if not cholesky(matrix, 3, 1e-12):
            continue
        solve_cholesky(matrix, 3, right)
        pack_pose(rotation, right, coordinate_of, poses[found])
        found += 1
    return found


def widen_by_shape(
    points: FloatArray, rays: FloatArray, variances: FloatArray, whitening: FloatArray
) -> FloatArray:
    """Whitening (..., n, 3) that includes variances (..., n) of the shape's coordinates."""
    extent, size = points.var(axis=-2).sum(axis=-1), rays.var(axis=0).sum()
    depth = np.maximum(np.sqrt(extent * 2.0 / 3.0 / max(size, 1e-30)), _LEAST_DEPTH)[..., None]
    # Assumes a whitening (a, b, c) with small b.
    information = np.square(whitening[:, ::2]).sum(axis=1) / 2.0
    return np.asarray(whitening / np.sqrt(1.0 + variances / depth**2 * information)[..., None])


@kernel
def next_subset(chosen: IntArray, count: int) -> bool:
    """Advance to the next subset in lexicographic order; False after the last."""
    size = chosen.shape[0]
    i = size - 1
    while i >= 0 and chosen[i] == count - size + i:
        i -= 1
    if i < 0:
        return False
    chosen[i] += 1
    for k in range(i + 1, size):
        chosen[k] = chosen[k - 1] + 1
    return True
