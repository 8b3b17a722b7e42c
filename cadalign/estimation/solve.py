"""Solving of packed problems: methods, estimated noise, status codes to errors, alternatives."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray, read_only
from cadalign.errors import CadalignError
from cadalign.estimation.focal import check_estimable
from cadalign.estimation.options import LOSSES, FitOptions, Sigma
from cadalign.estimation.problems import (
    Problems,
    Solutions,
    check_sigmas,
    full_covariance,
    no_redundancy_error,
    rays_of,
    solver_error,
    whitening_of,
)
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import (
    Camera,
    faced,
    needs_facing,
    turned_covariance,
    turned_poses,
)
from cadalign.solvers.constants import OK, OUT_OF_RANGE, POSE_SIZE
from cadalign.solvers.linear import aepnp_batch
from cadalign.solvers.optimal import optimal_batch, rigid_flag
from cadalign.solvers.projection import pinhole_rays, reproject_batch

_SIGMA_ROUNDS = 20
_BOUNDED_ROUNDS = 4  # where only the bound of the scales depends on sigma
_SIGMA_TOLERANCE = 1e-3
# No keypoint is known better, over the keypoints' spread in the image: keeps a perfect fit from
# claiming to be certain of everything.
_LEAST_SIGMA = 1e-6
_HIGHEST_QUANTILE = 0.95  # of the residuals' lengths that a robust sigma is taken from
_EXACT_COST = 1e-6
_TINY = 1e-100
_NUMBER = int | float
# Minima, iterations, hypotheses, undetermined unknown of a method that makes one guess.
_ONE_MINIMUM = read_only(np.array([[1, 0, 1, -1]]))
_NO_COST = read_only(np.array([[np.inf]]))

Errors = dict[int, CadalignError]
LEAST_LIKELIHOOD = 1e-3
"""Relative likelihood above which another minimum is reported as an alternative."""


def solve(
    problems: Problems, options: FitOptions, sigmas: Sequence[Sigma] | None = None
) -> Solutions:
    """Solve every problem with the method of the options.

    ``sigmas``, one for each problem, takes the place of the options' sigma. A problem whose focal
    length is estimated is the only one.
    """
    if options.method == "aepnp" and sigmas is None:
        short = _solve_one_linearly(problems, options)
        if short is not None:
            return short
    if needs_facing(problems.cameras):
        return _solve_facing(problems, options, sigmas)
    points = problems.points_3d
    if options.known_axis != "x":
        points = np.ascontiguousarray(points[:, options.axis_order])
    if options.focal == "known":
        for camera in problems.cameras:
            camera.require_focal()
    else:
        check_estimable(problems.cameras)
    if options.method != "optimal" and not _is_one_sigma(options.sigma, sigmas):
        # The other methods would not notice a wrong one.
        check_sigmas([options.sigma] if sigmas is None else sigmas, problems.counts)
    if options.method == "optimal":
        found = _solve_optimal(problems, options, points, sigmas)
    elif options.method == "aepnp":
        rays, errors = _rays(problems)
        found = _one_minimum(*aepnp_batch(points, rays, problems.offsets), errors)
    else:
        found = _solve_baseline(problems, options, points)
    residuals, statuses = _residuals(problems, points, found)
    found = found._replace(residuals=residuals, statuses=statuses)
    if np.count_nonzero(statuses):
        errors = {
            b: solver_error(
                statuses[b], found.info[b, 3], problems.points_3d[problems.rows(b)], options
            )
            for b in np.flatnonzero(statuses).tolist()
            if b not in found.errors
        }
        found = found._replace(errors={**found.errors, **errors})
    if options.known_axis == "x":
        return found
    covariances = found.covariances
    if covariances is not None and options.known_axis == "y":  # solved as z, x
        swapped = [0, 1, 2, 3, 4, 5, 7, 6, 8][: covariances.shape[1]]
        covariances = covariances[:, swapped][:, :, swapped]
    return found._replace(poses=options.in_model_axes(found.poses), covariances=covariances)


def _solve_facing(
    problems: Problems, options: FitOptions, sigmas: Sequence[Sigma] | None
) -> Solutions:
    """Solve in frames that face the keypoints of wide lenses."""
    every = range(len(problems))
    cameras = [faced(problems.camera(b), problems.points_2d[problems.rows(b)]) for b in every]
    found = solve(replace(problems, cameras=tuple(cameras)), options, sigmas)
    poses, covariances = found.poses.copy(), found.covariances
    covariances = None if covariances is None else covariances.copy()
    for b in every:
        turn = cameras[b].lens_from_camera
        poses[b] = turned_poses(found.poses[b], turn)
        if covariances is not None:
            covariances[b] = turned_covariance(covariances[b], turn)
    return found._replace(poses=poses, covariances=covariances)


def _solve_one_linearly(problems: Problems, options: FitOptions) -> Solutions | None:
    """The linear solution of a single plain problem; None of any other, and where it fails.

    The short way of the usual call, which would otherwise take longer than its kernels.
    """
    if len(problems.offsets) != 2:
        return None
    camera = problems.cameras[0]
    plain = options.known_axis == "x" and camera.focal_known
    if not plain or camera.distortion or not _is_one_sigma(options.sigma, None):
        return None
    points, pixels, offsets = problems.points_3d, problems.points_2d, problems.offsets
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    poses, solved = aepnp_batch(points, pinhole_rays(pixels, fx, fy, cx, cy), offsets)
    calibration = np.array([[fx, fy, cx, cy]])
    residuals, statuses = reproject_batch(points, pixels, offsets, poses, calibration, solved)
    if statuses[0] != OK:
        return None
    return Solutions(poses, _NO_COST, None, statuses, _ONE_MINIMUM, residuals=residuals)


def _is_one_sigma(sigma: Sigma | None, sigmas: Sequence[Sigma] | None) -> bool:
    """True for one positive number, which needs no further check."""
    return sigmas is None and type(sigma) is float and 0.0 < sigma < math.inf


def _rays(problems: Problems) -> tuple[FloatArray, Errors]:
    """Normalised image coordinates (n, 2) of all problems, and errors by problem."""
    if len(problems.cameras) == 1 and (len(problems) == 1 or not problems.cameras[0].distortion):
        return rays_of(problems.points_2d, problems.cameras[0]), {}
    rays = np.zeros_like(problems.points_2d)
    errors: Errors = {}
    for b in range(len(problems)):
        rows = problems.rows(b)
        try:
            rays[rows] = rays_of(problems.points_2d[rows], problems.camera(b))
        except CadalignError as error:
            errors[b] = error
    return rays, errors


def _whitening(
    problems: Problems, options: FitOptions, rays: FloatArray, sigmas: Sequence[Sigma] | None
) -> FloatArray:
    """Weights (1 or n, 3) of the residuals of all problems."""
    if sigmas is None and len(problems.cameras) == 1:
        return whitening_of(options.sigma, rays, problems.cameras[0])
    weights = np.empty((len(rays), 3))
    for b in range(len(problems)):
        rows = problems.rows(b)
        sigma = options.sigma if sigmas is None else sigmas[b]
        weights[rows] = whitening_of(sigma, rays[rows], problems.camera(b))
    return weights


def _solve_optimal(
    problems: Problems,
    options: FitOptions,
    points: FloatArray,
    sigmas: Sequence[Sigma] | None,
    rounds: int | None = None,
) -> Solutions:
    """The likeliest solutions, with sigma estimated in so many rounds where it is unknown."""
    search: Callable[..., Solutions]
    if options.focal == "estimate":
        # Only here: its kernels take time to import, and most cameras are calibrated.
        from cadalign.estimation.focal_search import search_focal

        search = partial(search_focal, problems, options, points)
    else:
        rays, errors = _rays(problems)
        whitening = _whitening(problems, options, rays, sigmas)
        search = partial(_search_poses, problems, options, points, rays, whitening, errors)
    if options.sigma is None and sigmas is None:
        most = rounds or (_SIGMA_ROUNDS if options.estimates_in_rounds else 1)
        found = _with_estimated_sigmas(problems, options, points, search, most)
        if most == 1:
            found = _with_bounded_repeated(problems, options, points, found)
    else:
        found = search(np.ones(len(problems)))
    exact = 2 * problems.counts == options.unknowns
    if not exact.any():
        return found
    if options.focal == "known" and options.sigma is not None:
        unbounded = search(np.ones(len(problems)), is_bounded=False)
        # Where none fits exactly without a bound, this keeps the optimum from running off.
        chosen = exact & (unbounded.costs[:, 0] < _EXACT_COST)
        for name in ("poses", "costs", "covariances", "statuses", "info"):
            getattr(found, name)[chosen] = getattr(unbounded, name)[chosen]
    return _with_exact_sorted(found, exact & (found.info[:, 0] > 1))


def _search_poses(
    problems: Problems,
    options: FitOptions,
    points: FloatArray,
    rays: FloatArray,
    whitening: FloatArray,
    errors: Errors,
    noises: FloatArray,
    is_bounded: bool = True,
) -> Solutions:
    """Search at known focal lengths; ``noises`` (B,) multiply priors' sigmas and loss scales."""
    given = points, rays, whitening, problems.offsets
    weight, width = options.scale_prior if is_bounded else (options.prior_weight, 0.0)
    scales = options.loss_scale * noises, weight * noises**2, width
    loss, free = LOSSES[options.loss], options.free
    rigid = rigid_flag(loss, free)
    minima = optimal_batch(*given, loss, *scales, free, options.min_points, rigid)
    return Solutions(*minima, errors=errors)


def _with_estimated_sigmas(
    problems: Problems,
    options: FitOptions,
    points: FloatArray,
    search: Callable[[FloatArray], Solutions],
    rounds: int,
) -> Solutions:
    """Search with the standard deviations that the residuals have.

    They matter to the optimum where there is something beside the keypoints. Rounds end where they
    converge, or go in circles: of two optima, each may be the better one at the other's noise.
    """
    sigmas, earlier = np.ones(len(problems)), list[FloatArray]()
    for _ in range(rounds):
        found = search(sigmas)
        earlier.append(sigmas)
        sigmas = _estimate_sigmas(problems, options, points, found)
        repeats = (np.allclose(sigmas, one, rtol=_SIGMA_TOLERANCE, atol=0) for one in earlier)
        if rounds == 1 or any(repeats):
            break
    assert found.covariances is not None
    covariances = found.covariances * (sigmas**2)[:, None, None]
    overflows = ~np.isfinite(covariances).all(axis=(1, 2)) & (found.statuses == OK)
    exact = np.flatnonzero(2 * problems.distinct_counts <= options.unknowns).tolist()
    too_few = {b: no_redundancy_error(int(problems.distinct_counts[b])) for b in exact}
    return found._replace(
        costs=found.costs / sigmas[:, None] ** 2,
        covariances=covariances,
        statuses=np.where(overflows, OUT_OF_RANGE, found.statuses),
        sigmas=sigmas,
        errors={**found.errors, **too_few},
    )


def _with_bounded_repeated(
    problems: Problems, options: FitOptions, points: FloatArray, found: Solutions
) -> Solutions:
    """The solutions, those of which the bounding prior holds a scale solved anew in rounds."""
    usual, scales = math.exp(options.scale_prior.width), found.poses[:, 0, 13:]
    if scales.max(initial=1.0) <= usual and scales.min(initial=1.0) >= 1 / usual:
        return found
    outside = ((scales > usual) | (scales < 1 / usual)).any(axis=1) & (found.statuses == OK)
    errors = dict(found.errors)
    for b in np.flatnonzero(outside).tolist():
        own = points[problems.rows(b)]
        one = _solve_optimal(problems.part(b, b + 1), options, own, None, _BOUNDED_ROUNDS)
        for name in ("poses", "costs", "covariances", "statuses", "info", "sigmas"):
            if (values := getattr(found, name)) is not None:
                values[b] = getattr(one, name)[0]
        if one.errors:
            errors[b] = one.errors[0]
    return found._replace(errors=errors)


def _estimate_sigmas(
    problems: Problems, options: FitOptions, points: FloatArray, found: Solutions
) -> FloatArray:
    """Standard deviations (B,) [px] from the sum of squares, or an order statistic if robust.

    Keypoints that are given repeatedly count once for the redundancy.
    """
    residuals, _ = _residuals(problems, points, found)
    sigmas = np.ones(len(problems))
    for b in range(len(problems)):
        rows = problems.rows(b)
        squares = (residuals[rows] ** 2).sum(axis=1)
        if not len(squares):
            continue  # refused later, as with a known sigma
        redundancy = max(2 * int(problems.distinct_counts[b]) - options.unknowns, 1)
        if options.loss == "linear":
            sigma = np.sqrt(squares.sum() / redundancy)
        else:
            sigma = _robust_sigma(squares, redundancy)
        least = _LEAST_SIGMA * np.sqrt(problems.points_2d[rows].var(axis=0).sum())
        sigmas[b] = max(sigma, least, _TINY) if np.isfinite(sigma) else 1.0
    return sigmas


def _robust_sigma(squares: FloatArray, redundancy: int) -> float:
    """Standard deviation [px] from a quantile of the squared lengths (n,) of residuals.

    The unknowns can make as many keypoints fit exactly as they have equations. The quantile is the
    median of the others' lengths: that of all would be zero with few keypoints.
    """
    count = len(squares)
    place = math.ceil(count - redundancy / 4)
    quantile = min((place - 0.5) / count, _HIGHEST_QUANTILE)
    expected = -2 * math.log(1 - quantile) * redundancy / (2 * count)
    return math.sqrt(float(np.partition(squares, place - 1)[place - 1]) / expected)


def _residuals(
    problems: Problems, points: FloatArray, found: Solutions
) -> tuple[FloatArray, IntArray]:
    """Projected minus observed keypoints (n, 2) [px], and the statuses (B,) that follow."""
    if found.focals is not None and found.info[0, 0]:
        problems = replace(problems, cameras=(camera_of(problems, found, 0),))
    given = points, problems.points_2d, problems.offsets
    residuals, statuses = reproject_batch(
        *given, found.poses, problems.calibrations, found.statuses
    )
    if not any(camera.distortion for camera in problems.cameras):
        return residuals, statuses
    for b in range(len(problems)):
        camera, rows = problems.camera(b), problems.rows(b)
        if camera.distortion and statuses[b] == OK and b not in found.errors:
            pixels = problems.points_2d[rows] + residuals[rows]
            rays = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
            residuals[rows] = camera.pixels_from_normalized(rays) - problems.points_2d[rows]
            if not np.isfinite(residuals[rows]).all():
                statuses[b] = OUT_OF_RANGE
    return residuals, statuses


def _with_exact_sorted(found: Solutions, exact: BoolArray) -> Solutions:
    """Keep solutions that fit exactly, by stretch, where ``exact`` (B,) marks such problems."""
    order = np.tile(np.arange(found.costs.shape[1]), (len(found.costs), 1))
    for b in np.flatnonzero(exact).tolist():
        count = int((found.costs[b, : found.info[b, 0]] < _EXACT_COST).sum())
        found.info[b, 0] = count or found.info[b, 0]
        stretch = (np.log(found.poses[b, :count, 13:]) ** 2).sum(axis=1)
        order[b, :count] = np.argsort(stretch, kind="stable")
    return found._replace(
        poses=np.take_along_axis(found.poses, order[:, :, None], axis=1),
        costs=np.take_along_axis(found.costs, order, axis=1),
        focals=None if found.focals is None else np.take_along_axis(found.focals, order, axis=1),
    )


def _solve_baseline(problems: Problems, options: FitOptions, points: FloatArray) -> Solutions:
    from cadalign.solvers.baselines import aepnp_paper, epnp

    solver = epnp if options.method == "epnp" else aepnp_paper
    rays, errors = _rays(problems)
    poses = np.zeros((len(problems), 1, POSE_SIZE))
    for b in range(len(problems)):
        rows = problems.rows(b)
        try:
            rotation, translation, scale = solver(points[rows], rays[rows])
            poses[b, 0] = np.concatenate([rotation.ravel(), translation, scale])
        except CadalignError as error:
            errors.setdefault(b, error)
    return _one_minimum(poses, np.zeros(len(problems), dtype=np.int64), errors)


def _one_minimum(poses: FloatArray, statuses: IntArray, errors: Errors) -> Solutions:
    """The solutions of a method that supports neither noise nor alternatives."""
    costs = np.empty(poses.shape[:2])
    costs.fill(np.inf)
    info = np.empty((len(poses), 4), dtype=np.int64)
    info[:] = _ONE_MINIMUM
    return Solutions(poses, costs, None, statuses, info, errors=errors)


def solve_one(problems: Problems, options: FitOptions) -> Solutions:
    """Solve the only problem.

    Raises CadalignError if it has no solution.
    """
    solutions = solve(problems, options)
    if solutions.errors:
        raise solutions.errors[0]
    return solutions


def camera_of(problems: Problems, solutions: Solutions, minimum: int) -> Camera:
    """The camera that goes with a minimum of the only problem."""
    camera = problems.cameras[0]
    return camera if solutions.focals is None else camera.with_focal(solutions.focals[0, minimum])


def fitted_fields(problems: Problems, solutions: Solutions, options: FitOptions) -> dict[str, Any]:
    """The fields of `FittedKeypoints` of the only problem, which has a solution."""
    sigma = covariance = None
    if solutions.sigmas is not None:
        sigma = float(solutions.sigmas[0])
    elif options.method == "optimal" and isinstance(options.sigma, _NUMBER):
        sigma = float(options.sigma)
    if solutions.covariances is not None:
        covariance = full_covariance(solutions.covariances[0], options.known_axis)
    inliers = np.empty(len(problems.points_3d), dtype=bool)
    inliers.fill(True)
    return {
        "points_3d": problems.points_3d.copy(),  # the caller may go on to change theirs
        "residuals": solutions.residuals,
        "inliers": inliers,
        "alignment": Alignment.from_packed(solutions.poses[0, 0]),
        "camera": camera_of(problems, solutions, 0),
        "options": options,
        "sigma": sigma,
        "fisher_covariance": covariance,
    }
