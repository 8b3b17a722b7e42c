"""Standard deviation of keypoints by the likelihood of all evidence, where none is given."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cadalign.arrays import BoolArray
from cadalign.estimation.degeneracy import no_redundancy_error
from cadalign.estimation.options import RansacOptions
from cadalign.estimation.search import Inits, JointProblem, Minimum, find_minima
from cadalign.estimation.uncertainty.posterior import widening_of
from cadalign.estimation.view import View
from cadalign.solvers.joint.search import refine_joint, score_state

_GRID = np.geomspace(0.1, 100.0, 10)  # [px]
_USUAL, _USUAL_LOG_SIGMA = 2.0, 1.5  # [px], prior: few keypoints fit any noise by the shape
_ROUNDS = 3  # of a search with the noise of the last
_TOLERANCE = 0.2  # change of the log noise that asks for another search
_PRECISION = 0.01  # of the log noise
_ITERATIONS = 30
_GOLDEN = (math.sqrt(5) - 1) / 2


def find_minima_and_noise(
    problem: JointProblem, inits: Inits, ransac: RansacOptions | None
) -> tuple[JointProblem, list[Minimum], int, int]:
    """Minima with the likeliest standard deviation of the keypoints that have none.

    The shape is integrated out, and so is the pose by Laplace's approximation, so that the estimate
    is free of the bias that fitted unknowns cause.

    Returns
    -------
    The problem with that noise, and what `find_minima` returns.

    Raises
    ------
    DegenerateError
        If the keypoints fit exactly whatever they are.
    """
    counts = [len(view.keypoint_ids) for view in problem.views if view.sigma is None]
    poses = 1 if problem.views[0].cam_from_rig is not None else len(problem.views)
    if 2 * sum(counts) <= 6 * poses:
        raise no_redundancy_error(sum(counts))
    effort = np.zeros(2, dtype=int)
    minima: list[Minimum] = []
    for _ in range(_ROUNDS):
        minima, *spent = find_minima(problem, inits, ransac)
        effort += spent
        if not minima:
            break
        noise = _likeliest(problem, minima[0])
        change = abs(math.log(noise / problem.noise))
        problem = problem._replace(noise=noise)
        if change < _TOLERANCE:
            break
    if minima:
        minima, *spent = find_minima(problem, inits, ransac)
        effort += spent
    return problem, minima, int(effort[0]), int(effort[1])


def widened_by_noise(problem: JointProblem, minima: Sequence[Minimum]) -> list[Minimum]:
    """The minima with less information, as the noise itself is uncertain."""
    unknown = _without_sigma(problem.views, minima[0])
    unknowns = 6 * len(minima[0].state.poses) + int(minima[0].evidence.scales.free.sum())
    redundancy = max(2 * int(unknown.sum()) - unknowns, 1)
    factor = 1 / math.sqrt(widening_of(unknowns, redundancy))
    return [_scaled(each, _without_sigma(problem.views, each), factor) for each in minima]


def _likeliest(problem: JointProblem, minimum: Minimum) -> float:
    """The noise [px] with the best score of one minimum."""
    unknown = _without_sigma(problem.views, minimum)
    count = int(unknown.sum())

    def score(noise: float) -> float:
        scaled = _scaled(minimum, unknown, problem.noise / noise)
        cost, state, _, _ = refine_joint(scaled.evidence, _ITERATIONS, scaled.state)
        if not cost < np.inf:
            return math.inf
        prior = (math.log(noise / _USUAL) / _USUAL_LOG_SIGMA) ** 2
        return score_state(scaled.evidence, state) + 4 * count * math.log(noise) + prior

    scores = [score(noise) for noise in _GRID.tolist()]
    best = int(np.argmin(scores))
    low, high = math.log(_GRID[max(best - 1, 0)]), math.log(_GRID[min(best + 1, len(_GRID) - 1)])
    while high - low > _PRECISION:  # golden section
        first, second = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        if score(math.exp(first)) < score(math.exp(second)):
            high = second
        else:
            low = first
    return math.exp((low + high) / 2)


def _without_sigma(views: Sequence[View], minimum: Minimum) -> BoolArray:
    """Marks the sightings (N,) of views whose keypoints have no sigma."""
    lacking = np.array([view.sigma is None for view in views])
    sightings = minimum.evidence.sightings
    return np.asarray(lacking[sightings.image] & (sightings.whitening[:, 2] > 0))


def _scaled(minimum: Minimum, chosen: BoolArray, factor: float) -> Minimum:
    """The minimum with the whitening of chosen sightings times a factor."""
    sightings = minimum.evidence.sightings
    whitening = np.where(chosen[:, None], factor, 1.0) * sightings.whitening
    evidence = minimum.evidence._replace(sightings=sightings._replace(whitening=whitening))
    return minimum._replace(evidence=evidence)
