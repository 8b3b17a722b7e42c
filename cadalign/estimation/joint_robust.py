"""Inliers of a joint estimate: keypoints and depths that one pose and one shape explain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray, read_only
from cadalign.estimation.options import MINIMAL_SOLVERS, RansacOptions
from cadalign.estimation.starts import Start, Starts, in_rig, starts_of
from cadalign.solvers.constants import CAUCHY, LINEAR, SAMPLE_SIZES
from cadalign.solvers.joint.evidence import (
    Evidence,
    State,
    kept_rows,
    log_focals_of,
    points_of,
    seen_in_cameras,
)
from cadalign.solvers.joint.search import keypoints_of, search_joint
from cadalign.solvers.ransac import rigid_hypotheses

OUTLIER_COST = 5.0
"""Cost of a keypoint that is left out, beyond the square of its threshold."""
_WIDENING = 3.0  # standard deviations of a displacement that a threshold allows for
_NEAREST = 1e-9  # depth
_INLIER_RATIO = 0.4
_LEAST_CONFIDENCE = 0.01  # over the largest: none is never drawn
_LIMIT = 9.0  # squared whitened residual of a keypoint that speaks for a hypothesis
_REFINED = 8
_ROUNDS = 5
_KEPT = 4  # minima of the robust search that are settled on their inliers
_LEAST_INLIERS = 3


class JointConsensus(NamedTuple):
    """Sightings (N,) that agree, the estimate from them, and its score."""

    inliers: BoolArray
    evidence: Evidence
    state: State
    cost: float
    score: float


def robust_starts(
    evidence: Evidence,
    ransac: RansacOptions,
    scores: Sequence[FloatArray | None],
    init: Start | None = None,
) -> Starts:
    """Starts under a robust loss, and those of samples, drawn by ``scores`` (n_v,) of views."""
    starts = starts_of(under_cauchy(evidence), init)
    if evidence.rig.pose.max() > 0:
        return starts
    samples = np.array(
        [
            in_rig(pose, camera)
            for view, camera in enumerate(evidence.rig.cam_from_rig)
            for pose in _hypotheses(evidence, view, ransac, scores[view])
        ]
    ).reshape(-1, 12)
    count, focals = len(samples), starts.log_focals.shape[1]
    return Starts(
        np.concatenate([starts.poses, samples[:, None]]),
        np.concatenate([starts.log_focals, np.zeros((count, focals))]),
        np.concatenate([starts.log_scales, np.zeros((count, 3))]),
    )


def robust_minima(
    evidence: Evidence, starts: Starts, threshold: FloatArray, *, settles: bool, projects: bool
) -> tuple[list[JointConsensus], int]:
    """Estimates that most keypoints support, the best first, with the iterations they took.

    Each of the starts is refined under a robust loss, then on its inliers alone, once, or where it
    ``settles`` until these don't change. Whitened residuals of inliers are below the ``threshold``
    (N,). A keypoint that is left out costs as much as one at its threshold, and the logarithm that
    one more keypoint would add (`OUTLIER_COST`).

    Thresholds are widened by what each point's own displacement ``projects`` to: the residual of a
    point that is left out has all of it.
    """
    minima, iterations = search_joint(under_cauchy(evidence), *starts)
    found = []
    for state in minima.states[:_KEPT]:
        limits = np.hypot(threshold, _WIDENING * _projected(evidence, state) * projects)
        refined = _settle(evidence, state, limits, _ROUNDS if settles else 1)
        if refined is not None:
            found.append(refined)
    found.sort(key=lambda consensus: consensus.score)
    return found, iterations


def _settle(
    evidence: Evidence, state: State, threshold: FloatArray, rounds: int
) -> JointConsensus | None:
    best: JointConsensus | None = None
    inliers = whitened_lengths(evidence, state) < threshold
    for _ in range(rounds):
        if inliers.sum() < _LEAST_INLIERS:
            break
        some = with_sightings(evidence, inliers)
        start = state.poses[None], state.log_focals[None], state.log_scales[None]
        minima, _ = search_joint(some, *start)
        if not minima.states:
            break
        state = minima.states[0]
        left_out = threshold[~inliers] ** 2 + OUTLIER_COST
        score = float(minima.scores[0]) + float(left_out.sum())
        if best is None or score < best.score:
            best = JointConsensus(inliers, some, state, float(minima.costs[0]), score)
        again = whitened_lengths(evidence, state) < threshold
        if (again == inliers).all():
            break
        inliers = again
    return best


def whitened_lengths(evidence: Evidence, state: State) -> FloatArray:
    """Lengths (N,) of `whitened_residuals`."""
    return np.asarray(np.hypot(*whitened_residuals(evidence, state).T))


def whitened_residuals(evidence: Evidence, state: State) -> FloatArray:
    """Whitened residuals (N, 2) in the image; infinite behind a camera."""
    sightings = evidence.sightings
    points = points_of(evidence.shape, state)[sightings.point]
    seen = seen_in_cameras(evidence, state.poses, points, sightings.image)
    log_ratio = log_focals_of(evidence, state)[sightings.image][:, None]
    error = np.exp(log_ratio) * seen[:, :2] / seen[:, 2:] - sightings.rays
    error -= log_ratio * sightings.slopes
    a, b, c = sightings.whitening.T
    whitened = np.column_stack([a * error[:, 0] + b * error[:, 1], c * error[:, 1]])
    return np.where(seen[:, 2:] > 0, whitened, np.inf)


def _projected(evidence: Evidence, state: State) -> FloatArray:
    """Whitened standard deviations (N,) that the points' displacements project to."""
    sightings, shape = evidence.sightings, evidence.shape
    points = points_of(shape, state)[sightings.point]
    depths = seen_in_cameras(evidence, state.poses, points, sightings.image)[:, 2]
    root = np.sqrt(sightings.whitening[:, 0] * sightings.whitening[:, 2])
    scale = np.exp(state.log_scales.mean())
    return np.asarray(root * scale * shape.spread[sightings.point] / np.maximum(depths, _NEAREST))


def under_cauchy(evidence: Evidence) -> Evidence:
    """The same evidence under Cauchy's loss."""
    old = evidence.sightings
    return evidence._replace(sightings=old._replace(loss=np.full(len(old.loss), CAUCHY)))


def with_whitening_times(factor: float, chosen: BoolArray, evidence: Evidence) -> Evidence:
    """The evidence with the whitening of ``chosen`` sightings (N,) times a factor."""
    old = evidence.sightings
    whitening = np.where(chosen[:, None], factor, 1.0) * old.whitening
    return evidence._replace(sightings=old._replace(whitening=whitening))


def with_sightings(evidence: Evidence, kept: BoolArray | IntArray) -> Evidence:
    """The evidence of some sightings."""
    return evidence._replace(sightings=kept_rows(evidence.sightings, kept))


def _hypotheses(
    evidence: Evidence, view: int, ransac: RansacOptions, scores: FloatArray | None
) -> FloatArray:
    """Camera poses (S, 12) from small samples of one view's keypoints, the best supported first."""
    given = keypoints_of(evidence, view)._replace(loss=LINEAR)
    count, size = len(given.points), SAMPLE_SIZES[MINIMAL_SOLVERS[ransac.minimal]]
    if count < size:
        return np.empty((0, 12))
    poses, supports = rigid_hypotheses(given, _samples(count, size, ransac, scores), _LIMIT)
    order = np.argsort(supports)[:_REFINED]
    return poses[order[np.isfinite(supports[order])], :12]


def _samples(count: int, size: int, ransac: RansacOptions, scores: FloatArray | None) -> IntArray:
    """Samples (S, size): all, or so many that of 40 % inliers one is pure; half drawn by scores."""
    without = math.log(1 - ransac.success_prob) / math.log1p(-(_INLIER_RATIO**size))
    wanted = min(max(math.ceil(without), ransac.min_iterations), ransac.max_iterations)
    if math.comb(count, size) <= wanted:
        return np.array(list(combinations(range(count), size)))
    told = None if scores is None or not scores.sum() > 0 else tuple(scores.tolist())
    return _random_samples(count, size, wanted, ransac.seed, told)


@lru_cache(maxsize=16)  # the same at every focal length, and with every mistake undone
def _random_samples(
    count: int, size: int, wanted: int, seed: int, scores: tuple[float, ...] | None
) -> IntArray:
    rng = np.random.default_rng(seed)
    weights = None
    if scores is not None:
        weights = np.array(scores) + _LEAST_CONFIDENCE * max(scores)
        weights = weights / weights.sum()
    draws = [
        rng.choice(count, size, replace=False, p=weights if k % 2 else None) for k in range(wanted)
    ]
    return read_only(np.unique(np.sort(draws, axis=1), axis=0))
