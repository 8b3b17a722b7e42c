"""Maximum-likelihood alignment of one view's keypoints, by a search from several starts."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import kernel
from cadalign.solvers.alignment import (
    Objective,
    center_and_unit,
    covariance_of,
    replace_keypoints,
    replace_points,
)
from cadalign.solvers.constants import (
    DEGENERATE,
    LINEAR,
    NOT_FOUND,
    OK,
    OUT_OF_RANGE,
    POSE_SIZE,
    TOO_FEW,
    UNKNOWNS,
    ScalePrior,
)
from cadalign.solvers.evidence import KeypointEvidence, take_keypoints
from cadalign.solvers.linalg import copy_into
from cadalign.solvers.linear import aepnp_kernel
from cadalign.solvers.minimal import MAX_POSES, MAX_SOLUTIONS, p3p_kernel, p3p_memory, reflect
from cadalign.solvers.search import Effort, Minima, search
from cadalign.solvers.starts import choose_subsets, minimal_starts, relief, rotation_starts
from cadalign.solvers.unknowns import orthonormalize, uncenter

MAX_MINIMA = 12
_COARSE_POINTS = 48  # points of the first search; all points refine its minima
_GRID_ROTATIONS = 96
_GRID_REFINED = 20
_PROBE_ITERATIONS = 6
_TRIANGLES = 6
_RIGID_REFINED = 6
_MAX_ITERATIONS = 200
_LEAST_RELIEF = 3.0  # below it, depths of subsets are lost in noise: a grid of rotations helps
_UNLIKELY = 40.0  # excess cost, per unit variance, at which a coarse minimum is dropped


def rigid_flag(loss: int, free: FloatArray) -> bool | None:
    """True for squared errors without stretch, otherwise None: a flag that specialises kernels."""
    return True if loss == LINEAR and free[6] == free[7] == 0.0 else None


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
    rigid: bool | None,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray, IntArray]:
    """Find the optimum of B problems; problem b has the rows ``offsets[b]`` to ``offsets[b + 1]``.

    ``loss_scale`` (B,) and the ``prior_weight`` (B,) of a `ScalePrior` are in units of the
    whitening's sigma. Returns poses (B, MAX_MINIMA, 15) and costs (B, MAX_MINIMA) of the minima,
    the covariance of the best (B, 8, 8), statuses (B,), and info (B, 4): the numbers of minima,
    iterations and hypotheses, and the index of an undetermined unknown, or -1.
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
        info[b, 0], info[b, 1], info[b, 2], info[b, 3] = _solve_one(
            objective, rigid, poses[b], costs[b], covariances[b]
        )
        if info[b, 3] >= 0:
            statuses[b] = DEGENERATE
        elif info[b, 0] == 0:
            statuses[b] = NOT_FOUND
        elif not np.isfinite(covariances[b]).all():
            statuses[b] = OUT_OF_RANGE
    return poses, costs, covariances, statuses, info


@kernel
def _solve_one(
    objective: Objective,
    rigid: bool | None,
    poses: FloatArray,
    costs: FloatArray,
    covariance: FloatArray,
) -> tuple[int, int, int, int]:
    """Write the minima of one problem, best first, and its covariance; returns the ``info`` row."""
    points = objective.keypoints.points
    center, unit = center_and_unit(points)
    if not unit > 0:
        return 0, 0, 0, 0
    local = replace_points(objective, (points - center) / unit)
    counts = np.zeros(2, dtype=np.int64)
    found = Minima(poses, costs, costs.copy(), np.zeros(MAX_MINIMA, dtype=np.int64), counts)
    hypotheses = _search_minima(local, rigid, found)
    minima, iterations = int(counts[0]), int(counts[1])
    if minima == 0:
        return 0, iterations, hypotheses, -1
    for k in range(minima):
        orthonormalize(poses[k])
        uncenter(poses[k], center, unit)
    return minima, iterations, hypotheses, covariance_of(objective, poses[0], covariance)


@kernel
def _search_minima(objective: Objective, rigid: bool | None, minima: Minima) -> int:
    """Find the minima, at first on a subset of many points; returns the number of starts."""
    linear = np.empty(POSE_SIZE)
    keypoints = objective.keypoints
    is_solved = aepnp_kernel(keypoints.points, keypoints.rays, linear) == OK
    n = keypoints.points.shape[0]
    if n <= _COARSE_POINTS:
        return _search_from_all_starts(objective, rigid, linear, is_solved, minima)
    chosen = np.arange(_COARSE_POINTS) * n // _COARSE_POINTS  # evenly spaced indices
    coarse = replace_keypoints(objective, take_keypoints(keypoints, chosen))
    hypotheses = _search_from_all_starts(coarse, rigid, linear, is_solved, minima)
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
    if minima.counts[0] == 0 and is_solved:  # strong noise can leave the subset no minimum
        copy_into(starts[0], linear)
        search(objective, starts[:1], everything, 0, 0.0, minima)
    return hypotheses


@kernel
def _search_from_all_starts(
    objective: Objective,
    rigid: bool | None,
    linear: FloatArray,
    is_solved: bool,
    minima: Minima,
) -> int:
    """Refine the likeliest starts, including the pose ``linear``; returns the number of starts."""
    if rigid is not None:
        return _search_rigid(objective, minima)
    points, rays, free = objective.keypoints.points, objective.keypoints.rays, objective.free
    subset_count, refined = _effort(points.shape[0], objective.keypoints.loss)
    starts = np.empty((subset_count * MAX_SOLUTIONS + 1 + _GRID_ROTATIONS, POSE_SIZE))
    count = 0
    if points.shape[0] >= 4:
        subsets = np.empty((subset_count, 4), dtype=np.int64)
        chosen = choose_subsets(points, subsets)
        count = minimal_starts(points, rays, subsets, chosen, starts)
    if is_solved:
        copy_into(starts[count], linear)
        count += 1
    # A grid of rotations helps with nearly coplanar points, few subsets, and little stretch.
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
        _search_starts(objective, starts[:count], refined, minima)
    return count


@kernel
def _search_rigid(objective: Objective, minima: Minima) -> int:
    """Search without stretch, from a few triangles and the reflection of the optimum."""
    points, rays = objective.keypoints.points, objective.keypoints.rays
    triangles = np.empty((_TRIANGLES, 3), dtype=np.int64)
    starts = np.empty((max(_TRIANGLES * MAX_POSES, _GRID_ROTATIONS), POSE_SIZE))
    memory = p3p_memory()
    count = 0
    for s in range(choose_subsets(points, triangles)):
        count += p3p_kernel(points, rays, triangles[s], memory, starts[count:])
    _search_starts(objective, starts[:count], _RIGID_REFINED, minima)
    if minima.counts[0] > 0:
        reflected = np.empty((1, POSE_SIZE))
        reflect(points, minima.states[0], reflected[0])
        _search_starts(objective, reflected, 1, minima)
        return count + 1
    found = rotation_starts(points, rays, starts[:_GRID_ROTATIONS])
    _search_starts(objective, starts[:found], _GRID_REFINED, minima)
    return count + found


@kernel
def _search_starts(objective: Objective, starts: FloatArray, refined: int, minima: Minima) -> None:
    effort = Effort(refined, _PROBE_ITERATIONS, _MAX_ITERATIONS, np.inf)
    search(objective, starts, effort, 0, 0.0, minima)


@kernel
def _effort(points: int, loss: int) -> tuple[int, int]:
    """Numbers of 4-subsets to solve and of starts to refine.

    Chosen so that less than 0.1 % of random problems miss the optimum. Robust losses need more
    subsets, since few of them are free of outliers: Cauchy's loss misses less than 0.3 % with 2
    outliers among 10 keypoints, and 4 % with 3.
    """
    if loss != LINEAR:
        return (70, 12) if points < 17 else (12, 8)
    if points < 8:
        return 35, 12
    if points < 9:
        return 12, 10
    if points < 10:
        return 8, 8
    if points < 17:
        return 5, 6
    return 3, 3
