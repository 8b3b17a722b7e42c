"""Lower bound of a model's squared errors over all poses and stretches."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import kernel
from cadalign.solvers.linalg import cholesky

_CANCELLATION = 1e-10
_ROUNDING = 1e-12  # of a matrix, relative to its largest element
_ROUNDS = 3  # more raise the bound by less than 1 %


@kernel
def least_weights(whitening: FloatArray, count: int) -> FloatArray:
    """Smallest weight of a squared error of each ray, over all directions, (n,)."""
    weights = np.empty(count)
    for i in range(count):
        w = i if whitening.shape[0] > 1 else 0
        a, b, c = whitening[w, 0], whitening[w, 1], whitening[w, 2]
        trace = a * a + b * b + c * c
        determinant = (a * c) ** 2
        weights[i] = 0.5 * (trace - np.sqrt(max(trace * trace - 4.0 * determinant, 0.0)))
    return weights


@kernel
def error_bound(points: FloatArray, seen: IntArray, rays: FloatArray, weights: FloatArray) -> float:
    """Bound the sum of squared whitened errors over all poses and stretches from below.

    Let a_i = (1, x_i), and let a general linear camera take it to (c_x . a_i, c_y . a_i) / d_i with
    the depth d_i = z . a_i; poses of stretched models are some of these cameras. With w_i the
    weights and r_i the errors, and for any multipliers v_i > 0, the sum of v_i d_i^2 |r_i|^2 is at
    least z' S z, the 4 x 4 problem of `cadalign.solvers.aepnp` with the weights v_i. It is at most
    the sum of w_i |r_i|^2 times the largest v_i d_i^2 / w_i. If point i has that, z' S z is at
    least d_i^2 / q_i with q_i = a_i' S^-1 a_i. So the least of w_i / (v_i q_i) over the points
    bounds the sum of w_i |r_i|^2.

    The first multipliers are the weights. The next are 1 / q_i of the last ones, which are nearly
    w_i / d_i^2 at the camera's depths: then v_i d_i^2 / w_i is the same for all points, and the
    bound is that of a general linear camera.
    """
    n = points.shape[0]
    multipliers = np.empty(n)
    for i in range(n):
        multipliers[i] = weights[seen[i]]
    best = 0.0
    for _ in range(_ROUNDS):
        spread = _depth_variances(points, seen, rays, multipliers)
        if not spread[0] > 0.0:
            return best
        largest = 0.0
        for i in range(n):
            largest = max(largest, multipliers[i] * spread[i] / weights[seen[i]])
        best = max(best, 1.0 / largest)
        for i in range(n):
            multipliers[i] = 1.0 / spread[i]
    return best


@kernel
def _depth_variances(
    points: FloatArray, seen: IntArray, rays: FloatArray, multipliers: FloatArray
) -> FloatArray:
    """Compute q_i of `error_bound`, (n,); the first is 0 if S is singular to rounding."""
    n = points.shape[0]
    mean = np.zeros(5)
    total = 0.0
    for i in range(n):
        w = multipliers[i]
        total += w
        for j in range(3):
            mean[j] += w * points[i, j]
        for j in range(2):
            mean[3 + j] += w * rays[seen[i], j]
    for j in range(5):
        mean[j] /= total
    p = np.zeros((4, 4))
    white = np.empty((n, 4))
    spread = np.zeros(n)
    for i in range(n):
        white[i, 0] = 1.0
        for j in range(3):
            white[i, 1 + j] = points[i, j] - mean[j]
        for j in range(4):
            scaled = multipliers[i] * white[i, j]
            for k in range(j + 1):
                p[j, k] += scaled * white[i, k]
    if not cholesky(p, 4, _CANCELLATION):
        return spread
    system = np.zeros((4, 4))
    u_matrix = np.zeros((4, 4))
    v_matrix = np.zeros((4, 4))
    for i in range(n):  # in the basis that whitens a, P is the identity
        for j in range(4):
            value = white[i, j]
            for k in range(j):
                value -= p[j, k] * white[i, k]
            white[i, j] = value / p[j, j]
        w = multipliers[i]
        u = rays[seen[i], 0] - mean[3]
        v = rays[seen[i], 1] - mean[4]
        for j in range(4):
            for k in range(j + 1):
                product = w * white[i, j] * white[i, k]
                u_matrix[j, k] += u * product
                v_matrix[j, k] += v * product
                system[j, k] += (u * u + v * v) * product
    largest = 0.0
    for j in range(4):
        largest = max(largest, system[j, j])
        for k in range(j):
            u_matrix[k, j] = u_matrix[j, k]
            v_matrix[k, j] = v_matrix[j, k]
    for j in range(4):
        for k in range(j + 1):
            for m in range(4):
                system[j, k] -= u_matrix[j, m] * u_matrix[m, k] + v_matrix[j, m] * v_matrix[m, k]
        system[j, j] -= _ROUNDING * largest
    if not cholesky(system, 4, 0.0):
        return spread
    for i in range(n):
        square = 0.0
        for j in range(4):
            value = white[i, j]
            for k in range(j):
                value -= system[j, k] * white[i, k]
            white[i, j] = value / system[j, j]
            square += white[i, j] * white[i, j]
        spread[i] = square
    return spread
