"""The optimum: the maximum-likelihood alignment, and the starts of the search for it."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import inlined, kernel
from cadalign.solvers.alignment import (
    Objective,
    center_and_unit,
    covariance_of,
    with_keypoints,
    with_points,
)
from cadalign.solvers.constants import (
    DEGENERATE,
    NOT_FOUND,
    OK,
    OUT_OF_RANGE,
    POSE_SIZE,
    TOO_FEW,
    UNKNOWNS,
    ScalePrior,
)
from cadalign.solvers.evidence import KeypointEvidence, take_keypoints
from cadalign.solvers.linalg import (
    Triple,
    cholesky,
    copy_into,
    cross,
    dot,
    rotation_from_quaternion,
    solve_cholesky,
)
from cadalign.solvers.linear import aepnp_kernel
from cadalign.solvers.minimal import MAX_SOLUTIONS, minimal_memory, solve_subset
from cadalign.solvers.search import Effort, Minima, search
from cadalign.solvers.unknowns import orthonormalize, pack_pose, uncenter

MAX_MINIMA = 12
_COARSE_POINTS = 48  # that many tell the minima apart; all points then refine them
_GRID_ROTATIONS = 96
_GRID_REFINED = 20
_PROBE_ITERATIONS = 6
_MAX_ITERATIONS = 200
_LEAST_RELIEF = 3.0  # of points whose subsets tell their depths
_UNLIKELY = 40.0  # excess cost, over a unit variance, at which a coarse minimum is given up
_DRAWS_PER_SUBSET = 4
_LEAST_DEPTH = 1e-9


@kernel
def optimal_batch(
    points: FloatArray,
    rays: FloatArray,
    whitening: FloatArray,
    offsets: IntArray,
    loss: int,
    loss_scale: FloatArray,
    prior_weight: FloatArray,
    prior_width: float,
    free: FloatArray,
    min_points: int,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray, IntArray]:
    """Find the optimum of every problem; a single fit is a batch of one.

    Problem b has the rows ``offsets[b]`` to ``offsets[b + 1]``. ``loss_scale`` and ``prior_weight``
    (B,), the weight of a `ScalePrior` of ``prior_width``, are in units of the whitening's sigma.
    Returns the minima's poses (B, MAX_MINIMA, 15) and costs (B, MAX_MINIMA), the covariance of the
    best (B, 8, 8), statuses (B,), and (B, 4) the number of minima, iterations, hypotheses, and the
    number of an undetermined unknown or -1.
    """
    count = offsets.shape[0] - 1
    poses = np.zeros((count, MAX_MINIMA, POSE_SIZE))
    costs = np.full((count, MAX_MINIMA), np.inf)
    covariances = np.zeros((count, UNKNOWNS, UNKNOWNS))
    info = np.zeros((count, 4), dtype=np.int64)
    statuses = np.zeros(count, dtype=np.int64)
    for b in range(count):
        start, end = offsets[b], offsets[b + 1]
        if end - start < min_points:
            statuses[b] = TOO_FEW
            continue
        keypoints = KeypointEvidence(
            points[start:end],
            rays[start:end],
            whitening[start:end] if whitening.shape[0] > 1 else whitening,
            loss,
            loss_scale[b],
        )
        objective = Objective(free, keypoints, ScalePrior(prior_weight[b], prior_width))
        info[b, 0], info[b, 1], info[b, 2], info[b, 3] = optimal_kernel(
            objective, poses[b], costs[b], covariances[b]
        )
        if info[b, 3] >= 0:
            statuses[b] = DEGENERATE
        elif info[b, 0] == 0:
            statuses[b] = NOT_FOUND
        elif not np.isfinite(covariances[b]).all():
            statuses[b] = OUT_OF_RANGE
    return poses, costs, covariances, statuses, info


@kernel
def optimal_kernel(
    objective: Objective, poses: FloatArray, costs: FloatArray, covariance: FloatArray
) -> tuple[int, int, int, int]:
    """Write the minima of one problem, the best first, and its covariance; returns the `info`."""
    points = objective.keypoints.points
    center, unit = center_and_unit(points)
    if not unit > 0:
        return 0, 0, 0, 0
    local = with_points(objective, (points - center) / unit)
    counts = np.zeros(2, dtype=np.int64)
    found = Minima(poses, costs, costs.copy(), np.zeros(MAX_MINIMA, dtype=np.int64), counts)
    hypotheses = _search(local, found)
    minima, iterations = int(counts[0]), int(counts[1])
    if minima == 0:
        return 0, iterations, hypotheses, -1
    for k in range(minima):
        orthonormalize(poses[k])
        uncenter(poses[k], center, unit)
    return minima, iterations, hypotheses, covariance_of(objective, poses[0], covariance)


@kernel
def _search(objective: Objective, minima: Minima) -> int:
    """Find the minima; returns the number of starts.

    Where there are many points the search runs on some of them, and what it finds is refined on
    all.
    """
    linear = np.empty(POSE_SIZE)
    keypoints = objective.keypoints
    is_solved = aepnp_kernel(keypoints.points, keypoints.rays, linear) == OK
    n = keypoints.points.shape[0]
    if n <= _COARSE_POINTS:
        return _search_from_all_starts(objective, linear, is_solved, minima)
    chosen = np.arange(_COARSE_POINTS) * n // _COARSE_POINTS  # evenly spread over their order
    coarse = with_keypoints(objective, take_keypoints(keypoints, chosen))
    hypotheses = _search_from_all_starts(coarse, linear, is_solved, minima)
    found = minima.counts[0]
    starts = np.empty((found + 1, POSE_SIZE))
    count = 0
    # A wrong sigma should not make every coarse minimum look unlikely.
    variance = max(1.0, minima.costs[0] / (2.0 * _COARSE_POINTS - UNKNOWNS)) if found else 1.0
    while count < found and minima.costs[count] - minima.costs[0] < _UNLIKELY * variance:
        copy_into(starts[count], minima.states[count])
        count += 1
    minima.counts[0] = 0
    minima.costs[:] = np.inf
    minima.scores[:] = np.inf
    everything = Effort(MAX_MINIMA, _PROBE_ITERATIONS, _MAX_ITERATIONS, np.inf)
    search(objective, starts[:count], everything, 0, 0.0, minima)
    if minima.counts[0] == 0 and is_solved:  # with strong noise, some may have no minimum
        copy_into(starts[0], linear)
        search(objective, starts[:1], everything, 0, 0.0, minima)
    return hypotheses


@kernel
def _search_from_all_starts(
    objective: Objective, linear: FloatArray, is_solved: bool, minima: Minima
) -> int:
    """Refine the most promising of all starts; returns their number.

    ``linear`` is the linear solver's pose, where it has one.
    """
    points, rays, free = objective.keypoints.points, objective.keypoints.rays, objective.free
    subset_count, refined = _effort(points.shape[0])
    starts = np.empty((subset_count * MAX_SOLUTIONS + 1 + _GRID_ROTATIONS, POSE_SIZE))
    count = 0
    if points.shape[0] >= 4:
        subsets = np.empty((subset_count, 4), dtype=np.int64)
        chosen = choose_subsets(points, subsets)
        count = minimal_starts(points, rays, subsets, chosen, starts)
    if is_solved:
        copy_into(starts[count], linear)
        count += 1
    # Other starts serve points that are nearly coplanar, or few subsets, and where the unstretched
    # model is a better guess.
    prior = objective.scale_prior
    needs_grid = free[6] == 0.0 or free[7] == 0.0 or (prior.weight > 0.0 and prior.width == 0.0)
    needs_grid = needs_grid or points.shape[0] == 5
    needs_grid = needs_grid or relief(points, rays, objective.keypoints.whitening) < _LEAST_RELIEF
    for attempt in range(2):
        if minima.counts[0] > 0 or (attempt == 0 and needs_grid):
            continue
        if attempt == 1:
            count += rotation_starts(points, rays, starts[count : count + _GRID_ROTATIONS])
            refined = _GRID_REFINED
        for k in range(count):
            for j in range(2):
                if free[6 + j] == 0.0:
                    starts[k, 13 + j] = 1.0
        effort = Effort(refined, _PROBE_ITERATIONS, _MAX_ITERATIONS, np.inf)
        search(objective, starts[:count], effort, 0, 0.0, minima)
    return count


@kernel
def _effort(points: int) -> tuple[int, int]:
    """Numbers of 4-subsets to solve and of starts to refine.

    Measured on random problems: the optimum is missed in less than 0.1 % of them.
    """
    if points < 8:
        return 35, 12
    if points < 9:
        return 12, 10
    if points < 10:
        return 8, 8
    if points < 17:
        return 5, 6
    return 3, 3


@kernel
def minimal_starts(
    points: FloatArray, rays: FloatArray, subsets: IntArray, count: int, poses: FloatArray
) -> int:
    """Write every solution of the minimal solver on the given subsets; returns their number.

    ``subsets`` (at least count, 4) holds point numbers, ``poses`` has room for 8 rows a subset.
    """
    memory = minimal_memory()
    found = 0
    for s in range(count):
        room = poses[found : found + MAX_SOLUTIONS]
        found += solve_subset(points, rays, subsets[s], memory, room)
    return found


@kernel
def choose_subsets(points: FloatArray, subsets: IntArray) -> int:
    """Fill ``subsets`` (k, 4) with 4-subsets of the points that span large volumes.

    All of them where there are no more than k, otherwise the best of a fixed sequence of draws.
    Returns how many rows were filled.
    """
    n = points.shape[0]
    wanted = subsets.shape[0]
    total = n * (n - 1) * (n - 2) * (n - 3) // 24
    draw = np.arange(4)
    if total <= wanted:
        for row in range(total):
            for k in range(4):
                subsets[row, k] = draw[k]
            next_subset(draw, n)
        return int(total)
    volumes = np.full(wanted, -1.0)
    state = np.uint64(88172645463325252)
    for _ in range(_DRAWS_PER_SUBSET * wanted):
        k = 0
        while k < 4:  # xorshift: a fixed sequence, the same for every problem
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
        volume = _volume(points, draw)
        worst = 0
        for m in range(1, wanted):
            if volumes[m] < volumes[worst]:
                worst = m
        if volume > volumes[worst]:
            volumes[worst] = volume
            for m in range(4):
                subsets[worst, m] = draw[m]
    return int(wanted)


@inlined
def _difference(points: FloatArray, i: int, j: int) -> Triple:
    return points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]


@kernel
def _volume(points: FloatArray, chosen: IntArray) -> float:
    """Six times the volume of a tetrahedron."""
    u = _difference(points, chosen[1], chosen[0])
    v = _difference(points, chosen[2], chosen[0])
    w = _difference(points, chosen[3], chosen[0])
    return abs(dot(u, cross(v, w)))


@kernel
def relief(points: FloatArray, rays: FloatArray, whitening: FloatArray) -> float:
    """Distance of points (n, 3) from their plane, in standard deviations of their image's noise.

    The root mean square distance from the plane that fits best, about: for small ones, the least
    eigenvalue of a covariance is its determinant over the sum of its principal minors.
    """
    n = points.shape[0]
    a = b = c = p = q = r = 0.0
    for i in range(n):  # centred, as the search has them
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        a += x * x
        b += y * y
        c += z * z
        p += x * y
        q += x * z
        r += y * z
    minors = a * b - p * p + a * c - q * q + b * c - r * r
    determinant = a * (b * c - r * r) - p * (p * c - q * r) + q * (p * r - b * q)
    information = 0.0
    for i in range(whitening.shape[0]):
        information += whitening[i, 0] * whitening[i, 2] / whitening.shape[0]
    if not minors > 0.0:
        return 0.0
    share = max(determinant, 0.0) / minors / (a + b + c)
    return float(np.sqrt(share * _square_spread(rays) * information))


@kernel
def rotation_starts(points: FloatArray, rays: FloatArray, poses: FloatArray) -> int:
    """Fill ``poses`` (k, 15) with poses of the unstretched model at k evenly spread rotations.

    The rotations are a super-Fibonacci spiral (Alexa, "Super-Fibonacci spirals: fast, low-
    discrepancy sampling of SO(3)", 2022). Given a rotation, the equations are linear in the
    translation. These starts need no volume, so they serve coplanar points.
    """
    wanted = poses.shape[0]
    rotation = np.empty((3, 3))
    matrix = np.empty((3, 3))
    right = np.empty(3)
    unstretched = np.ones(3)
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
        pack_pose(rotation, right, unstretched, poses[found])
        found += 1
    return found


@kernel
def widen_by_shape(
    points: FloatArray, rays: FloatArray, variances: FloatArray, whitening: FloatArray
) -> None:
    """Widen keypoints by the shape's uncertainty, ``variances`` (n,) of each coordinate.

    It is that seen from the distance at which the mean ``points`` have the size of their image.
    """
    extent, size = _square_spread(points), _square_spread(rays)
    depth = max(np.sqrt(extent * 2.0 / 3.0 / max(size, 1e-30)), _LEAST_DEPTH)
    for i in range(whitening.shape[0]):
        # The variances add up for a whitening (a, b, c) whose b is small beside a and c.
        information = (whitening[i, 0] ** 2 + whitening[i, 2] ** 2) / 2.0
        whitening[i] /= np.sqrt(1.0 + variances[i] / depth**2 * information)


@kernel
def _square_spread(rows: FloatArray) -> float:
    """Sum of the variances of the columns of a matrix."""
    total = 0.0
    for a in range(rows.shape[1]):
        mean = 0.0
        for n in range(rows.shape[0]):
            mean += rows[n, a] / rows.shape[0]
        for n in range(rows.shape[0]):
            total += (rows[n, a] - mean) ** 2 / rows.shape[0]
    return total


@kernel
def next_subset(chosen: IntArray, count: int) -> bool:
    """Step to the next subset in lexicographic order; False after the last."""
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
