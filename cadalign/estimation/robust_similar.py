"""Robust search for a model that is only similar: the noise, and with it the threshold, is unknown.

Two estimates compete: the alignment under Cauchy's loss, which tolerates some outliers and any
noise, and the consensus of LO-RANSAC at thresholds from a few pixels up, which tolerates most
keypoints being outliers, but not that all of them are off by more than the threshold. The one whose
inliers chance explains less wins (`cadalign.estimation.support.log_expected_by_chance`).
"""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from cadalign.errors import CadalignError, DegenerateError, NoConsensusError
from cadalign.estimation.assemble import result_of_keypoints, result_of_solution
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.problems import Problems
from cadalign.estimation.result import Result
from cadalign.estimation.robust import fit_robustly
from cadalign.estimation.solve import solve_one
from cadalign.estimation.support import (
    LEAST_ERROR,
    Support,
    area_of,
    disagreeing,
    log_expected_by_chance,
)
from cadalign.estimation.uncertainty.distributions import f_quantile

_REACH = 3.0  # estimated sigmas within which keypoints agree
_FIRST, _FACTOR = 4.0, 2.0  # thresholds [px]
_WIDEST = 0.25  # threshold, over the keypoints' extent
_PREFERENCE = math.log(1000)  # for Cauchy's loss, whose estimate is the more accurate one
_LEAST_KEYPOINTS = 5
_SOLUTIONS = 2.3  # valid ones of 4 points, in the mean
_CHANCE = 0.01  # probability that an alignment to scattered keypoints leaves so small residuals


def fit_similar_robustly(
    problems: Problems,
    options: FitOptions,
    ransac: RansacOptions,
    confidences: npt.ArrayLike | None,
    start: float,
) -> Result:
    """Fit the only problem, whose keypoints' standard deviation is to be estimated.

    Raises
    ------
    NoConsensusError
        If both estimates explain the keypoints no better than chance.
    """
    tolerant = _under_cauchy(problems, options, start)
    strict: tuple[Result, float] | None = None
    refusal: CadalignError | None = None
    extent = float(np.ptp(problems.points_2d, axis=0).max(initial=0.0))
    threshold = _FIRST
    while threshold == _FIRST or threshold <= _WIDEST * extent:
        chosen = replace(ransac, max_reproj_error=threshold)
        try:
            found = fit_robustly(problems, options, chosen, confidences, start)
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
    loss = "cauchy" if options.loss == "linear" else options.loss
    try:
        own = replace(options, loss=loss)
        solutions = solve_one(problems, own)
    except CadalignError:
        return None
    result = result_of_solution(problems, solutions, own, 0.0)
    near = np.linalg.norm(result.residuals, axis=1) <= _reach(result)
    if near.sum() < min(_LEAST_KEYPOINTS, len(near)):
        return None
    fitted = {
        "points_3d": result.points_3d,
        "residuals": result.residuals,
        "inliers": near,
        "alignment": result.alignment,
        "camera": result.camera,
        "options": own,
        "sigma": result.sigma,
        "fisher_covariance": result.fisher_covariance,
    }
    seconds = time.perf_counter() - start
    return result_of_keypoints(
        problems.points_2d,
        fitted,
        method="robust-optimal",
        stats=replace(result.stats, seconds=seconds, inlier_ratio=float(near.mean())),
        cost=result.cost,
        alternatives=result.alternatives,
    )


def _by_chance(result: Result, threshold: float) -> float:
    """Log of the number of alignments that chance supports as well; see `support`."""
    errors = np.linalg.norm(result.residuals[result.inliers], axis=1)
    view = result.views[0]
    area = area_of(view.points_2d, view.camera, threshold)
    return log_expected_by_chance(Support(errors, len(result.inliers), area), 4, _SOLUTIONS)


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
    return ratio > f_quantile(unknowns, redundancy, _CHANCE)


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
