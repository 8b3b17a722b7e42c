"""Fast path: solve packed keypoints of one camera with the solvers' kernels.

The noise is given, or estimated from the residuals.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray, IntArray, read_only
from cadalign.estimation.options import LOSSES, FitOptions
from cadalign.estimation.problems import (
    Problems,
    Solutions,
    no_redundancy_error,
    rays_of,
    solver_error,
    whitening_of,
)
from cadalign.estimation.result_parts import (
    FitStats,
    FittedKeypoints,
    alternatives_of,
    create_unchecked,
)
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera, face_pixels, rotate_covariance, rotate_poses
from cadalign.solvers.constants import OK, OUT_OF_RANGE
from cadalign.solvers.linear import aepnp_batch
from cadalign.solvers.optimal import optimal_batch, rigid_flag
from cadalign.solvers.projection import reproject_batch

_ROUNDS = 20
_TOLERANCE = 1e-3
# Least estimated sigma, relative to the keypoints' spread in the image, for perfect fits.
_LEAST_SIGMA = 1e-6
_HIGHEST_QUANTILE = 0.95  # of the residuals' lengths, for a robust sigma
_TINY = 1e-100
_EXACT_COST = 1e-6
# Minima, iterations, hypotheses and undetermined unknown of a linear method.
_ONE_MINIMUM = read_only(np.array([[1, 0, 1, -1]]))
_UNKNOWNS = read_only(np.array([0, 1, 2, 3, 4, 5, 7, 8]))  # rows of a covariance
_NO_COST = read_only(np.array([[np.inf]]))


def solve(problems: Problems, options: FitOptions) -> Solutions:
    """Solve all problems; a camera with distortion takes one. Raises CadalignError."""
    camera = problems.camera
    camera.require_focal()
    facing = face_pixels(camera, problems.points_2d) if camera.is_wide else camera
    points = problems.points_3d
    rays = rays_of(problems.points_2d, facing)
    whitening = whitening_of(options.sigma, rays, facing)  # checks sigma
    if options.method == "optimal":
        found = _optima(problems, options, points, rays, whitening)
    elif options.method == "aepnp":
        found = _single_solutions(*aepnp_batch(points, rays, problems.offsets))
    else:
        found = _baseline(options.method, points, rays)
    residuals, statuses = _residuals(problems, points, facing, found)
    errors = {
        b: solver_error(
            statuses[b], found.info[b, 3], problems.points_3d[problems.rows(b)], options
        )
        for b in statuses.nonzero()[0].tolist()
    }
    poses, covariances = found.poses, found.covariances
    if facing is not camera:
        poses = rotate_poses(poses[0], facing.lens_from_camera)[None]
        if covariances is not None:
            covariances = rotate_covariance(covariances, facing.lens_from_camera)
    return found._replace(
        poses=poses, covariances=covariances, residuals=residuals, statuses=statuses, errors=errors
    )


def are_solved_at_once(problems: Sequence[Problems], options: FitOptions) -> bool:
    """True if `solve` can take all problems in one call: equal cameras without distortion."""
    is_quick = options.focal == "known" and options.method in ("optimal", "aepnp")
    cameras = {each.camera for each in problems}
    has_lens = any(camera.is_wide or camera.distortion for camera in cameras)
    return is_quick and options.sigma is not None and len(cameras) == 1 and not has_lens


def _optima(
    problems: Problems,
    options: FitOptions,
    points: FloatArray,
    rays: FloatArray,
    whitening: FloatArray,
) -> Solutions:
    """The likeliest solutions, or all exact solutions of minimal problems."""
    loss, free, count = LOSSES[options.loss], options.free, len(problems)
    prior, bends = options.scale_prior, np.full(count, options.loss_scale)
    given = points, rays, whitening, problems.offsets, loss, bends, np.full(count, prior.weight)
    others = free, options.min_points, rigid_flag(loss, free)
    found = Solutions(*optimal_batch(*given, prior.width, *others))
    exact = 2 * problems.counts == options.unknowns
    if not exact.any():
        return found
    if not options.prior_weight:
        # The bound is only needed if no unbounded solution fits exactly.
        unbounded = Solutions(*optimal_batch(*given[:-1], np.zeros(count), 0.0, *others))
        chosen = exact & (unbounded.costs[:, 0] < _EXACT_COST)
        for name in ("poses", "costs", "covariances", "statuses", "info"):
            getattr(found, name)[chosen] = getattr(unbounded, name)[chosen]
    for b in np.flatnonzero(exact & (found.info[:, 0] > 1)).tolist():
        count = int((found.costs[b, : found.info[b, 0]] < _EXACT_COST).sum())
        found.info[b, 0] = count or found.info[b, 0]
        stretch = (np.log(found.poses[b, :count, 13:]) ** 2).sum(axis=1)
        order = np.argsort(stretch, kind="stable")
        found.poses[b, :count] = found.poses[b, order]
        found.costs[b, :count] = found.costs[b, order]
    return found


def _residuals(
    problems: Problems, points: FloatArray, camera: Camera, found: Solutions
) -> tuple[FloatArray, IntArray]:
    """Projected minus observed keypoints (n, 2) [px], and updated statuses (B,)."""
    pixels, offsets = problems.points_2d, problems.offsets
    pinhole = np.array([[camera.fx, camera.fy, camera.cx, camera.cy]])
    given = points, pixels, offsets, found.poses, pinhole
    residuals, statuses = reproject_batch(*given, found.statuses)
    if camera.distortion:  # one problem only
        rays = (pixels + residuals - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        residuals = camera.pixels_from_normalized(rays) - pixels
        if statuses[0] == OK and not np.isfinite(residuals).all():
            statuses[0] = OUT_OF_RANGE
    return residuals, statuses


def _baseline(method: str, points: FloatArray, rays: FloatArray) -> Solutions:
    from cadalign.solvers.baselines import aepnp_paper, epnp

    rotation, translation, scale = (epnp if method == "epnp" else aepnp_paper)(points, rays)
    pose = np.concatenate([rotation.ravel(), translation, scale])
    return _single_solutions(pose[None, None], np.zeros(1, dtype=np.int64))


def _single_solutions(poses: FloatArray, statuses: IntArray) -> Solutions:
    """Solutions of a method without noise and alternatives."""
    count = len(poses)  # np.tile takes as long as the linear solver
    return Solutions(
        poses, _NO_COST.repeat(count, 0), None, statuses, _ONE_MINIMUM.repeat(count, 0)
    )


def keypoints_of_solution(
    problems: Problems, solutions: Solutions, options: FitOptions, seconds: float
) -> FittedKeypoints:
    """The fitted keypoints of one problem with a solution."""
    minima, iterations, hypotheses, _ = solutions.info[0].tolist()
    points = problems.points_3d.copy()  # the caller may change the array
    is_one = options.method == "optimal" and isinstance(options.sigma, int | float)
    inliers = np.empty(len(points), dtype=bool)
    inliers.fill(True)
    fitted = {
        "points_3d": points,
        "residuals": solutions.residuals,
        "inliers": inliers,
        "alignment": Alignment.from_vector(solutions.poses[0, 0]),
        "camera": problems.camera,
        "options": options,
        "sigma": float(cast(float, options.sigma)) if is_one else None,
        "method": options.method,
    }
    if solutions.covariances is not None:
        covariance = np.zeros((9, 9))
        covariance[_UNKNOWNS[:, None], _UNKNOWNS] = solutions.covariances[0]
        fitted["fisher_covariance"] = covariance
        fitted["cost"] = solutions.costs.item(0)
    if minima > 1:
        poses = [Alignment.from_vector(pose) for pose in solutions.poses[0, :minima]]
        cameras, costs = [problems.camera] * minima, solutions.costs[0, :minima].tolist()
        fitted["alternatives"] = alternatives_of(points, poses, cameras, costs)
    effort = {"iterations": iterations, "hypotheses": hypotheses, "seconds": seconds}
    fitted["stats"] = create_unchecked(FitStats, effort)
    return create_unchecked(FittedKeypoints, fitted)


def fit_keypoints(problems: Problems, options: FitOptions, start: float) -> FittedKeypoints:
    """Fit all keypoints of one problem; the time starts at ``start`` [s].

    An unknown sigma is estimated from the residuals in rounds, until these converge or cycle
    between optima. Repeated keypoints count once for the redundancy. Raises DegenerateError
    without redundancy, since sigma is then undetermined.
    """
    if options.sigma is not None or options.method != "optimal":
        return _fit_at_noise(problems, options, start)
    distinct = len({*map(bytes, np.hstack([problems.points_3d, problems.points_2d]))})
    redundancy = 2 * distinct - options.unknowns
    if redundancy <= 0:
        raise no_redundancy_error(distinct)
    least = _LEAST_SIGMA * math.sqrt(problems.points_2d.var(axis=0).sum())
    sigma, tried = 1.0, list[float]()
    for _ in range(_ROUNDS):
        tried.append(sigma)
        found = _fit_at_noise(problems, replace(options, sigma=sigma), start)
        squares = (found.residuals**2).sum(axis=1)
        if options.loss == "linear":
            sigma = math.sqrt(squares.sum() / redundancy)
        else:
            sigma = _robust_sigma(squares, redundancy)
        sigma = max(sigma, least, _TINY)
        if any(abs(sigma / one - 1) < _TOLERANCE for one in tried):
            break
    return replace(found, options=options)


def _fit_at_noise(problems: Problems, options: FitOptions, start: float) -> FittedKeypoints:
    if options.focal == "known":
        solutions = solve(problems, options)
        if solutions.errors:
            raise solutions.errors[0]
        return keypoints_of_solution(problems, solutions, options, time.perf_counter() - start)
    # Imported here: most cameras are calibrated, and the kernels import slowly.
    from cadalign.estimation.joint import fit_jointly

    return fit_jointly(problems, options, None, None, start)


def _robust_sigma(squares: FloatArray, redundancy: int) -> float:
    """Standard deviation [px] from a quantile of the squared lengths (n,) of residuals.

    The unknowns may fit as many equations exactly: it is the median of the other keypoints.
    """
    count = len(squares)
    place = math.ceil(count - redundancy / 4)
    quantile = min((place - 0.5) / count, _HIGHEST_QUANTILE)
    expected = -2 * math.log(1 - quantile) * redundancy / (2 * count)
    return math.sqrt(float(np.partition(squares, place - 1)[place - 1]) / expected)
