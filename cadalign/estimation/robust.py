"""Robust fits of one view's keypoints, to those that support its best alignment.

Where the noise is known, consensus of LO-RANSAC over the minimal solver gives the inliers.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, DegenerateError, InputError, NoConsensusError
from cadalign.estimation.assemble import keypoints_of_solution
from cadalign.estimation.consensus import RobustSearch, find_consensus, refined
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.problems import Problems, check_sigmas
from cadalign.estimation.result_parts import FitStats, FittedKeypoints
from cadalign.estimation.solve import solve_one
from cadalign.estimation.uncertainty.residuals import (
    LEAST_ERROR,
    SOLUTIONS_OF_FOUR,
    Support,
    area_of,
    disagreeing,
    f_quantile,
    log_expected_by_chance,
)

_REACH = 3.0  # estimated sigmas within which keypoints agree
_FIRST, _FACTOR = 4.0, 2.0  # thresholds [px]
_WIDEST = 0.25  # threshold, over the keypoints' extent
_PREFERENCE = math.log(1000)  # for Cauchy's loss, whose estimate is the more accurate one
_LEAST_KEYPOINTS = 5
_SMALL_CHANCE = 0.01  # that an alignment to scattered keypoints leaves so small residuals


def fit_robustly(
    problems: Problems,
    options: FitOptions,
    ransac: RansacOptions,
    scores: npt.ArrayLike | None,
    start: float,
) -> FittedKeypoints:
    """Fit the only problem to the keypoints that support its best alignment.

    Raises NoConsensusError if no alignment has more support than chance gives; it carries the best
    score reached.
    """
    if options.method != "optimal":
        raise InputError(
            f"the method {options.method!r} does not go with ransac",
            where="method",
            fix="leave it at 'optimal'; RansacOptions(minimal=...) names the minimal solver",
        )
    check_sigmas([options.sigma], problems.counts)
    given = replace(  # the caller may go on to change theirs
        problems, points_3d=problems.points_3d.copy(), points_2d=problems.points_2d.copy()
    )
    trusted = None if scores is None else np.array(scores)
    search = RobustSearch(given, options, ransac, trusted)
    best, optimum = find_consensus(search), None
    search.check(best)
    # As many samples would find the support that a corrected mistake gives, which is more.
    ransac = replace(ransac, max_iterations=best.iterations)
    if ransac.refine:
        best, some, solutions, own = refined(search, best)
        optimum = keypoints_of_solution(some, solutions, own, time.perf_counter() - start)
    points = given.points_3d
    found = FittedKeypoints(
        points, best.residuals, best.inliers, best.alignment, best.camera, options
    )
    method = ransac.minimal
    if optimum is not None:
        method = optimum.method
        found = replace(
            found,
            sigma=optimum.sigma,
            fisher_covariance=optimum.fisher_covariance,
            cost=optimum.cost,
            alternatives=tuple(replace(each, points_3d=points) for each in optimum.alternatives),
        )
    ratio, seconds = float(best.inliers.mean()), time.perf_counter() - start
    return replace(
        found,
        method=f"ransac-{method}",
        stats=FitStats(best.iterations, best.hypotheses, seconds, ratio, best.score),
        search=replace(search, ransac=ransac),
    )


def fit_similar_robustly(
    problems: Problems,
    options: FitOptions,
    ransac: RansacOptions,
    scores: npt.ArrayLike | None,
    start: float,
) -> FittedKeypoints:
    """Fit the only problem, whose keypoints' standard deviation is to be estimated.

    For a model that is only similar the noise, and with it the threshold, is unknown. Two estimates
    compete: the alignment under Cauchy's loss, which tolerates some outliers and any noise, and the
    consensus at thresholds from a few pixels up, which tolerates most keypoints being outliers, but
    not that all of them are off by more than the threshold. The one whose inliers chance explains
    less wins. Raises NoConsensusError if both explain the keypoints no better than chance.
    """
    pixels = problems.points_2d

    def by_chance(found: FittedKeypoints, threshold: float) -> float:
        """Log of the number of alignments that chance supports as well."""
        errors = np.linalg.norm(found.residuals[found.inliers], axis=1)
        support = Support(errors, len(found.inliers), area_of(pixels, found.camera, threshold))
        return log_expected_by_chance(support, 4, SOLUTIONS_OF_FOUR)

    tolerant = _under_cauchy(problems, options, start)
    strict: tuple[FittedKeypoints, float] | None = None
    refusal: CadalignError | None = None
    extent = float(np.ptp(pixels, axis=0).max()) if len(pixels) else 0.0
    threshold = _FIRST
    while threshold == _FIRST or threshold <= _WIDEST * extent:
        chosen = replace(ransac, max_reproj_error=threshold)
        try:
            found = fit_robustly(problems, options, chosen, scores, start)
        except (NoConsensusError, DegenerateError) as error:
            refusal = refusal or error
        else:
            if strict is None or by_chance(found, threshold) < by_chance(*strict):
                strict = found, threshold
        threshold *= _FACTOR
    if tolerant is not None:
        reach = _reach(tolerant)
        if strict is None or by_chance(tolerant, reach) - _PREFERENCE <= by_chance(*strict):
            if strict is None and not _is_explained(tolerant, pixels):
                raise _refused(tolerant)
            return tolerant
    if strict is None:
        assert refusal is not None
        raise refusal
    return strict[0]


def _under_cauchy(problems: Problems, options: FitOptions, start: float) -> FittedKeypoints | None:
    """The alignment under Cauchy's loss, its inliers marked; None where there is none."""
    own = replace(options, loss="cauchy" if options.loss == "linear" else options.loss)
    try:
        found = keypoints_of_solution(problems, solve_one(problems, own), own, 0.0)
    except CadalignError:
        return None
    near = np.linalg.norm(found.residuals, axis=1) <= _reach(found)
    if near.sum() < min(_LEAST_KEYPOINTS, len(near)):
        return None
    seconds = time.perf_counter() - start
    stats = replace(found.stats, seconds=seconds, inlier_ratio=float(near.mean()))
    return replace(found, inliers=near, method="robust-optimal", stats=stats)


def _is_explained(found: FittedKeypoints, points_2d: FloatArray) -> bool:
    """True if the alignment explains more of the keypoints' places than chance would.

    An F test of the residuals against those of the keypoints' mean.
    """
    residuals, pixels = found.residuals[found.inliers], points_2d[found.inliers]
    left = float((residuals**2).sum())
    total = float(((pixels - pixels.mean(axis=0)) ** 2).sum())
    unknowns = found.options.unknowns - 2
    redundancy = 2 * len(pixels) - found.options.unknowns
    if redundancy < 1:
        return True
    ratio = (total - left) / unknowns / max(left / redundancy, 1e-300)
    return ratio > f_quantile(unknowns, redundancy, _SMALL_CHANCE)


def _reach(found: FittedKeypoints) -> float:
    """Largest residual of a keypoint that agrees [px]."""
    return max(_REACH * (found.sigma or 0.0), LEAST_ERROR)


def _refused(found: FittedKeypoints) -> NoConsensusError:
    """The error of keypoints that no alignment explains, with those that disagree most."""
    errors = np.linalg.norm(found.residuals, axis=1)
    typical = errors <= np.median(errors)
    return NoConsensusError(
        f"no alignment is supported: the best leaves residuals of {np.median(errors):.3g} px, as "
        f"chance does; {disagreeing(errors, typical)}",
        where="points_2d",
        fix="check which keypoint is which, the model and the camera; give sigma or "
        "max_reproj_error where you know them, or a learned shape",
        inliers=int(found.inliers.sum()),
    )
