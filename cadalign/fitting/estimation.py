"""Solving packed problems: the methods, and the standard deviation where it is not known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import CadalignError
from cadalign.fitting.degeneracy import no_redundancy_error, solver_error
from cadalign.fitting.focal.search import Minima, search_focal
from cadalign.fitting.noise import rays_of, whitening_of
from cadalign.fitting.options import LOSSES, FitOptions, Sigma
from cadalign.fitting.problems import Problems
from cadalign.geometry.camera import Camera
from cadalign.solvers.batch import aepnp_batch, optimal_batch, reproject_batch
from cadalign.solvers.constants import POSE_SIZE

_SIGMA_ROUNDS = 20
_SIGMA_TOLERANCE = 1e-3
# Median length of a two-dimensional Gaussian error of unit standard deviation: sqrt(2 ln 2).
_RAYLEIGH_MEDIAN = 1.1774100225154747
# Errors of the model's shape aside, no keypoint is known better: keeps a perfect fit from
# claiming to be certain of everything.
_LEAST_SIGMA = 1e-9
_EXACT_COST = 1e-6
# Minima, iterations, hypotheses, undetermined unknown of a method that makes one guess.
_ONE_MINIMUM = np.array([1, 0, 1, -1])


Solver = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
Search = Callable[[FloatArray], Minima]


@dataclass(frozen=True, eq=False)
class Solutions:
    """What a method found for every problem.

    Parameters
    ----------
    poses : (B, k, 15) float
        Packed alignments, the best first.
    costs : (B, k) float
        Their whitened squared errors with sigma; infinite where there is none.
    covariances : (B, 8, 8) or (B, 9, 9) float or None
    sigmas : (B,) float or None
        Standard deviations [px] where there is one for all keypoints of a problem.
    statuses : (B,) int
        See `cadalign.solvers.status`.
    info : (B, 4) int
        Minima, iterations, hypotheses, undetermined unknown or -1.
    residuals : (n, 2) float
        Projected minus observed [px].
    errors : dict of int to CadalignError
        Why a problem has no solution.
    focals : (B, k) float, optional
        The focal lengths of the poses [px], where they were estimated.
    """

    poses: FloatArray
    costs: FloatArray
    covariances: FloatArray | None
    sigmas: FloatArray | None
    statuses: IntArray
    info: IntArray
    residuals: FloatArray
    errors: dict[int, CadalignError]
    focals: FloatArray | None = None

    def camera(self, problems: Problems, minimum: int) -> Camera:
        """The camera that goes with a minimum of the only problem."""
        camera = problems.cameras[0]
        return camera if self.focals is None else camera.with_focal(self.focals[0, minimum])


def solve(
    problems: Problems, options: FitOptions, sigmas: Sequence[Sigma] | None = None
) -> Solutions:
    """Solve every problem with the method of the options.

    ``sigmas``, one for each problem, takes the place of the options' sigma.
    """
    errors: dict[int, CadalignError] = {}
    points = problems.points_3d
    if options.known_axis != "x":
        points = np.ascontiguousarray(points[:, options.axis_order])
    if options.focal == "known":
        for camera in problems.cameras:
            camera.require_focal()
    if options.method == "optimal":
        solutions = _solve_optimal(problems, options, points, sigmas, errors)
    elif options.method == "aepnp":
        poses, statuses = aepnp_batch(points, _rays(problems, errors), problems.offsets)
        solutions = _without_statistics(problems, poses, statuses, errors)
    else:
        poses = _solve_one_by_one(problems, options, points, _rays(problems, errors), errors)
        statuses = np.zeros(len(problems), dtype=np.int64)
        solutions = _without_statistics(problems, poses, statuses, errors)
    if options.known_axis != "x":
        _restore_axes(solutions, options)
    if solutions.focals is not None:
        problems = problems.with_focals(solutions.focals[:, 0])
    _reproject(problems, solutions)
    if np.count_nonzero(solutions.statuses):
        for b in np.flatnonzero(solutions.statuses).tolist():
            error = solver_error(
                int(solutions.statuses[b]),
                int(solutions.info[b, 3]),
                problems.points_3d[problems.rows(b)],
                options,
            )
            errors.setdefault(b, error)
    return solutions


def _rays(problems: Problems, errors: dict[int, CadalignError]) -> FloatArray:
    """Normalised image coordinates (n, 2) of all problems."""
    if len(problems.cameras) == 1 and (len(problems) == 1 or not problems.cameras[0].distortion):
        return rays_of(problems.points_2d, problems.cameras[0])
    rays = np.zeros_like(problems.points_2d)
    for b in range(len(problems)):
        rows = problems.rows(b)
        try:
            rays[rows] = rays_of(problems.points_2d[rows], problems.camera(b))
        except CadalignError as error:
            errors[b] = error
    return rays


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
    errors: dict[int, CadalignError],
) -> Solutions:
    if options.focal == "estimate":
        search: Search = partial(search_focal, problems, options, points, sigmas, errors)
    else:
        search = _search_at_known_focal(problems, options, points, sigmas, errors)
    estimate = options.sigma is None and sigmas is None
    scales = np.ones(len(problems))
    for _ in range(_SIGMA_ROUNDS if estimate else 1):
        minima = search(scales)
        if estimate:
            previous = scales
            seen = problems if minima.focals is None else problems.with_focals(minima.focals[:, 0])
            scales = _estimate_sigmas(seen, options, points, minima.poses[:, 0])
            if not options.estimates_in_rounds or np.allclose(
                scales, previous, rtol=_SIGMA_TOLERANCE, atol=0
            ):
                break
    if estimate:
        minima.costs[:] /= scales[:, None] ** 2
        minima.covariances[:] *= (scales**2)[:, None, None]
        for b in np.flatnonzero(2 * problems.counts <= options.unknowns).tolist():
            errors[b] = no_redundancy_error(int(problems.counts[b]))
    exact = (2 * problems.counts == options.unknowns) & (minima.info[:, 0] > 1)
    if exact.any():
        for b in np.flatnonzero(exact).tolist():
            _sort_exact_solutions(minima, b)
    known = isinstance(options.sigma, int | float) and sigmas is None
    return Solutions(
        poses=minima.poses,
        costs=minima.costs,
        covariances=minima.covariances,
        sigmas=scales if estimate else np.full(len(problems), options.sigma) if known else None,
        statuses=minima.statuses,
        info=minima.info,
        residuals=np.empty_like(problems.points_2d),
        errors=errors,
        focals=minima.focals,
    )


def _search_at_known_focal(
    problems: Problems,
    options: FitOptions,
    points: FloatArray,
    sigmas: Sequence[Sigma] | None,
    errors: dict[int, CadalignError],
) -> Search:
    """The search as a function of the noises (B,) that priors and loss scales are multiplied by."""
    rays = _rays(problems, errors)
    whitening = _whitening(problems, options, rays, sigmas)

    def search(noises: FloatArray) -> Minima:
        return Minima(
            *optimal_batch(
                points,
                rays,
                whitening,
                problems.offsets,
                LOSSES[options.loss],
                options.loss_scale * noises,
                options.prior_weight * noises**2,
                options.free,
                options.min_points,
            )
        )

    return search


def _estimate_sigmas(
    problems: Problems, options: FitOptions, points: FloatArray, poses: FloatArray
) -> FloatArray:
    """Standard deviations (B,) of the keypoints from their residuals [px].

    From the sum of squares, or from the median where the loss is robust.
    """
    sigmas = np.ones(len(problems))
    for b in range(len(problems)):
        rows = problems.rows(b)
        rotation, translation, scale = unpack(poses[b])
        inside = (points[rows] * scale) @ rotation.T + translation
        with np.errstate(divide="ignore", invalid="ignore"):
            rays = inside[:, :2] / inside[:, 2:]
        errors = problems.camera(b).pixels_from_normalized(rays) - problems.points_2d[rows]
        squares = (errors**2).sum(axis=1)
        equations = 2 * len(squares)
        redundancy = max(equations - options.unknowns, 1)
        if options.loss == "linear":
            sigma = np.sqrt(squares.sum() / redundancy)
        else:
            sigma = np.sqrt(np.median(squares) * equations / redundancy) / _RAYLEIGH_MEDIAN
        sigmas[b] = max(sigma, _LEAST_SIGMA) if np.isfinite(sigma) else 1.0
    return sigmas


def _sort_exact_solutions(minima: Minima, problem: int) -> None:
    """Put solutions that all fit exactly into the order of least stretch."""
    poses, costs = minima.poses[problem], minima.costs[problem]
    exact = int((costs[: minima.info[problem, 0]] < _EXACT_COST).sum())
    stretch = (np.log(poses[:exact, 13:]) ** 2).sum(axis=1)
    order = np.argsort(stretch, kind="stable")
    poses[:exact] = poses[:exact][order]
    costs[:exact] = costs[:exact][order]
    if minima.focals is not None:
        minima.focals[problem, :exact] = minima.focals[problem, :exact][order]


def _solve_one_by_one(
    problems: Problems,
    options: FitOptions,
    points: FloatArray,
    rays: FloatArray,
    errors: dict[int, CadalignError],
) -> FloatArray:
    """Packed poses (B, 1, 15) of the yardsticks, which are not compiled."""
    solver = _yardstick(options.method)
    poses = np.zeros((len(problems), 1, POSE_SIZE))
    for b in range(len(problems)):
        rows = problems.rows(b)
        try:
            rotation, translation, scale = solver(points[rows], rays[rows])
            poses[b, 0] = np.concatenate([rotation.ravel(), translation, scale])
        except CadalignError as error:
            errors.setdefault(b, error)
    return poses


def _yardstick(method: str) -> Solver:
    if method == "epnp":
        from cadalign.solvers.opencv import epnp  # OpenCV takes longer to import than all the rest

        return epnp
    from cadalign.solvers.paper import aepnp_paper

    return aepnp_paper


def _without_statistics(
    problems: Problems, poses: FloatArray, statuses: IntArray, errors: dict[int, CadalignError]
) -> Solutions:
    """The solutions of a method that knows neither noise nor alternatives."""
    costs = np.empty(poses.shape[:2])
    costs.fill(np.inf)
    info = np.empty((len(problems), 4), dtype=np.int64)
    info[:] = _ONE_MINIMUM
    return Solutions(
        poses=poses,
        costs=costs,
        covariances=None,
        sigmas=None,
        statuses=statuses,
        info=info,
        residuals=np.empty_like(problems.points_2d),
        errors=errors,
    )


def unpack(pose: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rotation (3, 3), translation (3,) and scale (3,) of a packed pose, as copies."""
    return pose[:9].reshape(3, 3).copy(), pose[9:12].copy(), pose[12:].copy()


def _restore_axes(solutions: Solutions, options: FitOptions) -> None:
    """Turn alignments of the reordered model into alignments of the model."""
    place = np.argsort(options.axis_order)
    poses = solutions.poses
    shape = (*poses.shape[:2], 3, 3)
    poses[..., :9] = poses[..., :9].reshape(shape)[..., place].reshape(*shape[:2], 9)
    poses[..., 12:] = poses[..., 12:][..., place]
    if solutions.covariances is not None and options.known_axis == "y":  # solved as z, x
        swapped = [0, 1, 2, 3, 4, 5, 7, 6, 8][: solutions.covariances.shape[1]]
        solutions.covariances[:] = solutions.covariances[:, swapped][:, :, swapped]


def _reproject(problems: Problems, solutions: Solutions) -> None:
    """Fill in the residuals; problems with points behind the camera get that status."""
    solutions.residuals[:] = reproject_batch(
        problems.points_3d,
        problems.points_2d,
        problems.offsets,
        solutions.poses,
        problems.calibrations,
        solutions.statuses,
    )
    for b, camera in enumerate(problems.each_camera()):
        if camera.distortion and b not in solutions.errors:
            rows = problems.rows(b)
            pixels = problems.points_2d[rows] + solutions.residuals[rows]
            rays = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
            distorted = camera.pixels_from_normalized(rays)
            solutions.residuals[rows] = distorted - problems.points_2d[rows]
