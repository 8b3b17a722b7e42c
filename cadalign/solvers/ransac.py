"""Robust search: LO-RANSAC over the minimal solver.

Truncated squared errors (MSAC) rank the hypotheses; a sequential probability ratio test gives up
on bad ones after a few points (Matas, Chum, "Randomized RANSAC with sequential probability ratio
test", 2005); a new best one is optimised locally (Chum, Matas, Kittler, "Locally optimized RANSAC",
2003).
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.compile import kernel
from cadalign.solvers.constants import AP4P, OK, POSE_SIZE
from cadalign.solvers.linear import aepnp_kernel
from cadalign.solvers.minimal import MAX_SOLUTIONS, ap4p_kernel
from cadalign.solvers.objective import Objective
from cadalign.solvers.refine import refine
from cadalign.solvers.sampling import (
    StateArray,
    draw_subset,
    grow_pool,
    next_subset,
    seed_state,
    shuffle,
    start_pool,
)

_FEW_POINTS = 24  # so few are always all looked at
_RANDOM_SUPPORT = 0.02  # share of the points that a wrong hypothesis fits, at first
_REJECTION = 200.0  # likelihood ratio at which a hypothesis is given up
_LOCAL_ROUNDS = 3
_LOCAL_POINTS = 120
_LOCAL_ITERATIONS = 6
_WIDE = 2.0  # the first local round takes points within so many thresholds
_FINAL_ROUNDS = 20
_FINAL_ITERATIONS = 50


@kernel
def ransac_kernel(
    objective: Objective,
    threshold: float,
    minimal: int,
    max_iterations: int,
    min_iterations: int,
    success_prob: float,
    seed: int,
    exhaustive: bool,
    guided: bool,
    optimize: bool,
    pose: FloatArray,
    inliers: BoolArray,
) -> tuple[float, int, int]:
    """Find the pose with the lowest truncated score.

    Parameters
    ----------
    objective : Objective
        The points, by falling confidence where ``guided``; its whitening turns errors into pixels.
    threshold : float
        Largest reprojection error of an inlier [px].
    minimal : int
        AP4P or AEPNP.
    max_iterations, min_iterations, success_prob, seed
        See `cadalign.RansacOptions`.
    exhaustive : bool
        Try every subset once, in order, instead of drawing.
    guided : bool
        Draw from the first points first.
    optimize : bool
        Optimise new best hypotheses locally, and the last one on all its inliers.
    pose, inliers : (15,) float, (n,) bool
        Receive the result.

    Returns
    -------
    score : float
        Sum of squared errors, each at most the threshold's square [px^2].
    iterations, hypotheses : int
    """
    n = objective.points.shape[0]
    size = 4 if minimal == AP4P else 6
    limit = threshold * threshold
    state = np.empty(1, dtype=np.uint64)
    seed_state(seed, state)
    order = np.arange(n)
    shuffle(state, order)
    chosen = np.arange(size)
    growth = np.empty(3)
    start_pool(growth, size, n, 200_000.0)
    candidates = np.empty((MAX_SOLUTIONS, POSE_SIZE))
    trial = np.empty(POSE_SIZE)
    random_support = _RANDOM_SUPPORT
    best = np.inf
    best_support = 0
    iterations = 0
    hypotheses = 0
    needed = float(max_iterations)
    while iterations < max_iterations and (iterations < min_iterations or iterations < needed):
        if exhaustive:
            if iterations > 0 and not next_subset(chosen, n):
                break
        else:
            # The most trusted points may all lie on one side: every other sample is of all points.
            from_pool = guided and iterations % 2 == 0
            if from_pool:
                grow_pool(growth, size, n, iterations // 2)
            draw_sample(state, growth, from_pool, n, chosen)
        iterations += 1
        found = solve_sample(objective, minimal, chosen, candidates)
        hypotheses += found
        for k in range(found):
            score, support, seen = score_pose(
                objective, order, candidates[k], limit, best, best_support / n, random_support
            )
            if seen < n and seen > 0:  # given up: learn how much support a wrong one finds
                random_support = 0.98 * random_support + 0.02 * max(support / seen, 0.002)
            if not score < best:
                continue
            best = score
            best_support = support
            pose[:] = candidates[k]
            if optimize:
                trial[:] = candidates[k]
                score, support = _optimize_locally(objective, order, threshold, trial)
                if score < best:
                    best = score
                    best_support = support
                    pose[:] = trial
            ratio = best_support / n
            good = ratio**size
            if good >= 1.0:
                needed = 1.0
            elif good > 0.0:
                # A rejection test that errs once in _REJECTION costs that many more samples.
                good *= 1.0 - 1.0 / _REJECTION
                needed = np.log(1.0 - success_prob) / np.log1p(-good) * (2.0 if guided else 1.0)
    if best < np.inf and optimize:
        best = _finish(objective, threshold, order, best, pose)
    find_inliers(objective, threshold, pose, inliers)
    return best, iterations, hypotheses


@kernel
def draw_sample(
    state: StateArray, growth: FloatArray, guided: bool, count: int, chosen: IntArray
) -> None:
    """Draw a sample: of the pool's points, with its newest one, or of all."""
    pool = int(growth[0]) if guided else count
    if pool >= count:
        draw_subset(state, count, chosen)
    elif pool == chosen.shape[0]:
        for k in range(pool):
            chosen[k] = k
    else:
        draw_subset(state, pool - 1, chosen[1:])
        chosen[0] = pool - 1


@kernel
def solve_sample(
    objective: Objective, minimal: int, chosen: IntArray, candidates: FloatArray
) -> int:
    """Solve a minimal set; returns the number of hypotheses."""
    size = chosen.shape[0]
    points = np.empty((size, 3))
    rays = np.ones((size, 3))
    for k in range(size):
        for c in range(3):
            points[k, c] = objective.points[chosen[k], c]
        rays[k, 0] = objective.rays[chosen[k], 0]
        rays[k, 1] = objective.rays[chosen[k], 1]
    if minimal == AP4P:
        return ap4p_kernel(points, rays, candidates)
    rotation, translation, scale, status = aepnp_kernel(points, rays)
    if status != OK:
        return 0
    candidates[0, :9] = rotation.ravel()
    candidates[0, 9:12] = translation
    candidates[0, 12:] = scale
    return 1


@kernel
def squared_error(objective: Objective, pose: FloatArray, i: int) -> float:
    """Squared reprojection error of a point in units of the whitening; infinite behind."""
    x = objective.points[i, 0] * pose[12]
    y = objective.points[i, 1] * pose[13]
    z = objective.points[i, 2] * pose[14]
    depth = pose[6] * x + pose[7] * y + pose[8] * z + pose[11]
    if not depth > 0:
        return np.inf
    inverse = 1.0 / depth
    du = (pose[0] * x + pose[1] * y + pose[2] * z + pose[9]) * inverse - objective.rays[i, 0]
    dv = (pose[3] * x + pose[4] * y + pose[5] * z + pose[10]) * inverse - objective.rays[i, 1]
    w = i if objective.whitening.shape[0] > 1 else 0
    ru = objective.whitening[w, 0] * du + objective.whitening[w, 1] * dv
    rv = objective.whitening[w, 2] * dv
    return float(ru * ru + rv * rv)


@kernel
def score_pose(
    objective: Objective,
    order: IntArray,
    pose: FloatArray,
    limit: float,
    best: float,
    inlier_ratio: float,
    random_support: float,
) -> tuple[float, int, int]:
    """Truncated score, number of inliers, and how many points were looked at.

    Gives up, with an infinite score, once the score exceeds the best one, or once the points seen
    so far are much likelier under a wrong model than under one as good as the best.
    """
    n = order.shape[0]
    few = n <= _FEW_POINTS or inlier_ratio <= 1.5 * random_support
    miss = 1.0 if few else (1.0 - random_support) / (1.0 - min(inlier_ratio, 0.99))
    hit = 1.0 if few else random_support / inlier_ratio
    score = 0.0
    support = 0
    ratio = 1.0
    for k in range(n):
        square = squared_error(objective, pose, order[k])
        if square < limit:
            score += square
            support += 1
            ratio *= hit
        else:
            score += limit
            ratio *= miss
        if score >= best or ratio > _REJECTION:
            return np.inf, support, k + 1
    return score, support, n


@kernel
def _optimize_locally(
    objective: Objective, order: IntArray, threshold: float, pose: FloatArray
) -> tuple[float, int]:
    """Refine a pose on its inliers, first the wider ones; returns its score and support."""
    for r in range(_LOCAL_ROUNDS):
        factor = _WIDE + (1.0 - _WIDE) * r / (_LOCAL_ROUNDS - 1)
        some = inliers_of(objective, order, factor * threshold, pose, _LOCAL_POINTS)
        if some.points.shape[0] < 5:
            break
        refine(some, _LOCAL_ITERATIONS, pose)
    limit = threshold * threshold
    score, support, _ = score_pose(objective, order, pose, limit, np.inf, 0.0, 1.0)
    return score, support


@kernel
def inliers_of(
    objective: Objective, order: IntArray, threshold: float, pose: FloatArray, most: int
) -> Objective:
    """The objective of the first ``most`` points that lie within a threshold."""
    limit = threshold * threshold
    each = objective.whitening.shape[0] > 1
    room = min(most, order.shape[0])
    points = np.empty((room, 3))
    rays = np.empty((room, 2))
    whitening = np.empty((room if each else 1, 3))
    whitening[0] = objective.whitening[0]
    count = 0
    for k in range(order.shape[0]):
        i = order[k]
        if count < room and squared_error(objective, pose, i) < limit:
            points[count] = objective.points[i]
            rays[count] = objective.rays[i]
            if each:
                whitening[count] = objective.whitening[i]
            count += 1
    return Objective(
        points[:count],
        rays[:count],
        whitening[:count] if each else whitening,
        objective.loss,
        objective.loss_scale,
        objective.prior_weight,
        objective.free,
    )


@kernel
def _finish(
    objective: Objective, threshold: float, order: IntArray, best: float, pose: FloatArray
) -> float:
    """Refine on all inliers until they don't change any more; returns the score."""
    trial = pose.copy()
    support = -1
    limit = threshold * threshold
    for _ in range(_FINAL_ROUNDS):
        some = inliers_of(objective, order, threshold, trial, order.shape[0])
        if some.points.shape[0] < 4:
            return best
        refine(some, _FINAL_ITERATIONS, trial)
        score, inside, _ = score_pose(objective, order, trial, limit, np.inf, 0.0, 1.0)
        if score > best * (1.0 + 1e-9):
            return best
        pose[:] = trial
        if inside == support and score >= best * (1.0 - 1e-9):
            return score
        best = min(best, score)
        support = inside
    return best


@kernel
def find_inliers(
    objective: Objective, threshold: float, pose: FloatArray, inliers: BoolArray
) -> None:
    """Say which points lie within the threshold."""
    limit = threshold * threshold
    for i in range(inliers.shape[0]):
        inliers[i] = squared_error(objective, pose, i) < limit
