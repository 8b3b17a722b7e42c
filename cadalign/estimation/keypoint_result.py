"""Results of keypoints in one view: single fits, and those of a batch one at a time."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.options import FitOptions
from cadalign.estimation.problems import Problems, Solutions, full_covariance
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import Alternative, FitStats, ViewResult, quickly
from cadalign.estimation.solve import alternatives_of, camera_of
from cadalign.estimation.uncertainty.stated import KeypointStatistics
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

_NUMBER = int | float


def result_of_solution(
    problems: Problems, solutions: Solutions, options: FitOptions, seconds: float
) -> Result:
    """The result of the only problem, which has a solution."""
    minima, iterations, hypotheses, _ = solutions.info[0].tolist()
    sigma = None
    if solutions.sigmas is not None:
        sigma = float(solutions.sigmas[0])
    elif options.method == "optimal" and isinstance(options.sigma, _NUMBER):
        sigma = float(options.sigma)
    inliers = np.empty(len(problems.points_3d), dtype=bool)
    inliers.fill(True)
    effort = {"iterations": iterations, "hypotheses": hypotheses, "seconds": seconds}
    covariance = None
    if solutions.covariances is not None:
        covariance = full_covariance(solutions.covariances[0], options.known_axis)
    return result_of_keypoints(
        problems,
        options,
        alignment=Alignment.from_packed(solutions.poses[0, 0]),
        camera=camera_of(problems, solutions, 0),
        residuals=solutions.residuals,
        inliers=inliers,
        method=options.method,
        stats=quickly(FitStats, effort),
        sigma=sigma,
        covariance=covariance,
        cost=None if covariance is None else solutions.costs.item(0),
        alternatives=alternatives_of(problems, solutions, minima, options) if minima > 1 else (),
    )


def result_of_keypoints(
    problems: Problems,
    options: FitOptions,
    *,
    alignment: Alignment,
    camera: Camera,
    residuals: FloatArray,
    inliers: BoolArray,
    method: str,
    stats: FitStats,
    sigma: float | None = None,
    covariance: FloatArray | None = None,
    cost: float | None = None,
    alternatives: tuple[Alternative, ...] = (),
) -> Result:
    """The result of the only problem, with the inverse Fisher information (9, 9) or (10, 10)."""
    points = problems.points_3d.copy()  # the caller may go on to change theirs
    ids = _rows(len(points))
    of_keypoints = {
        "points_3d": points,
        "alignment": alignment,
        "camera": camera,
        "residuals": residuals,
        "inliers": inliers,
        "options": options,
        "sigma": sigma,
        "fisher_covariance": covariance,
    }
    statistics = quickly(KeypointStatistics, of_keypoints)
    of_view = {
        "camera": camera,
        "alignment": alignment,
        "ids": ids,
        "points_2d": problems.points_2d.copy(),
        "residuals": residuals,
        "inliers": inliers,
        "statistics": statistics,
    }
    of_result = {
        "views": (quickly(ViewResult, of_view),),
        "ids": ids,
        "points_3d": points,
        "method": method,
        "statistics": statistics,
        "known_axis": options.known_axis,
        "stretched_axes": options.stretched_axes,
        "focal": options.focal,
        "focal_prior": options.focal_prior,
        "sigma": sigma,
        "cost": cost,
        "alternatives": alternatives,
        "stats": stats,
        "options": options,
    }
    return quickly(Result, of_result)


def with_keypoints(
    result: Result,
    problems: Problems,
    options: FitOptions,
    residuals: FloatArray,
    inliers: BoolArray,
    stats: FitStats,
) -> Result:
    """A result of some of the only problem's keypoints as that of all, with their inliers."""
    found = result_of_keypoints(
        problems,
        options,
        alignment=result.alignment,
        camera=result.camera,
        residuals=residuals,
        inliers=inliers,
        method=f"ransac-{result.method}",
        stats=stats,
        sigma=result.sigma,
        covariance=result.fisher_covariance,
        cost=result.cost,
    )
    points = found.points_3d
    others = tuple(replace(each, points_3d=points) for each in result.alternatives)
    return replace(found, alternatives=others)


@lru_cache(maxsize=64)
def _rows(count: int) -> tuple[int, ...]:
    """Rows of so many keypoints, which are their ids."""
    return tuple(range(count))
