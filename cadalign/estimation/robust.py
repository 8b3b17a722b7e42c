"""Robust search for one view, by LO-RANSAC over the minimal solver; support that chance gives."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, as_floats
from cadalign.errors import DegenerateError, InputError, NoConsensusError
from cadalign.estimation.assemble import result_of_keypoints, result_of_solution
from cadalign.estimation.focal import log_focal_range
from cadalign.estimation.focal_search import focal_views
from cadalign.estimation.options import MINIMAL_SOLVERS, FitOptions, RansacOptions
from cadalign.estimation.problems import (
    Problems,
    are_in_one_plane,
    check_sigmas,
    rays_of,
    whitening_of,
)
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import FitStats
from cadalign.estimation.solve import solve_one
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.solvers.alignment import Objective
from cadalign.solvers.constants import LINEAR, POSE_SIZE, SAMPLE_SIZES
from cadalign.solvers.evidence import Keypoints, LogFocalPrior, ScalePrior, Views
from cadalign.solvers.minimal import MAX_SOLUTIONS
from cadalign.solvers.ransac import Settings, ransac_kernel

_INLIER_ROUNDS = 5
_MOST_EXHAUSTIVE = 1000  # subsets that are all tried rather than drawn from
_CHANCE = 0.1  # expected number of models with as much support by chance
_LEAST_ERROR = 0.1  # no keypoint is taken to be better than that [px]


class Consensus(NamedTuple):
    """An alignment with the keypoints (n,) that support it, and the residuals (n, 2) [px] of all.

    ``score`` is the truncated sum of squares [px^2].
    """

    alignment: Alignment
    camera: Camera
    inliers: BoolArray
    residuals: FloatArray
    iterations: int
    hypotheses: int
    score: float


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
    best = find_consensus(problems, options, ransac, confidences)
    points, refined = problems.points_3d.copy(), None
    if ransac.refine:
        best, refined = _refined(problems, options, ransac.max_reproj_error, best, start)
    fitted = {
        "points_3d": points,
        "residuals": best.residuals,
        "inliers": best.inliers,
        "alignment": best.alignment,
        "camera": best.camera,
        "options": options,
        "sigma": refined and refined.sigma,
        "fisher_covariance": None if refined is None else refined.fisher_covariance,
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


def _refined(
    problems: Problems, options: FitOptions, threshold: float, best: Consensus, start: float
) -> tuple[Consensus, Result]:
    """The optimum for the inliers, until these don't change, and its result."""
    inliers = best.inliers
    for last in range(_INLIER_ROUNDS + 1):
        result = _fit_inliers(problems, options, inliers, start)
        residuals = _residuals_of(problems, result.alignment, result.camera)
        kept = np.linalg.norm(residuals, axis=1) < threshold
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


def find_consensus(
    problems: Problems,
    options: FitOptions,
    ransac: RansacOptions,
    confidences: npt.ArrayLike | None,
) -> Consensus:
    """The best hypothesis of LO-RANSAC for the only problem; see `fit_robustly`."""
    camera = problems.cameras[0]
    points = problems.points_3d[:, options.axis_order]
    count = len(points)
    minimal = MINIMAL_SOLVERS[ransac.minimal]
    size = SAMPLE_SIZES[minimal]
    if count < size:
        raise InputError(
            f"{count} keypoints are too few", where="points_3d", fix=f"give at least {size}"
        )
    if options.focal == "estimate" and ransac.minimal != "ap4p":
        raise InputError(
            f"{ransac.minimal!r} does not estimate the focal length",
            where="minimal",
            fix="leave it at 'ap4p'",
        )
    by_confidence = order_of_confidence(confidences, count)
    order = np.random.default_rng(ransac.seed).permutation(count)
    ranked = np.arange(count) if by_confidence is None else np.argsort(order)[by_confidence]
    views = _views(problems.points_2d[order], camera, options)
    exhaustive = math.comb(count, size) <= _MOST_EXHAUSTIVE
    pose = np.zeros(POSE_SIZE)
    inliers = np.zeros(count, dtype=bool)
    score, log_focal, iterations, hypotheses = ransac_kernel(
        Objective(
            options.free,
            Keypoints(
                np.ascontiguousarray(points[order]), views.rays[0], views.whitening[0], LINEAR, 1.0
            ),
            ScalePrior(options.prior_weight),
        ),
        views,
        np.log(views.focals),
        LogFocalPrior(*log_focal_range(camera, options.focal_prior)),
        ranked,
        Settings(
            threshold=float(ransac.max_reproj_error),
            minimal=minimal,
            size=size,
            max_iterations=_MOST_EXHAUSTIVE if exhaustive else int(ransac.max_iterations),
            min_iterations=_MOST_EXHAUSTIVE if exhaustive else int(ransac.min_iterations),
            success_prob=float(ransac.success_prob),
            seed=int(ransac.seed),
            exhaustive=exhaustive,
            guided=by_confidence is not None,
            optimize=ransac.refine,
            estimate_focal=options.focal == "estimate",
        ),
        pose,
        inliers,
    )
    if not hypotheses and are_in_one_plane(points):
        raise DegenerateError(
            "all keypoints lie in one plane, where the samples of ransac determine nothing",
            where="points_3d",
            fix="leave ransac away: use loss='cauchy', with stretch= or scale_prior_sigma=",
        )
    if options.focal == "estimate":
        camera = camera.with_focal(math.exp(log_focal))
    alignment = Alignment.from_packed(options.in_model_axes(pose))
    kept = np.empty(count, dtype=bool)
    kept[order] = inliers
    residuals = _residuals_of(problems, alignment, camera)
    check_support(
        [
            Support(
                np.linalg.norm(residuals[kept], axis=1),
                count,
                area_of(problems.points_2d, camera, ransac.max_reproj_error),
            )
        ],
        size + (options.focal == "estimate"),  # which half a keypoint determines
        max_reproj_error=ransac.max_reproj_error,
        score=float(score),
        where="points_2d",
    )
    return Consensus(
        alignment, camera, kept, residuals, int(iterations), int(hypotheses), float(score)
    )


def _views(points_2d: FloatArray, camera: Camera, options: FitOptions) -> Views:
    """Rays and weights, in pixels, at the camera's focal length or at those to be tried."""
    if options.focal == "estimate":
        return focal_views(points_2d, camera, options.focal_prior, None)
    camera.require_focal()
    rays = rays_of(points_2d, camera)
    return Views(np.array([camera.fx]), rays[None], whitening_of(1.0, rays, camera)[None])


def _residuals_of(problems: Problems, alignment: Alignment, camera: Camera) -> FloatArray:
    """Projected minus observed keypoints (n, 2) of the only problem; infinite behind the camera."""
    projected = camera.project_where_ahead(alignment.apply(problems.points_3d))
    return projected - problems.points_2d


class Support(NamedTuple):
    """Keypoints that support one pose.

    Their ``errors`` (k,) [px], the number of ``given`` keypoints, and the ``area`` [px^2] over
    which outliers are scattered.
    """

    errors: FloatArray
    given: int
    area: float


def area_of(points_2d: FloatArray, camera: Camera, max_reproj_error: float) -> float:
    """The area [px^2] over which the outliers among keypoints (n, 2) are scattered."""
    extent = np.ptp(points_2d, axis=0) + 2 * max_reproj_error
    return min(float(np.prod(extent)), float(camera.width) * float(camera.height))


def check_support(
    supports: Sequence[Support],
    size: int,
    *,
    max_reproj_error: float,
    score: float,
    where: str,
) -> None:
    """Refuse an estimate whose poses have no more support together than chance gives.

    ``size`` keypoints determine a pose; ``score`` is the truncated sum of squares [px^2].

    Raises
    ------
    NoConsensusError
        It carries the score.
    """
    logarithm = sum(min(0.0, _log_expected_by_chance(each, size)) for each in supports)
    if np.isfinite(score) and logarithm <= math.log(_CHANCE):
        return
    inliers, count = sum(len(each.errors) for each in supports), sum(n for _, n, _ in supports)
    raise NoConsensusError(
        f"no alignment is supported: the best has {inliers} of {count} keypoints within "
        f"{max_reproj_error:g} px, which chance gives as well (score {score:.4g} px^2)",
        where=where,
        fix="check the correspondences and the camera, or raise max_reproj_error or max_iterations",
        score=score,
        inliers=inliers,
    )


def order_of_confidence(
    confidences: npt.ArrayLike | None, count: int
) -> npt.NDArray[np.intp] | None:
    """The order of falling confidence; None where there are none, or all are alike."""
    if confidences is None:
        return None
    values = as_floats(confidences, name="confidences", shape=(count,))
    if (values < 0).any():
        raise InputError(
            f"keypoint {int(np.argmax(values < 0))} has the confidence {values.min():g}",
            where="confidences",
            fix="give numbers that are not negative",
        )
    return np.argsort(-values, kind="stable") if np.ptp(values) > 0 else None


def _log_expected_by_chance(support: Support, size: int) -> float:
    """Log of the expected number of models as well supported among keypoints scattered at random.

    Moisan, Stival, "A probabilistic criterion to detect rigid point matches between two images and
    estimate the fundamental matrix", 2004: for the k best supported keypoints, each a sample of
    ``size`` keypoints, all choices of k keypoints and of a sample among them are counted, and the
    chance that the others lie within the largest of the k errors; the least such number over k
    (over the smallest dozen and all of them, which is where it lies).
    """
    errors, count, area = support
    if len(errors) <= size:
        return math.inf
    radii = np.maximum(np.sort(errors), _LEAST_ERROR)
    logarithms = [
        math.log(MAX_SOLUTIONS * (count - size))
        + _log_choose(count, k)
        + _log_choose(k, size)
        + (k - size) * min(0.0, math.log(math.pi * radii[k - 1] ** 2 / area))
        for k in {*range(size + 1, min(size + 12, len(errors) + 1)), len(errors)}
    ]
    return float(min(logarithms))


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
