"""Lower bound of a model's squared errors over all poses and stretches."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import kernel
from cadalign.solvers.linalg import cholesky, eigenvectors_4

_CANCELLATION = 1e-10


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
    the depth d_i = c_z . a_i; poses of stretched models are some of these cameras. With w_i the
    weights and r_i the errors, the sum of w_i d_i^2 |r_i|^2 over all cameras with c_z' P c_z = 1,
    where P is the sum of w_i a_i a_i', is at least the smallest eigenvalue of the 4 x 4 problem of
    `cadalign.solvers.aepnp`. By Cauchy and Schwarz d_i^2 <= a_i' P^-1 a_i, the leverage of point
    i. So that eigenvalue over the largest leverage bounds the sum of w_i |r_i|^2.
    """
    n = points.shape[0]
    mean = np.zeros(5)
    total = 0.0
    for i in range(n):
        w = weights[seen[i]]
        total += w
        for j in range(3):
            mean[j] += w * points[i, j]
        for j in range(2):
            mean[3 + j] += w * rays[seen[i], j]
    mean /= total
    p = np.zeros((4, 4))
    a = np.empty((n, 4))
    for i in range(n):
        a[i, 0] = 1.0
        for j in range(3):
            a[i, 1 + j] = points[i, j] - mean[j]
        w = weights[seen[i]]
        for j in range(4):
            for k in range(j + 1):
                p[j, k] += w * a[i, j] * a[i, k]
    if not cholesky(p, 4, _CANCELLATION):
        return 0.0
    system = np.zeros((4, 4))
    u_matrix = np.zeros((4, 4))
    v_matrix = np.zeros((4, 4))
    leverage = 0.0
    white = np.empty(4)
    for i in range(n):  # in the basis that whitens a, P is the identity
        square = 0.0
        for j in range(4):
            value = a[i, j]
            for k in range(j):
                value -= p[j, k] * white[k]
            white[j] = value / p[j, j]
            square += white[j] * white[j]
        leverage = max(leverage, square)
        w = weights[seen[i]]
        u = rays[seen[i], 0] - mean[3]
        v = rays[seen[i], 1] - mean[4]
        for j in range(4):
            for k in range(j, 4):
                product = w * white[j] * white[k]
                u_matrix[j, k] += u * product
                v_matrix[j, k] += v * product
                system[j, k] += (u * u + v * v) * product
    for j in range(4):
        for k in range(j):
            u_matrix[j, k] = u_matrix[k, j]
            v_matrix[j, k] = v_matrix[k, j]
    largest = 0.0
    for j in range(4):
        largest = max(largest, system[j, j])
        for k in range(j, 4):
            for m in range(4):
                system[j, k] -= u_matrix[j, m] * u_matrix[m, k] + v_matrix[j, m] * v_matrix[m, k]
            system[k, j] = system[j, k]
    eigenvectors_4(system, np.empty((4, 4)))
    least = system[0, 0]
    for j in range(1, 4):
        least = min(least, system[j, j])
    return float(max(0.0, (least - 1e-12 * largest) / leverage))
