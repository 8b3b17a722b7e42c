"""Robust estimation by LO-RANSAC with a minimal solver.

Truncated squared errors (MSAC) rank the hypotheses. A sequential probability ratio test rejects bad
ones after a few points (Matas, Chum, "Randomized RANSAC with sequential probability ratio test",
2005). Each new best hypothesis is optimised locally (Chum, Matas, Kittler, "Locally optimized
RANSAC", 2003).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.compile import kernel
from cadalign.solvers.alignment import Objective, replace_keypoints
from cadalign.solvers.constants import AP4P, OK, POSE_SIZE, UNKNOWNS, ScalePrior
from cadalign.solvers.evidence import KeypointEvidence, squared_error, take_keypoints
from cadalign.solvers.linalg import copy_into
from cadalign.solvers.linear import aepnp_kernel
from cadalign.solvers.minimal import (
    MAX_POSES,
    MAX_SOLUTIONS,
    minimal_memory,
    p3p_kernel,
    p3p_memory,
    solve_subset,
)
from cadalign.solvers.projection import scalars_of
from cadalign.solvers.search import refine
from cadalign.solvers.starts import next_subset

_FEW_POINTS = 24  # up to so many points, the ratio test rejects nothing
_RANDOM_SUPPORT = 0.02  # initial estimate of the inlier ratio of a wrong hypothesis
_LEAST_SUPPORT = 0.03  # least expected inlier ratio of a correct hypothesis
_REJECTION = 200.0  # likelihood ratio at which a hypothesis is rejected
_LOCAL_POINTS = 120
_LOCAL_ITERATIONS = 6
_LOCAL_ROUNDS = 3
_FIRST_FACTOR = 2.0  # the first local round uses a wider threshold
_LEAST_POINTS = 5
_FINAL_ROUNDS = 20
_FINAL_ITERATIONS = 50
_RIGID_ITERATIONS = 4
_SHARES = 1 << 31  # resolution of random numbers in [0, 1)


class Settings(NamedTuple):
    """Fields of `cadalign.RansacOptions`; an ``exhaustive`` search tries every subset once."""

    threshold: float
    minimal: int
    size: int
    max_iterations: int
    min_iterations: int
    success_prob: float
    seed: int
    exhaustive: bool
    optimize: bool


@kernel
def ransac_kernel(
    objective: Objective,
    confidence: FloatArray,
    settings: Settings,
    pose: FloatArray,
    inliers: BoolArray,
) -> tuple[float, int, int]:
    """Write the pose (15,) with the lowest truncated score [px^2], and its inliers (n,).

    Returns the score and the numbers of iterations and hypotheses. The objective's points must be
    in random order. ``confidence`` (n,) holds cumulative probabilities for every other sample, or
    is empty.
    """
    keypoints = objective.keypoints
    n = keypoints.points.shape[0]
    size = settings.size
    limit = settings.threshold * settings.threshold
    state = np.empty(1, dtype=np.uint64)
    seed_state(settings.seed, state)
    chosen = np.arange(size)
    candidates = np.empty((MAX_SOLUTIONS, POSE_SIZE))
    memory = minimal_memory()
    trial = np.empty(POSE_SIZE)
    random_support = _RANDOM_SUPPORT
    best = np.inf
    best_support = 0
    iterations = 0
    hypotheses = 0
    needed = float(settings.max_iterations)
    while iterations < settings.max_iterations and (
        iterations < settings.min_iterations or iterations < needed
    ):
        if settings.exhaustive:
            if iterations > 0 and not next_subset(chosen, n):
                break
        else:
            # Confident points may all lie on one side, so every other sample ignores confidence.
            draw_subset(state, n, confidence if iterations % 2 == 0 else confidence[:0], chosen)
        iterations += 1
        found = _solve_sample(keypoints, settings.minimal, chosen, memory, candidates)
        hypotheses += found
        for k in range(found):
            share = best_support / n
            score, support, seen = score_pose(
                keypoints, candidates[k], limit, best, share, random_support
            )
            if seen < n and seen > 0:  # rejected: update the inlier ratio of wrong ones
                random_support = 0.98 * random_support + 0.02 * max(support / seen, 0.002)
            if not score < best:
                continue
            best, best_support = score, support
            copy_into(pose, candidates[k])
            if settings.optimize:
                copy_into(trial, candidates[k])
                _optimize_locally(objective, settings.threshold, trial)
                score, support, _ = score_pose(keypoints, trial, limit, np.inf, 0.0, 1.0)
                if score < best:
                    best, best_support = score, support
                    copy_into(pose, trial)
            if best_support > 0:
                needed = _needed_samples(best_support / n, settings)
                needed *= 2.0 if confidence.shape[0] > 0 else 1.0
    if best < np.inf and settings.optimize:
        best = _refine_inliers(objective, settings.threshold, best, pose)
    scalars = scalars_of(pose)
    for i in range(n):
        inliers[i] = squared_error(keypoints, scalars, i) < limit
    return best, iterations, hypotheses


@kernel
def _needed_samples(inlier_ratio: float, settings: Settings) -> float:
    """Number of samples that include one without outliers, with the requested probability."""
    good = inlier_ratio**settings.size
    if good >= 1.0:
        return 1.0
    # The test rejects one good hypothesis in _REJECTION.
    good *= 1.0 - 1.0 / _REJECTION
    return float(np.log(1.0 - settings.success_prob) / np.log1p(-good))


@kernel
def _solve_sample(
    keypoints: KeypointEvidence,
    minimal: int,
    chosen: IntArray,
    memory: FloatArray,
    candidates: FloatArray,
) -> int:
    if minimal == AP4P:
        return solve_subset(keypoints.points, keypoints.rays, chosen, memory, candidates)
    some = take_keypoints(keypoints, chosen)
    return 1 if aepnp_kernel(some.points, some.rays, candidates[0]) == OK else 0


@kernel
def score_pose(
    keypoints: KeypointEvidence,
    pose: FloatArray,
    limit: float,
    best: float,
    inlier_ratio: float,
    random_support: float,
) -> tuple[float, int, int]:
    """Truncated score, number of inliers, and number of points that were scored.

    Stops with an infinite score once the score exceeds ``best``, or once the points so far are much
    likelier under a wrong hypothesis than under one as good as the best.
    """
    n = keypoints.points.shape[0]
    few = n <= _FEW_POINTS
    # Before a good hypothesis is found, the expected ratio must exceed chance.
    sought = min(max(inlier_ratio, _LEAST_SUPPORT, 1.5 * random_support), 0.99)
    miss = 1.0 if few else (1.0 - random_support) / (1.0 - sought)
    hit = 1.0 if few else random_support / sought
    scalars = scalars_of(pose)
    score = 0.0
    support = 0
    ratio = 1.0
    for k in range(n):
        square = squared_error(keypoints, scalars, k)
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
def _optimize_locally(objective: Objective, threshold: float, pose: FloatArray) -> None:
    for r in range(_LOCAL_ROUNDS):
        factor = _FIRST_FACTOR + (1.0 - _FIRST_FACTOR) * r / (_LOCAL_ROUNDS - 1)
        some = _inliers_of(objective, factor * threshold, pose, _LOCAL_POINTS)
        if some.keypoints.points.shape[0] < _LEAST_POINTS:
            break
        refine(some, _LOCAL_ITERATIONS, pose)


@kernel
def _inliers_of(objective: Objective, threshold: float, pose: FloatArray, most: int) -> Objective:
    """Restrict the objective to the first ``most`` points with errors below the threshold."""
    limit = threshold * threshold
    scalars = scalars_of(pose)
    n = objective.keypoints.points.shape[0]
    chosen = np.empty(min(most, n), dtype=np.int64)
    count = 0
    for k in range(n):
        if count == chosen.shape[0]:
            break
        if squared_error(objective.keypoints, scalars, k) < limit:
            chosen[count] = k
            count += 1
    return replace_keypoints(objective, take_keypoints(objective.keypoints, chosen[:count]))


@kernel
def _refine_inliers(objective: Objective, threshold: float, best: float, pose: FloatArray) -> float:
    """Refine on all inliers until they are stable; returns the score."""
    trial = pose.copy()
    support = -1
    limit = threshold * threshold
    for _ in range(_FINAL_ROUNDS):
        some = _inliers_of(objective, threshold, trial, objective.keypoints.points.shape[0])
        if some.keypoints.points.shape[0] < 4:
            return best
        refine(some, _FINAL_ITERATIONS, trial)
        score, inside, _ = score_pose(objective.keypoints, trial, limit, np.inf, 0.0, 1.0)
        if score > best * (1.0 + 1e-9):
            return best
        copy_into(pose, trial)
        if inside == support and score >= best * (1.0 - 1e-9):
            return score
        best = min(best, score)
        support = inside
    return best


# Random samples ----------------------------------------------------------------------------------

StateArray = npt.NDArray[np.uint64]


@kernel
def seed_state(seed: int, state: StateArray) -> None:
    """Seed the random state (1,) by one step of SplitMix64; the state is never zero."""
    z = np.uint64(seed) + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    state[0] = z | np.uint64(1)


@kernel
def draw_below(state: StateArray, bound: int) -> int:
    """Draw an integer from 0 to ``bound - 1`` by xorshift64*."""
    x = state[0]
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    state[0] = x
    return int(np.int64(((x * np.uint64(0x2545F4914F6CDD1D)) >> np.uint64(33)) % np.uint64(bound)))


@kernel
def draw_subset(state: StateArray, count: int, confidence: FloatArray, chosen: IntArray) -> None:
    """Draw distinct indices below ``count``, uniformly or by cumulative confidence (n,)."""
    k = 0
    while k < chosen.shape[0]:
        if confidence.shape[0] == 0:
            index = draw_below(state, count)
        else:
            share, index = draw_below(state, _SHARES) / _SHARES, 0
            while index < count - 1 and confidence[index] < share:
                index += 1
        fresh = True
        for m in range(k):
            fresh = fresh and chosen[m] != index
        if fresh:
            chosen[k] = index
            k += 1


@kernel
def rigid_hypotheses(
    keypoints: KeypointEvidence, draws: IntArray, limit: float
) -> tuple[FloatArray, FloatArray]:
    """Poses (S, 15) from samples ``draws`` (S, k), and truncated scores (S,) on all points."""
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
            cost, _, _ = refine(objective, _RIGID_ITERATIONS, solutions[k])
            if cost < least:
                least = cost
                copy_into(poses[s], solutions[k])
        if least < np.inf:
            scores[s] = score_pose(keypoints, poses[s], limit, np.inf, 0.0, 1.0)[0]
    return poses, scores
