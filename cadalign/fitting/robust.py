"""Robust fitting: RANSAC over the minimal solver, for keypoints of which some are wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, as_floats
from cadalign.errors import DegenerateError, InputError, NoConsensusError
from cadalign.fitting.estimation import unpack
from cadalign.fitting.focal.grid import focal_views, log_limits
from cadalign.fitting.noise import rays_of, whitening_of
from cadalign.fitting.options import MINIMAL_SOLVERS, FitOptions, RansacOptions
from cadalign.fitting.problems import Problems
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.solvers.constants import LINEAR, SAMPLE_SIZES
from cadalign.solvers.focal_ransac import ransac_focal_kernel
from cadalign.solvers.minimal import MAX_SOLUTIONS
from cadalign.solvers.objective import Objective
from cadalign.solvers.ransac import ransac_kernel

_MOST_EXHAUSTIVE = 1000  # subsets that are all tried rather than drawn from
_CHANCE = 0.1  # expected number of models with as much support by chance
_FLAT = 1e-6  # thickness over extent of what counts as a plane
_LEAST_ERROR = 0.1  # no keypoint is taken to be better than that [px]


@dataclass(frozen=True, eq=False)
class Consensus:
    """What the search found for one problem.

    Parameters
    ----------
    alignment : Alignment
    camera : Camera
        With the focal length that goes with it, where that was unknown.
    inliers : (n,) bool
    score : float
        Sum of squared errors, each at most the threshold's square [px^2].
    iterations, hypotheses : int
    """

    alignment: Alignment
    camera: Camera
    inliers: BoolArray
    score: float
    iterations: int
    hypotheses: int


def find_consensus(
    problems: Problems,
    options: FitOptions,
    ransac: RansacOptions,
    confidences: npt.ArrayLike | None = None,
) -> Consensus:
    """Search for the alignment of the only problem that the most keypoints support.

    Parameters
    ----------
    problems : Problems
    options : FitOptions
        Known axis, stretch, and whether the focal length is known.
    ransac : RansacOptions
    confidences : (n,) float, optional
        How much each keypoint is trusted; samples are drawn from the highest first.

    Raises
    ------
    InputError
        If there are too few keypoints, a confidence is negative or NaN, or the minimal solver wants
        a focal length that is unknown.
    DegenerateError
        If all keypoints lie in one plane.
    NoConsensusError
        If no alignment has more support than chance gives; it carries the best score reached.
    """
    camera = problems.cameras[0]
    points = problems.points_3d[:, options.axis_order]
    points_2d = problems.points_2d
    count = len(points)
    size = SAMPLE_SIZES[MINIMAL_SOLVERS[ransac.minimal]]
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
    order = _by_confidence(confidences, count)
    guided = order is not None
    if order is None:
        order = np.arange(count)
    ordered_3d, ordered_2d = np.ascontiguousarray(points[order]), points_2d[order].copy()
    exhaustive = math.comb(count, size) <= _MOST_EXHAUSTIVE
    pose = np.zeros(15)
    inliers = np.zeros(count, dtype=bool)
    max_iterations = _MOST_EXHAUSTIVE if exhaustive else int(ransac.max_iterations)
    min_iterations = _MOST_EXHAUSTIVE if exhaustive else int(ransac.min_iterations)
    threshold = float(ransac.max_reproj_error)
    if options.focal == "known":
        camera.require_focal()
        rays = rays_of(ordered_2d, camera)
        weights = whitening_of(1.0, rays, camera)
        objective = _objective(ordered_3d, rays, weights, options)
        score, iterations, hypotheses = ransac_kernel(
            objective,
            threshold,
            MINIMAL_SOLVERS[ransac.minimal],
            max_iterations,
            min_iterations,
            float(ransac.success_prob),
            int(ransac.seed),
            exhaustive,
            guided,
            ransac.refine,
            pose,
            inliers,
        )
    else:
        views = focal_views(ordered_2d, camera, options.focal_prior)
        objective = _objective(ordered_3d, views.rays[0], views.whitening[0], options)
        score, log_focal, iterations, hypotheses = ransac_focal_kernel(
            objective,
            views.rays,
            views.whitening,
            np.log(views.focals),
            *log_limits(camera, options.focal_prior),
            *options.log_focal_prior,
            threshold,
            max_iterations,
            min_iterations,
            float(ransac.success_prob),
            int(ransac.seed),
            exhaustive,
            guided,
            ransac.refine,
            pose,
            inliers,
        )
        camera = camera.with_focal(math.exp(log_focal))
    if not hypotheses and _are_in_one_plane(points):
        raise DegenerateError(
            "all keypoints lie in one plane, where the samples of ransac determine nothing",
            where="points_3d",
            fix="leave ransac away: use loss='cauchy', with stretch= or scale_prior_sigma=",
        )
    rotation, translation, scale = unpack(pose)
    place = np.argsort(options.axis_order)
    alignment = Alignment.from_solver(rotation[:, place], translation, scale[place])
    kept = np.empty(count, dtype=bool)
    kept[order] = inliers
    support = int(kept.sum())
    errors = np.linalg.norm(residuals_of(problems, alignment, camera)[kept], axis=1)
    extent = np.ptp(points_2d, axis=0) + 2 * ransac.max_reproj_error
    area = min(float(np.prod(extent)), float(camera.width * camera.height))
    size += options.focal == "estimate"  # which half a keypoint determines
    if not np.isfinite(score) or _expected_by_chance(errors, count, size, area) > _CHANCE:
        raise NoConsensusError(
            f"no alignment is supported: the best has {support} of {count} keypoints within "
            f"{ransac.max_reproj_error:g} px, which chance gives as well (score {score:.4g} px^2)",
            where="points_2d",
            fix="check the correspondences and the camera, or raise max_reproj_error or "
            "max_iterations",
            score=float(score),
            inliers=support,
        )
    return Consensus(alignment, camera, kept, float(score), int(iterations), int(hypotheses))


def _objective(
    points: FloatArray, rays: FloatArray, whitening: FloatArray, options: FitOptions
) -> Objective:
    return Objective(points, rays, whitening, LINEAR, 1.0, options.prior_weight, options.free)


def _are_in_one_plane(points: FloatArray) -> bool:
    """Whether points that do not all coincide lie in a plane or on a line."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[0] > 0 and spread[2] <= _FLAT * spread[0])


def _by_confidence(confidences: npt.ArrayLike | None, count: int) -> npt.NDArray[np.intp] | None:
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


def _expected_by_chance(errors: FloatArray, count: int, size: int, area: float) -> float:
    """How many models as well supported are expected among keypoints scattered at random.

    Moisan, Stival, "A probabilistic criterion to detect rigid point matches between two images and
    estimate the fundamental matrix", 2004: for the k best supported keypoints, each a sample of
    ``size`` keypoints, all choices of k keypoints and of a sample among them are counted, and the
    chance that the others lie within the largest of the k errors; the least such number over k
    (over the smallest dozen and all of them, which is where it lies).

    Parameters
    ----------
    errors : (k,) float
        Lengths of the supporting keypoints' residuals [px].
    count : int
        How many keypoints there are in all.
    size : int
        How many determine a model.
    area : float
        Over which wrong keypoints are scattered [px^2].
    """
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
    return math.exp(min(700.0, *logarithms))


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)


def residuals_of(problems: Problems, alignment: Alignment, camera: Camera) -> FloatArray:
    """Projected minus observed keypoints (n, 2) of the only problem; infinite behind the camera."""
    in_camera = alignment.apply(problems.points_3d)
    ahead = in_camera[:, 2] > 0
    residuals = np.full((len(in_camera), 2), np.inf)
    rays = in_camera[ahead, :2] / in_camera[ahead, 2:]
    projected = camera.pixels_from_normalized(rays)
    residuals[ahead] = projected - problems.points_2d[ahead]
    return residuals
