"""Compiled kernels of retrieval: lower bounds of candidates' costs, and the search for poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import inline, kernel
from cadalign.solvers.alignment import Objective, evaluate_cost
from cadalign.solvers.constants import OK, POSE_SIZE, ScalePrior
from cadalign.solvers.evidence import KeypointEvidence, take_keypoints
from cadalign.solvers.linalg import cholesky, mirror_upper
from cadalign.solvers.linear import aepnp_kernel
from cadalign.solvers.minimal import MAX_SOLUTIONS
from cadalign.solvers.search import refine
from cadalign.solvers.starts import choose_subsets, minimal_starts, rotation_starts
from cadalign.solvers.unknowns import uncenter

LEAST_SHARED = 4
"""Least number of shared keypoints of a candidate."""
MOST_STRETCH = 4.0
"""Largest stretch of a model; the least is its inverse."""
_BOUNDED_FROM = 6  # a general linear camera fits fewer points exactly
_PROBE_ITERATIONS = 4
_GRID_ROTATIONS = 48
# A start is dropped after its first steps if its cost exceeds the least cost by this factor and
# this excess.
_HOPELESS = 2.0
_HOPELESS_EXCESS = 20.0
_SAME_CHORD = 1e-3


class Query(NamedTuple):
    """Keypoints of an image, in the order of their semantic ids."""

    ids: IntArray  # (n,), ascending
    rays: FloatArray  # (n, 2), normalised image coordinates
    whitening: FloatArray  # (1 or n, 3); this and the loss as in solvers.evidence.KeypointEvidence
    loss: int
    loss_scale: float
    prior_weight: float
    free: FloatArray  # (8,)
    gains: FloatArray  # (n,), gain of log-likelihood by a shared keypoint without error


class Candidates(NamedTuple):
    """Keypoints of the candidates, each candidate's in the order of their ids."""

    xyz: FloatArray  # (k, 3), of the whole library
    ids: IntArray  # (k,), semantic ids
    spans: IntArray  # (c, 2): start and end of a candidate's keypoints


@kernel
def bound_all(query: Query, candidates: Candidates) -> tuple[FloatArray, FloatArray, IntArray]:
    """Lower bounds of the costs, gains, and numbers of shared keypoints, (c,) each."""
    count = candidates.spans.shape[0]
    bounds = np.zeros(count)
    gains = np.zeros(count)
    shared = np.zeros(count, dtype=np.int64)
    room = query.ids.shape[0]
    points = np.empty((room, 3))
    seen = np.empty(room, dtype=np.int64)
    weights = least_weights(query.whitening, room)
    for c in range(count):
        n = _gather(query, candidates, c, points, seen)
        shared[c] = n
        for i in range(n):
            gains[c] += query.gains[seen[i]]
        if n >= _BOUNDED_FROM:
            bounds[c] = error_bound(points, seen[:n], query.rays, weights)
    return bounds, gains, shared


@kernel
def search_all(
    query: Query,
    candidates: Candidates,
    chosen: IntArray,
    subsets: int,
    refined: int,
    iterations: int,
) -> tuple[FloatArray, FloatArray]:
    """Search the chosen candidates (m,) for poses; returns packed poses (m, 15) and costs (m,).

    The linear solver proposes one pose, and the minimal solver several poses for each of
    ``subsets`` 4-subsets of the keypoints. The best ``refined`` poses are refined in at most
    ``iterations`` steps. The cost is infinite if no pose is found.
    """
    poses = np.zeros((chosen.shape[0], POSE_SIZE))
    costs = np.full(chosen.shape[0], np.inf)
    room = query.ids.shape[0]
    points = np.empty((room, 3))
    seen = np.empty(room, dtype=np.int64)
    for m in range(chosen.shape[0]):
        n = _gather(query, candidates, chosen[m], points, seen)
        if n < LEAST_SHARED:
            continue
        image = KeypointEvidence(points, query.rays, query.whitening, query.loss, query.loss_scale)
        shared = take_keypoints(image, seen[:n])
        mean = np.zeros(3)
        for i in range(n):
            mean += shared.points[i] / n
        for i in range(n):
            shared.points[i] -= mean
        objective = Objective(query.free, shared, ScalePrior(query.prior_weight, 0.0))
        effort = subsets, refined, iterations
        costs[m] = _search(objective, effort, poses[m])
        uncenter(poses[m], mean, 1.0)
    return poses, costs


@kernel
def _gather(
    query: Query, candidates: Candidates, c: int, points: FloatArray, seen: IntArray
) -> int:
    """Write the shared model points in the image's rows, and these rows; returns their number."""
    first, last = candidates.spans[c, 0], candidates.spans[c, 1]
    n = 0
    i = 0
    k = first
    while i < query.ids.shape[0] and k < last:
        if query.ids[i] < candidates.ids[k]:
            i += 1
        elif query.ids[i] > candidates.ids[k]:
            k += 1
        else:
            for j in range(3):
                points[i, j] = candidates.xyz[k, j]
            seen[n] = i
            n += 1
            i += 1
            k += 1
    return n


@kernel
def _search(objective: Objective, effort: tuple[int, int, int], pose: FloatArray) -> float:
    """Write the best pose; returns its cost, or infinity without a pose."""
    subsets, refined, iterations = effort
    starts = np.empty((subsets * MAX_SOLUTIONS + 1 + _GRID_ROTATIONS, POSE_SIZE))
    count = _propose(objective, subsets, starts)
    probed = np.empty((refined, POSE_SIZE))
    costs = _probe(objective, starts[:count], probed)
    if not costs.min() < np.inf:  # all starts have points behind the camera
        count = rotation_starts(
            objective.keypoints.points, objective.keypoints.rays, starts[:_GRID_ROTATIONS]
        )
        costs = _probe(objective, starts[:count], probed)
    least = np.inf
    for _ in range(probed.shape[0]):
        best = np.argmin(costs)
        if not costs[best] < min(np.inf, _HOPELESS * least + _HOPELESS_EXCESS):
            break
        costs[best] = np.inf
        square = ((pose[:9] - probed[best, :9]) ** 2).sum()
        if least < np.inf and square < _SAME_CHORD * _SAME_CHORD:
            continue
        cost, _, _ = refine(objective, iterations, probed[best])
        cost = _limit_stretch(objective, iterations, probed[best], cost)
        if cost < least:
            least = cost
            pose[:] = probed[best]
    return least


@kernel
def _limit_stretch(objective: Objective, iterations: int, pose: FloatArray, cost: float) -> float:
    """Clamp the stretches and refine the other unknowns; returns the cost."""
    free = objective.free.copy()
    for _ in range(2):
        clamped = False
        for j in range(2):
            held = min(max(pose[13 + j], 1.0 / MOST_STRETCH), MOST_STRETCH)
            if held != pose[13 + j]:
                pose[13 + j] = held
                free[6 + j] = 0.0
                clamped = True
        if not clamped:
            break
        limited = Objective(free, objective.keypoints, objective.scale_prior)
        cost, _, _ = refine(limited, iterations, pose)
    return cost


@kernel
def _propose(objective: Objective, subsets: int, starts: FloatArray) -> int:
    """Write starting poses; returns their number."""
    points, rays, free = objective.keypoints.points, objective.keypoints.rays, objective.free
    chosen = np.empty((subsets, 4), dtype=np.int64)
    count = minimal_starts(points, rays, chosen, choose_subsets(points, chosen), starts)
    if aepnp_kernel(points, rays, starts[count]) == OK:
        count += 1
    # These starts are for coplanar points and fixed scales.
    if count == 0 or free[6] == 0.0 or free[7] == 0.0:
        count += rotation_starts(points, rays, starts[count : count + _GRID_ROTATIONS])
    for j in range(2):
        if free[6 + j] == 0.0:
            starts[:count, 13 + j] = 1.0
    return count


@kernel
def _probe(objective: Objective, starts: FloatArray, probed: FloatArray) -> FloatArray:
    """Refine the best starts by a few steps; returns their costs, or infinity."""
    scores = np.empty(starts.shape[0])
    for k in range(starts.shape[0]):
        scores[k] = evaluate_cost(objective, starts[k])
    costs = np.full(probed.shape[0], np.inf)
    for m in range(probed.shape[0]):
        best = -1
        for k in range(starts.shape[0]):
            if scores[k] < (scores[best] if best >= 0 else np.inf):
                best = k
        if best < 0:
            break
        scores[best] = np.inf
        probed[m] = starts[best]
        costs[m], _, _ = refine(objective, _PROBE_ITERATIONS, probed[m])
    return costs


_CANCELLATION = 1e-10
_ROUNDING = 1e-12  # of a matrix, relative to its largest element
_ROUNDS = 3  # more raise the bound by less than 1 %


@kernel
def least_weights(whitening: FloatArray, count: int) -> FloatArray:
    """Least weight of a squared error over all directions, for each ray, (n,)."""
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

    Points and rays have the same rows; ``seen`` (n,) are the rows to use.

    Let a_i = (1, x_i). A general linear camera projects it to (c_x . a_i, c_y . a_i) / d_i with the
    depth d_i = z . a_i; the poses of stretched models are such cameras. Let w_i be the weights, r_i
    the errors, and v_i > 0 any multipliers. The sum of v_i d_i^2 |r_i|^2 is at least z' S z, the
    4 x 4 problem of `cadalign.solvers.aepnp` with the weights v_i. It is at most the sum of
    w_i |r_i|^2 times the largest v_i d_i^2 / w_i. Let i be the point with the largest value. Then
    z' S z is at least d_i^2 / q_i with q_i = a_i' S^-1 a_i. So the sum of w_i |r_i|^2 is at least
    the least w_i / (v_i q_i) over all points.

    The first multipliers are the weights. The next ones are 1 / q_i, which are nearly w_i / d_i^2
    at the camera's depths. Then v_i d_i^2 / w_i is nearly the same for all points, and the bound is
    close to the least cost of a general linear camera.
    """
    n = seen.shape[0]
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


@inline
def _whiten(factor: FloatArray, row: FloatArray) -> float:
    """Divide the first 4 entries by a lower triangle, in place; returns their squared length."""
    square = 0.0
    for j in range(4):
        for k in range(j):
            row[j] -= factor[j, k] * row[k]
        row[j] /= factor[j, j]
        square += row[j] * row[j]
    return square


@kernel
def _depth_variances(
    points: FloatArray, seen: IntArray, rays: FloatArray, multipliers: FloatArray
) -> FloatArray:
    """q_i of `error_bound`, (n,); the first is 0 if S is numerically singular."""
    n, total = seen.shape[0], multipliers.sum()
    rows = np.ones((n, 6))  # 1, x, y, z, u, v, all but the 1 centred
    mean = np.zeros(6)
    for i in range(n):
        for j in range(3):
            rows[i, 1 + j] = points[seen[i], j]
        for j in range(2):
            rows[i, 4 + j] = rays[seen[i], j]
        for j in range(1, 6):
            mean[j] += multipliers[i] * rows[i, j] / total
    rows -= mean
    p = np.zeros((4, 4))
    for i in range(n):
        for j in range(4):
            scaled = multipliers[i] * rows[i, j]
            for k in range(j + 1):
                p[j, k] += scaled * rows[i, k]
    spread = np.zeros(n)
    if not cholesky(p, 4, _CANCELLATION):
        return spread
    system = np.zeros((4, 4))
    u_matrix = np.zeros((4, 4))
    v_matrix = np.zeros((4, 4))
    for i in range(n):
        _whiten(p, rows[i])  # in this basis P is the identity
        u, v = rows[i, 4], rows[i, 5]
        for j in range(4):
            for k in range(j, 4):
                product = multipliers[i] * rows[i, j] * rows[i, k]
                u_matrix[j, k] += u * product
                v_matrix[j, k] += v * product
                system[k, j] += (u * u + v * v) * product
    mirror_upper(u_matrix)
    mirror_upper(v_matrix)
    largest = 0.0
    for j in range(4):
        largest = max(largest, system[j, j])
    for j in range(4):
        for k in range(j + 1):
            for m in range(4):
                system[j, k] -= u_matrix[j, m] * u_matrix[m, k] + v_matrix[j, m] * v_matrix[m, k]
        system[j, j] -= _ROUNDING * largest
    if not cholesky(system, 4, 0.0):
        return spread
    for i in range(n):
        spread[i] = _whiten(system, rows[i])
    return spread
