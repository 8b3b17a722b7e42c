"""Second stage of an estimate: search minima over shape components, focal lengths and noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.estimates import mean_state
from cadalign.estimation.options import RansacOptions
from cadalign.estimation.prior import Lenses, redundancy_of
from cadalign.estimation.problem import Inits, Problem
from cadalign.estimation.problems import no_redundancy_error
from cadalign.estimation.propose import add_cauchy_loss, propose
from cadalign.estimation.starts import Starts
from cadalign.estimation.uncertainty.posterior import widening_of
from cadalign.estimation.uncertainty.residuals import Support, area_of, check_support
from cadalign.estimation.view import View
from cadalign.solvers.joint.evidence import (
    Evidence,
    State,
    kept_rows,
    log_focals_of,
    points_of,
    seen_in_cameras,
)
from cadalign.solvers.joint.search import refine_joint, score_state, search_joint

_MOST_FREE = 2  # scales that keypoints determine, not the size
_OUTLIER_COST = 5.0  # of an outlier, beyond its squared threshold
_WIDENING = 3.0  # of a threshold, in standard deviations of a displacement
_NEAREST = 1e-9  # least depth
_INLIER_ROUNDS = 5
_KEPT = 4  # minima of the robust search that are refined on their inliers
_LEAST_INLIERS = 3

_NOISES = np.geomspace(0.1, 100.0, 10)  # [px]
_USUAL, _USUAL_LOG_SIGMA = 2.0, 1.5  # [px], prior: with few keypoints, a free shape fits any noise
_NOISE_ROUNDS = 3  # of search and noise estimate
_NOISE_TOLERANCE = 0.2  # change of the log noise that requires another search
_NOISE_PRECISION = 0.01  # of the log noise
_NOISE_ITERATIONS = 30
_GOLDEN = (math.sqrt(5) - 1) / 2


class Minimum(NamedTuple):
    """A minimum for one component, relative to ``lenses``; ``score`` is -2 log probability."""

    component: int
    inliers: BoolArray
    evidence: Evidence
    state: State
    cost: float
    score: float
    lenses: Lenses

    @property
    def prior_score(self) -> float:
        """The part of the score from the component's weight and outliers; 0 if infinite."""
        own = self.score - score_state(self.evidence, self.state)
        return own if np.isfinite(own) else 0.0

    @property
    def points(self) -> FloatArray:
        return points_of(self.evidence.shape, self.state) / np.exp(self.state.log_scales)


class SearchResult(NamedTuple):
    """The problem at its estimated noise, its minima, and numbers of iterations and starts."""

    problem: Problem
    minima: list[Minimum]
    iterations: int
    hypotheses: int


def search_at_noise(problem: Problem, init: Inits) -> SearchResult:
    minima: list[Minimum] = []
    iterations = hypotheses = 0
    for number, shape in enumerate(problem.prior.components):
        lenses, starts = propose(problem, shape, init)
        hypotheses += len(starts.poses)
        if not len(starts.poses):
            continue
        evidence, no_state = problem.evidence(shape, lenses), cast(State, None)
        every = np.ones(len(evidence.sightings.point), dtype=bool)
        whole = Minimum(number, every, evidence, no_state, 0.0, np.inf, lenses)
        if any(init) and problem.uses_outlines and redundancy_of(evidence) < 0:
            # Only outlines determine all unknowns: a search without them would drift.
            found, used = _score_starts(whole, starts), 0
        else:
            found, used = _find_minima(problem, whole, starts)
        iterations += used
        prior_score = -2 * float(np.log(problem.prior.weights[number]))
        minima.extend(each._replace(score=each.score + prior_score) for each in found)
    if problem.ransac is not None and minima:
        best = min(minima, key=lambda each: each.score)
        _check_support(problem, best, problem.threshold(problem.ransac))
    minima.sort(key=lambda minimum: minimum.score)
    return SearchResult(problem, minima, iterations, hypotheses)


def _score_starts(whole: Minimum, starts: Starts) -> list[Minimum]:
    """The unrefined starts, with their scores."""
    states = [
        mean_state(whole.evidence, poses, log_scales)._replace(log_focals=log_focals)
        for poses, log_focals, log_scales in zip(*starts, strict=True)
    ]
    return [whole._replace(state=each, score=score_state(whole.evidence, each)) for each in states]


def _find_minima(problem: Problem, whole: Minimum, starts: Starts) -> tuple[list[Minimum], int]:
    """Minima of ``whole.evidence`` from starts, the best first, and the number of iterations."""
    if problem.ransac is not None:
        return _robust_minima(problem.ransac, problem.threshold(problem.ransac), whole, starts)
    minima, used = search_joint(whole.evidence, *starts)
    found = [
        whole._replace(state=state, cost=float(cost), score=float(score))
        for state, cost, score in zip(*minima, strict=True)
    ]
    return found, used


def _robust_minima(
    ransac: RansacOptions, limit: float, whole: Minimum, starts: Starts
) -> tuple[list[Minimum], int]:
    """Minima with the most inliers, the best first, and the number of iterations.

    An outlier costs its squared threshold, plus the log term of one more inlier. Default thresholds
    are widened by the projected displacement of a point, which an outlier's residual contains in
    full.
    """
    evidence = whole.evidence
    threshold = thresholds(evidence, whole.lenses, limit)
    minima, iterations = search_joint(add_cauchy_loss(evidence), *starts)
    found = []
    for state in minima.states[:_KEPT]:
        displaced = _WIDENING * _spread(evidence, state) * (ransac.max_reproj_error is None)
        rounds = _INLIER_ROUNDS if ransac.refine else 1
        settled = _refit(whole._replace(state=state), np.hypot(threshold, displaced), rounds)
        if settled is not None:
            found.append(settled)
    found.sort(key=lambda minimum: minimum.score)
    return found, iterations


def _refit(whole: Minimum, threshold: FloatArray, rounds: int) -> Minimum | None:
    """Refine on inliers, with whitened residuals below thresholds (N,), until these are stable."""
    best: Minimum | None = None
    state = whole.state
    inliers = whitened_lengths(whole.evidence, state) < threshold
    for _ in range(rounds):
        if inliers.sum() < _LEAST_INLIERS:
            break
        sightings = kept_rows(whole.evidence.sightings, inliers)
        some = whole.evidence._replace(sightings=sightings)
        start = state.poses[None], state.log_focals[None], state.log_scales[None]
        minima, _ = search_joint(some, *start)
        if not minima.states:
            break
        state = minima.states[0]
        left_out = threshold[~inliers] ** 2 + _OUTLIER_COST
        score, cost = float(minima.scores[0] + left_out.sum()), float(minima.costs[0])
        if best is None or score < best.score:
            best = whole._replace(
                inliers=inliers, evidence=some, state=state, cost=cost, score=score
            )
        again = whitened_lengths(whole.evidence, state) < threshold
        if (again == inliers).all():
            break
        inliers = again
    return best


def _check_support(problem: Problem, best: Minimum, max_reproj_error: float) -> None:
    """Raise NoConsensusError if chance explains the inliers; skipped for few keypoints."""
    views, rig, sightings = problem.views, best.evidence.rig, best.evidence.sightings
    limits = thresholds(best.evidence, best.lenses, 1.0)
    errors = whitened_lengths(best.evidence, best.state) / limits
    areas = np.array(  # of outliers [px^2]
        [
            area_of(view.pixels, view.camera, max_reproj_error) if len(view.keypoint_ids) else 1.0
            for view in views
        ]
    )
    free = int(best.evidence.scales.free.sum())
    size = 3 + min(free, _MOST_FREE) // 2 + (problem.lenses.count > 0)
    supports = []
    for pose in range(int(rig.pose.max()) + 1):
        seen = np.flatnonzero(rig.pose == pose)
        area = float(areas[seen].max())
        own = np.isin(sightings.image, seen)
        relative = errors[own] * np.sqrt(area / areas[sightings.image[own]])
        count = sum(len(views[view].keypoint_ids) for view in seen.tolist())
        if count > size:
            supports.append(Support(relative, count, area))
    if supports:
        left_out = len(best.inliers) - len(errors)
        score = float((errors**2).sum() + left_out * max_reproj_error**2)
        check_support(supports, size, max_reproj_error=max_reproj_error, score=score, where="views")


def thresholds(evidence: Evidence, lenses: Lenses, max_reproj_error: float) -> FloatArray:
    """Largest whitened residuals (N,) of inliers."""
    sightings = evidence.sightings
    focal = np.array([np.sqrt(camera.fx * camera.fy) for camera in lenses.cameras])
    root = np.sqrt(sightings.whitening[:, 0] * sightings.whitening[:, 2])
    return max_reproj_error / focal[sightings.image] * root


def search(problem: Problem, starts: Sequence[Inits]) -> SearchResult:
    """Minima from each of ``starts``, at the most likely noise of keypoints without sigma.

    The shape, and by Laplace's approximation the pose, are integrated out, so that fitted unknowns
    do not bias the noise. Raises DegenerateError if keypoints of unknown noise always fit exactly;
    NoConsensusError, with ``problem.ransac``, if chance explains the inliers.
    """
    if problem.lacks_sigma:
        counts = [len(view.keypoint_ids) for view in problem.views if view.sigma is None]
        if sum(counts) <= 3 * (1 if problem.is_rig else len(problem.numbers)):
            raise no_redundancy_error(sum(counts))
    minima: list[Minimum] = []
    effort = np.zeros(2, dtype=int)
    for init in starts:
        rounds = _NOISE_ROUNDS if problem.lacks_sigma else 0
        _, found, *spent = search_at_noise(problem, init)
        effort += spent
        while rounds and found:
            noise = _estimate_noise(problem, found[0])
            change = abs(math.log(noise / problem.noise))
            problem = problem._replace(noise=noise)
            rounds = 0 if change < _NOISE_TOLERANCE else rounds - 1
            _, found, *spent = search_at_noise(problem, init)
            effort += spent
        minima += found
    minima.sort(key=lambda each: each.score)
    return SearchResult(problem, minima, int(effort[0]), int(effort[1]))


def widen_by_noise(problem: Problem, minima: Sequence[Minimum]) -> Sequence[Minimum]:
    """Reduce the information of the minima if the noise was estimated."""
    if not problem.lacks_sigma:
        return minima
    unknown = _unknown_noise(problem.views, minima[0])
    unknowns = 6 * len(minima[0].state.poses) + int(minima[0].evidence.scales.free.sum())
    redundancy = max(2 * int(unknown.sum()) - unknowns, 1)
    factor = 1 / math.sqrt(widening_of(unknowns, redundancy))
    widened = []
    for each in minima:
        evidence = scale_whitening(factor, _unknown_noise(problem.views, each), each.evidence)
        widened.append(each._replace(evidence=evidence))
    return widened


def _estimate_noise(problem: Problem, minimum: Minimum) -> float:
    """The noise [px] that maximises the probability of one minimum."""
    unknown = _unknown_noise(problem.views, minimum)
    count = int(unknown.sum())

    def score(noise: float) -> float:
        scaled = scale_whitening(problem.noise / noise, unknown, minimum.evidence)
        _, least, _ = refine_joint(scaled, _NOISE_ITERATIONS, minimum.state)
        prior = (math.log(noise / _USUAL) / _USUAL_LOG_SIGMA) ** 2
        return least + 4 * count * math.log(noise) + prior

    scores = [score(noise) for noise in _NOISES.tolist()]
    best = int(np.argmin(scores))
    ends = _NOISES[[max(best - 1, 0), min(best + 1, len(_NOISES) - 1)]]
    low, high = np.log(ends).tolist()
    while high - low > _NOISE_PRECISION:  # golden section
        first, second = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        if score(math.exp(first)) < score(math.exp(second)):
            high = second
        else:
            low = first
    return math.exp((low + high) / 2)


def _unknown_noise(views: Sequence[View], minimum: Minimum) -> BoolArray:
    """True (N,) for keypoint sightings of views without sigma."""
    lacking = np.array([view.sigma is None for view in views])
    sightings = minimum.evidence.sightings
    return np.asarray(lacking[sightings.image] & (sightings.whitening[:, 2] > 0))


def whitened_lengths(evidence: Evidence, state: State) -> FloatArray:
    """Lengths (N,) of whitened image residuals; infinite behind a camera."""
    sightings = evidence.sightings
    points = points_of(evidence.shape, state)[sightings.point]
    seen = seen_in_cameras(evidence, state.poses, points, sightings.image)
    log_ratio = log_focals_of(evidence, state)[sightings.image][:, None]
    error = np.exp(log_ratio) * seen[:, :2] / seen[:, 2:] - sightings.rays
    a, b, c = sightings.whitening.T
    lengths = np.hypot(a * error[:, 0] + b * error[:, 1], c * error[:, 1])
    return np.where(seen[:, 2] > 0, lengths, np.inf)


def _spread(evidence: Evidence, state: State) -> FloatArray:
    """Whitened standard deviations (N,) of the points' projected displacements."""
    sightings, shape = evidence.sightings, evidence.shape
    points = points_of(shape, state)[sightings.point]
    depths = seen_in_cameras(evidence, state.poses, points, sightings.image)[:, 2]
    root = np.sqrt(sightings.whitening[:, 0] * sightings.whitening[:, 2])
    scale = np.exp(state.log_scales.mean())
    return np.asarray(root * scale * shape.spread[sightings.point] / np.maximum(depths, _NEAREST))


def scale_whitening(factor: float, chosen: BoolArray, evidence: Evidence) -> Evidence:
    """Multiply the whitening of ``chosen`` sightings (N,) by a factor."""
    old = evidence.sightings
    whitening = np.where(chosen[:, None], factor, 1.0) * old.whitening
    return evidence._replace(sightings=old._replace(whitening=whitening))
