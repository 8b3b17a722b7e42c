"""The fit of one problem: to all its keypoints, or to those that support its best alignment."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray
from cadalign.errors import InputError
from cadalign.fitting.estimation import Solutions, solve
from cadalign.fitting.options import FitOptions, RansacOptions
from cadalign.fitting.problems import Problems
from cadalign.fitting.result import Alternative, FitResult, FitStats
from cadalign.fitting.robust import Consensus, find_consensus, residuals_of
from cadalign.geometry.alignment import Alignment

LEAST_LIKELIHOOD = 1e-3
"""Relative likelihood above which another minimum is reported as an alternative."""
_INLIER_ROUNDS = 5


def fit_robustly(
    problems: Problems,
    options: FitOptions,
    ransac: RansacOptions,
    confidences: npt.ArrayLike | None,
    start: float,
) -> FitResult:
    """Fit the only problem to the keypoints that support its best alignment."""
    if options.method != "optimal":
        raise InputError(
            f"the method {options.method!r} does not go with ransac",
            where="method",
            fix="leave the method alone; RansacOptions(minimal=...) names the minimal solver",
        )
    consensus = find_consensus(problems, options, ransac, confidences)
    inliers = consensus.inliers
    if not ransac.refine:
        result = _unrefined(problems, options, consensus)
    else:
        result = _fit_inliers(problems, options, inliers, start)
        for _ in range(_INLIER_ROUNDS):
            residuals = residuals_of(problems, result.alignment, result.camera)
            kept = np.linalg.norm(residuals, axis=1) < ransac.max_reproj_error
            if (kept == inliers).all() or kept.sum() < inliers.sum():
                break
            inliers = kept
            result = _fit_inliers(problems, options, inliers, start)
    residuals = residuals_of(problems, result.alignment, result.camera)
    return replace(
        result,
        points_3d=problems.points_3d.copy(),
        residuals=residuals,
        inliers=inliers,
        method=f"ransac-{ransac.minimal}" if not ransac.refine else "ransac-optimal",
        stats=FitStats(
            iterations=consensus.iterations,
            hypotheses=consensus.hypotheses,
            seconds=time.perf_counter() - start,
            inlier_ratio=float(inliers.mean()),
            score=consensus.score,
        ),
    )


def _fit_inliers(
    problems: Problems, options: FitOptions, inliers: BoolArray, start: float
) -> FitResult:
    """The optimum for some of the only problem's keypoints."""
    sigma = options.sigma
    if sigma is not None and np.ndim(sigma) > 0:
        sigma = np.asarray(sigma)[inliers]
    some = Problems(
        problems.points_3d[inliers],
        problems.points_2d[inliers],
        np.array([0, int(inliers.sum())]),
        problems.cameras,
    )
    return fit_all(some, replace(options, sigma=sigma), start)


def _unrefined(problems: Problems, options: FitOptions, consensus: Consensus) -> FitResult:
    """The best hypothesis as the minimal solver left it."""
    count = len(problems.points_3d)
    return FitResult(
        alignment=consensus.alignment,
        points_3d=problems.points_3d,
        residuals=np.zeros((count, 2)),
        inliers=np.ones(count, dtype=bool),
        method=options.method,
        camera=consensus.camera,
        known_axis=options.known_axis,
        stretched_axes=options.stretched_axes,
        focal=options.focal,
        focal_prior=options.focal_prior,
    )


def fit_all(problems: Problems, options: FitOptions, start: float) -> FitResult:
    """Fit the only problem to all its keypoints."""
    solutions = solve(problems, options)
    if solutions.errors:
        raise solutions.errors[0]
    alignment = Alignment.from_packed(solutions.poses[0, 0])
    minima, iterations, hypotheses, _ = solutions.info[0].tolist()
    count = len(problems.points_3d)
    return FitResult(
        alignment=alignment,
        points_3d=problems.points_3d.copy(),  # the caller may go on to change theirs
        residuals=solutions.residuals,
        inliers=np.ones(count, dtype=bool),
        method=options.method,
        camera=solutions.camera(problems, 0),
        sigma=None if solutions.sigmas is None else float(solutions.sigmas[0]),
        covariance=None if solutions.covariances is None else solutions.covariances[0],
        known_axis=options.known_axis,
        stretched_axes=options.stretched_axes,
        focal=options.focal,
        focal_prior=options.focal_prior,
        alternatives=_alternatives(problems, solutions, minima, options) if minima > 1 else (),
        stats=FitStats(iterations, hypotheses, time.perf_counter() - start),
    )


def _alternatives(
    problems: Problems, solutions: Solutions, minima: int, options: FitOptions
) -> tuple[Alternative, ...]:
    """The other minima that are likely enough."""
    costs = solutions.costs[0, :minima]
    if options.sigma is None:  # the likelihood at the sigma that is best for each minimum
        ratios = (max(costs[0], 1e-300) / np.maximum(costs, 1e-300)) ** len(problems.points_3d)
    else:
        ratios = np.exp(np.minimum(0.0, costs[0] - costs) / 2)
    return tuple(
        Alternative(
            Alignment.from_packed(solutions.poses[0, k]),
            float(ratios[k]),
            solutions.camera(problems, k),
        )
        for k in range(1, minima)
        if ratios[k] >= LEAST_LIKELIHOOD
    )
