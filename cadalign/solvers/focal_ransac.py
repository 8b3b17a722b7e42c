"""Robust search where the focal length is unknown: the minimal solver at several focal lengths.

Every sample of 4 points is solved at each focal length of a grid; a new best hypothesis is
optimised locally with its focal length, so the grid need not be fine. Otherwise as in
`cadalign.solvers.ransac`.
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.compile import kernel
from cadalign.solvers.constants import AP4P, POSE_SIZE, SAMPLE_SIZES
from cadalign.solvers.focal import at_focal, refine_focal
from cadalign.solvers.minimal import MAX_SOLUTIONS
from cadalign.solvers.objective import Objective
from cadalign.solvers.ransac import (
    draw_sample,
    find_inliers,
    inliers_of,
    score_pose,
    solve_sample,
)
from cadalign.solvers.sampling import grow_pool, next_subset, seed_state, shuffle, start_pool

_RANDOM_SUPPORT = 0.02  # share of the points that a wrong hypothesis fits, at first
_REJECTION = 200.0
_LOCAL_ROUNDS = 4
_LOCAL_POINTS = 120
_WIDE = 3.0  # the first local round takes points within so many thresholds
_LEAST_POINTS = 6
_LOCAL_STEPS = 8


@kernel
def ransac_focal_kernel(
    objective: Objective,
    rays: FloatArray,
    whitening: FloatArray,
    log_focals: FloatArray,
    low: float,
    high: float,
    prior_center: float,
    prior_weight: float,
    threshold: float,
    max_iterations: int,
    min_iterations: int,
    success_prob: float,
    seed: int,
    exhaustive: bool,
    guided: bool,
    optimize: bool,
    pose: FloatArray,
    inliers: BoolArray,
) -> tuple[float, float, int, int]:
    """Find the pose and focal length with the lowest truncated score.

    Parameters
    ----------
    objective : Objective
        The points, loss and prior; its rays and weights are not used.
    rays, whitening : (k, n, 2), (k, 1 or n, 3) float
        The points' rays at each focal length, and what turns their errors into pixels.
    log_focals : (k,) float
        The logarithms of the focal lengths to try.
    low, high : float
        Bounds on the focal length's logarithm.
    prior_center, prior_weight : float
        Mean and inverse variance of the prior on that logarithm; the weight 0 for none.
    threshold, max_iterations, min_iterations, success_prob, seed, exhaustive, guided, optimize
        As for `cadalign.solvers.ransac.ransac_kernel`.
    pose, inliers : (15,) float, (n,) bool
        Receive the result.

    Returns
    -------
    score : float
        Sum of squared errors, each at most the threshold's square [px^2].
    log_focal : float
    iterations, hypotheses : int
    """
    n = objective.points.shape[0]
    size = SAMPLE_SIZES[AP4P]
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
    best_focal = log_focals[0]
    best_view = view_at(objective, rays[0], whitening[0])
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
        for f in range(log_focals.shape[0]):
            view = view_at(objective, rays[f], whitening[f])
            found = solve_sample(view, AP4P, chosen, candidates)
            hypotheses += found
            for k in range(found):
                score, support, seen = score_pose(
                    view, order, candidates[k], limit, best, best_support / n, random_support
                )
                if seen < n and seen > 0:
                    random_support = 0.98 * random_support + 0.02 * max(support / seen, 0.002)
                if not score < best:
                    continue
                best, best_support, best_focal, best_view = score, support, log_focals[f], view
                pose[:] = candidates[k]
                if optimize:
                    trial[:] = candidates[k]
                    moved = _optimize_locally(
                        view,
                        order,
                        threshold,
                        low - log_focals[f],
                        high - log_focals[f],
                        prior_center - log_focals[f],
                        prior_weight,
                        trial,
                    )
                    there = at_focal(view, np.empty((0, 2)), moved)
                    score, support, _ = score_pose(there, order, trial, limit, np.inf, 0.0, 1.0)
                    if score < best:
                        best, best_support, best_view = score, support, there
                        best_focal = log_focals[f] + moved
                        pose[:] = trial
                good = (best_support / n) ** size * (1.0 - 1.0 / _REJECTION)
                if good > 0.0:
                    needed = np.log(1.0 - success_prob) / np.log1p(-good) * (2.0 if guided else 1.0)
    find_inliers(best_view, threshold, pose, inliers)
    return best, best_focal, iterations, hypotheses


@kernel
def view_at(objective: Objective, rays: FloatArray, whitening: FloatArray) -> Objective:
    """The objective with other rays and weights."""
    return Objective(
        objective.points,
        rays,
        whitening,
        objective.loss,
        objective.loss_scale,
        objective.prior_weight,
        objective.free,
    )


@kernel
def _optimize_locally(
    view: Objective,
    order: IntArray,
    threshold: float,
    low: float,
    high: float,
    prior_center: float,
    prior_weight: float,
    pose: FloatArray,
) -> float:
    """Refine pose and focal length on the inliers, first the wider ones; returns the log ratio."""
    log_ratio = 0.0
    for r in range(_LOCAL_ROUNDS):
        factor = _WIDE + (1.0 - _WIDE) * r / (_LOCAL_ROUNDS - 1)
        here = at_focal(view, np.empty((0, 2)), log_ratio)
        some = inliers_of(here, order, factor * threshold, pose, _LOCAL_POINTS)
        if some.points.shape[0] < _LEAST_POINTS:
            break
        _, moved, _ = refine_focal(
            some,
            np.empty((0, 2)),
            prior_center - log_ratio,
            prior_weight,
            low - log_ratio,
            high - log_ratio,
            _LOCAL_STEPS,
            pose,
            0.0,
        )
        log_ratio += moved
    return log_ratio
