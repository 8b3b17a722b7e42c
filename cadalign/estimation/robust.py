"""Robust fits of one view's keypoints, to those that support its best alignment.

Where the noise is known, consensus of LO-RANSAC over the minimal solver gives the inliers.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import cast

import numpy as np
import numpy.typing as npt

from cadalign.errors import CadalignError, DegenerateError, InputError, NoConsensusError
from cadalign.estimation.assemble import result_of_keypoints, result_of_solution
from cadalign.estimation.consensus import (
    Consensus,
    RobustSearch,
    find_consensus,
    mistake_in,
    refined,
)
from cadalign.estimation.mistakes import (
    LEAST_ERROR,
    SOLUTIONS_OF_FOUR,
    Support,
    area_of,
    disagreeing,
    log_expected_by_chance,
)
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.problems import Problems, check_sigmas
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import FitStats, KeypointStatistics
from cadalign.estimation.solve import solve_one
from cadalign.estimation.uncertainty.residuals import f_quantile

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
) -> Result:
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
    best, result = _found(search), None
    # As many samples would find the support that a corrected mistake gives, which is more.
    ransac = replace(ransac, max_iterations=best.iterations)
    points = given.points_3d
    if ransac.refine:
        best, some, solutions, own = refined(search, best)
        result = result_of_solution(some, solutions, own, time.perf_counter() - start)
    fitted = {
        "points_3d": points,
        "residuals": best.residuals,
        "inliers": best.inliers,
        "alignment": best.alignment,
        "camera": best.camera,
        "options": options,
        "sigma": result and result.sigma,
        "fisher_covariance": None if result is None else result.fisher_covariance,
        "search": replace(search, ransac=ransac),
    }
    ratio, seconds = float(best.inliers.mean()), time.perf_counter() - start
    others = () if result is None else result.alternatives
    return result_of_keypoints(
        problems.points_2d,
        fitted,
        method=f"ransac-{ransac.minimal if result is None else result.method}",
        stats=FitStats(best.iterations, best.hypotheses, seconds, ratio, best.score),
        cost=None if result is None else result.cost,
        alternatives=tuple(replace(each, points_3d=points) for each in others),
    )


def _found(search: RobustSearch) -> Consensus:
    """The consensus; where there is none, the error names the mistake that is to blame."""
    best = find_consensus(search)
    try:
        search.check(best)
    except NoConsensusError as error:
        mistake = mistake_in(search, search.explained(best.alignment, best.residuals))
        error.fix = error.fix if mistake is None else mistake.text
        raise
    return best


def fit_similar_robustly(
    problems: Problems,
    options: FitOptions,
    ransac: RansacOptions,
    scores: npt.ArrayLike | None,
    start: float,
) -> Result:
    """Fit the only problem, whose keypoints' standard deviation is to be estimated.

    For a model that is only similar the noise, and with it the threshold, is unknown. Two estimates
    compete: the alignment under Cauchy's loss, which tolerates some outliers and any noise, and the
    consensus at thresholds from a few pixels up, which tolerates most keypoints being outliers, but
    not that all of them are off by more than the threshold. The one whose inliers chance explains
    less wins. Raises NoConsensusError if both explain the keypoints no better than chance.
    """
    tolerant = _under_cauchy(problems, options, start)
    strict: tuple[Result, float] | None = None
    refusal: CadalignError | None = None
    extent = float(np.ptp(problems.points_2d, axis=0).max()) if len(problems.points_2d) else 0.0
    threshold = _FIRST
    while threshold == _FIRST or threshold <= _WIDEST * extent:
        chosen = replace(ransac, max_reproj_error=threshold)
        try:
            found = fit_robustly(problems, options, chosen, scores, start)
        except (NoConsensusError, DegenerateError) as error:
            refusal = refusal or error
        else:
            if strict is None or _by_chance(found, threshold) < _by_chance(*strict):
                strict = found, threshold
        threshold *= _FACTOR
    if tolerant is not None:
        reach = _reach(tolerant)
        if strict is None or _by_chance(tolerant, reach) - _PREFERENCE <= _by_chance(*strict):
            if strict is None and not _is_explained(tolerant, options):
                raise _refused(tolerant)
            return tolerant
    if strict is None:
        assert refusal is not None
        raise refusal
    return strict[0]


def _under_cauchy(problems: Problems, options: FitOptions, start: float) -> Result | None:
    """The alignment under Cauchy's loss, its inliers marked; None where there is none."""
    own = replace(options, loss="cauchy" if options.loss == "linear" else options.loss)
    try:
        result = result_of_solution(problems, solve_one(problems, own), own, 0.0)
    except CadalignError:
        return None
    near = np.linalg.norm(result.residuals, axis=1) <= _reach(result)
    if near.sum() < min(_LEAST_KEYPOINTS, len(near)):
        return None
    statistics = replace(cast(KeypointStatistics, result.statistics), inliers=near)
    seconds = time.perf_counter() - start
    return replace(
        result,
        views=(replace(result.views[0], inliers=near, statistics=statistics),),
        statistics=statistics,
        method="robust-optimal",
        stats=replace(result.stats, seconds=seconds, inlier_ratio=float(near.mean())),
    )


def _by_chance(result: Result, threshold: float) -> float:
    """Log of the number of alignments that chance supports as well; see `support`."""
    errors = np.linalg.norm(result.residuals[result.inliers], axis=1)
    view = result.views[0]
    area = area_of(view.points_2d, view.camera, threshold)
    return log_expected_by_chance(Support(errors, len(result.inliers), area), 4, SOLUTIONS_OF_FOUR)


def _is_explained(result: Result, options: FitOptions) -> bool:
    """True if the alignment explains more of the keypoints' places than chance would.

    An F test of the residuals against those of the keypoints' mean.
    """
    kept = result.inliers
    residuals, pixels = result.residuals[kept], result.views[0].points_2d[kept]
    left = float((residuals**2).sum())
    total = float(((pixels - pixels.mean(axis=0)) ** 2).sum())
    unknowns = options.unknowns - 2
    redundancy = 2 * len(pixels) - options.unknowns
    if redundancy < 1:
        return True
    ratio = (total - left) / unknowns / max(left / redundancy, 1e-300)
    return ratio > f_quantile(unknowns, redundancy, _SMALL_CHANCE)


def _reach(result: Result) -> float:
    """Largest residual of a keypoint that agrees [px]."""
    return max(_REACH * (result.sigma or 0.0), LEAST_ERROR)


def _refused(result: Result) -> NoConsensusError:
    """The error of keypoints that no alignment explains, with those that disagree most."""
    errors = np.linalg.norm(result.residuals, axis=1)
    typical = errors <= np.median(errors)
    return NoConsensusError(
        f"no alignment is supported: the best leaves residuals of {np.median(errors):.3g} px, as "
        f"chance does; {disagreeing(errors, typical)}",
        where="points_2d",
        fix="check which keypoint is which, the model and the camera; give sigma or "
        "max_reproj_error where you know them, or a learned shape",
        inliers=int(result.inliers.sum()),
    )
