"""Robust fit of one view's keypoints: to those that support its best alignment."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray
from cadalign.errors import InputError, NoConsensusError
from cadalign.estimation.assemble import result_of_keypoints, result_of_solution
from cadalign.estimation.consensus import Consensus, RobustSearch, find_consensus, mistake_in
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.problems import Problems, check_sigmas
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import FitStats
from cadalign.estimation.solve import solve_one

_INLIER_ROUNDS = 5


def fit_robustly(
    problems: Problems,
    options: FitOptions,
    ransac: RansacOptions,
    confidences: npt.ArrayLike | None,
    start: float,
) -> Result:
    """Fit the only problem to the keypoints that support its best alignment.

    Raises
    ------
    NoConsensusError
        If no alignment has more support than chance gives; it carries the best score reached.
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
    trusted = None if confidences is None else np.array(confidences)
    search = RobustSearch(given, options, ransac, trusted)
    best, refined = _found(search), None
    # As many samples would find the support that a corrected mistake gives, which is more.
    ransac = replace(ransac, max_iterations=best.iterations)
    points = given.points_3d
    if ransac.refine:
        best, refined = _refined(search, best, start)
    fitted = {
        "points_3d": points,
        "residuals": best.residuals,
        "inliers": best.inliers,
        "alignment": best.alignment,
        "camera": best.camera,
        "options": options,
        "sigma": refined and refined.sigma,
        "fisher_covariance": None if refined is None else refined.fisher_covariance,
        "search": replace(search, ransac=ransac),
    }
    ratio, seconds = float(best.inliers.mean()), time.perf_counter() - start
    others = () if refined is None else refined.alternatives
    return result_of_keypoints(
        problems.points_2d,
        fitted,
        method=f"ransac-{ransac.minimal if refined is None else refined.method}",
        stats=FitStats(best.iterations, best.hypotheses, seconds, ratio, best.score),
        cost=None if refined is None else refined.cost,
        alternatives=tuple(replace(each, points_3d=points) for each in others),
    )


def _found(search: RobustSearch) -> Consensus:
    """The consensus; where there is none, the error names the mistake that is to blame."""
    best = find_consensus(search)
    try:
        search.check(best)
    except NoConsensusError as error:
        found = search.explained(best.alignment, best.residuals)
        error.fix = mistake_in(search, found) or error.fix
        raise
    return best


def _refined(search: RobustSearch, best: Consensus, start: float) -> tuple[Consensus, Result]:
    """The optimum for the inliers, until these don't change, and its result."""
    inliers = best.inliers
    for last in range(_INLIER_ROUNDS + 1):
        result = _fit_inliers(search.problems, search.options, inliers, start)
        residuals = search.residuals_of(result.alignment, result.camera)
        kept = np.linalg.norm(residuals, axis=1) < search.threshold
        if (kept == inliers).all() or kept.sum() < inliers.sum() or last == _INLIER_ROUNDS:
            break
        inliers = kept
    found = best._replace(
        alignment=result.alignment, camera=result.camera, inliers=inliers, residuals=residuals
    )
    return found, result


def _fit_inliers(
    problems: Problems, options: FitOptions, inliers: BoolArray, start: float
) -> Result:
    sigma = options.sigma
    if sigma is not None and np.ndim(sigma) > 0:
        sigma = np.asarray(sigma, dtype=np.float64)[inliers]
    some = Problems(
        problems.points_3d[inliers],
        problems.points_2d[inliers],
        np.array([0, int(inliers.sum())]),
        problems.cameras,
    )
    own = replace(options, sigma=sigma)
    return result_of_solution(some, solve_one(some, own), own, time.perf_counter() - start)
