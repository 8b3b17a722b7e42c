"""The optimum where the focal length is unknown: 9 unknowns, searched for globally.

The search begins at a grid of focal lengths, each with its rays and weights of the keypoints.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.focal import FocalPrior, focal_bounds, focal_grid, log_focal_range
from cadalign.estimation.options import LOSSES, FitOptions, Sigma
from cadalign.estimation.problems import Problems, Solutions, focal_slopes, rays_of, whitening_of
from cadalign.geometry.camera import Camera
from cadalign.solvers.alignment import Objective
from cadalign.solvers.constants import (
    DEGENERATE,
    NOT_FOUND,
    OK,
    OUT_OF_RANGE,
    POSE_SIZE,
    TOO_FEW,
    UNKNOWNS,
)
from cadalign.solvers.covariance import focal_covariance
from cadalign.solvers.evidence import Keypoints, LogFocalPrior, ScalePrior, Views, relative_to
from cadalign.solvers.focal import FocalObjective, linear_focal, refine_focal
from cadalign.solvers.optimal import MAX_MINIMA, optimal_batch
from cadalign.solvers.unknowns import has_collapsed, orthonormalize, uncenter

_MOST_STARTS = 8
_COARSE_POINTS = 256  # that many tell the minima apart; all points then refine them
_MOST_LIKELY = 3  # coarse minima that all points refine
_UNLIKELY = 40.0  # excess cost, over a unit variance, at which a coarse minimum is given up
_SAME_BRANCH = 0.6  # chord between rotations of one minimum at neighbouring focal lengths
_SAME_CHORD = 1e-3
_SAME_FOCAL = 0.01
_LENS_ROUNDS = 12
_LENS_TOLERANCE = 1e-10
_STEPS = 1000
_STEPS_OF_ALL_POINTS = 100  # from a minimum for some of them


@dataclass(frozen=True, eq=False)
class _Task:
    """One problem; priors and loss scales are multiples of ``noise``, a standard deviation."""

    points: FloatArray
    points_2d: FloatArray
    camera: Camera
    sigma: Sigma | None
    options: FitOptions
    noise: float

    def objective(self, focal: float) -> Objective:
        view = focal_view(self.points_2d, self.camera, focal, self.sigma)
        loss_scale = self.options.loss_scale * self.noise
        return Objective(
            self.options.free,
            Keypoints(self.points, *view, LOSSES[self.options.loss], loss_scale),
            ScalePrior(self.options.prior_weight * self.noise**2),
        )

    def thinned(self, most: int) -> _Task:
        """The task of at most ``most`` of its points, evenly spread over their order."""
        count = len(self.points)
        if count <= most:
            return self
        chosen = np.arange(most) * count // most
        sigma = self.sigma
        if sigma is not None and np.ndim(sigma) > 0:
            sigma = np.asarray(sigma, dtype=np.float64)[chosen]
        return replace(
            self,
            points=np.ascontiguousarray(self.points[chosen]),
            points_2d=np.ascontiguousarray(self.points_2d[chosen]),
            sigma=sigma,
        )

    @property
    def prior(self) -> LogFocalPrior:
        """Bounds and prior of the log focal length."""
        prior = LogFocalPrior(*log_focal_range(self.camera, self.options.focal_prior))
        return prior._replace(weight=prior.weight * self.noise**2)


@dataclass(frozen=True, eq=False)
class _Minimum:
    pose: FloatArray
    focal: float
    cost: float


def search_focal(
    problems: Problems,
    options: FitOptions,
    points: FloatArray,
    sigmas: Sequence[Sigma] | None,
    noises: FloatArray,
) -> Solutions:
    """Find the minima over alignment and focal length for every problem.

    The model ``points`` have the known axis first; ``sigmas`` take the place of the options' sigma;
    priors and loss scales are multiplied by ``noises`` (B,).
    """
    count = len(problems)
    poses = np.zeros((count, MAX_MINIMA, POSE_SIZE))
    costs = np.full((count, MAX_MINIMA), np.inf)
    focals = np.full((count, MAX_MINIMA), np.nan)
    covariances = np.zeros((count, UNKNOWNS + 1, UNKNOWNS + 1))
    statuses = np.full(count, OK)
    info = np.zeros((count, 4), dtype=np.int64)
    errors: dict[int, CadalignError] = {}
    for b in range(count):
        rows = problems.rows(b)
        sigma = options.sigma if sigmas is None else sigmas[b]
        task = _Task(
            points[rows], problems.points_2d[rows], problems.camera(b), sigma, options, noises[b]
        )
        if len(task.points) < options.min_points:
            statuses[b] = TOO_FEW
            continue
        try:
            minima, iterations, hypotheses = _minima(task)
            undetermined, covariances[b] = _covariance(task, minima[0]) if minima else (-1, 0.0)
        except InputError as error:  # the lens model cannot be undone
            errors[b] = error
            continue
        except np.linalg.LinAlgError:
            statuses[b] = OUT_OF_RANGE
            continue
        for k, minimum in enumerate(minima[:MAX_MINIMA]):
            poses[b, k], costs[b, k], focals[b, k] = minimum.pose, minimum.cost, minimum.focal
        info[b] = len(minima), iterations, hypotheses, undetermined
        if not minima:
            statuses[b] = NOT_FOUND
        elif undetermined >= 0:
            statuses[b] = DEGENERATE
        elif not np.isfinite(covariances[b]).all():
            statuses[b] = OUT_OF_RANGE
    return Solutions(poses, costs, covariances, statuses, info, focals=focals, errors=errors)


def _minima(task: _Task) -> tuple[list[_Minimum], int, int]:
    """All minima that the search finds, the best first; with iterations and hypotheses."""
    center = task.points.mean(axis=0)
    unit = float(np.sqrt(((task.points - center) ** 2).sum(axis=1).mean()))
    if not unit > 0:
        return [], 0, 0
    local = replace(task, points=(task.points - center) / unit)
    coarse = local.thinned(_COARSE_POINTS)
    starts, iterations, hypotheses = _starts(coarse)
    minima, used = _distinct_minima(coarse, starts, _STEPS)
    iterations += used
    if len(coarse.points) < len(local.points):
        likely = _likely(minima, len(coarse.points))
        minima, used = _distinct_minima(local, likely, _STEPS_OF_ALL_POINTS)
        iterations += used
    minima = [replace(minimum, pose=_uncentered(minimum.pose, center, unit)) for minimum in minima]
    return minima, iterations, hypotheses


def _distinct_minima(
    task: _Task, starts: Sequence[_Minimum], steps: int
) -> tuple[list[_Minimum], int]:
    """The minima below starts, the best first, and the iterations they took."""
    minima: list[_Minimum] = []
    iterations = 0
    for start in starts:
        minimum, used = _descend(task, start, steps)
        iterations += used
        if not minimum.cost < np.inf or has_collapsed(minimum.pose):
            continue
        if not any(_are_same(minimum, other) for other in minima):
            minima.append(minimum)
    return sorted(minima, key=lambda minimum: minimum.cost), iterations


def _likely(minima: Sequence[_Minimum], count: int) -> list[_Minimum]:
    """The minima for some of the points, ``count``, that all points may still prefer."""
    if not minima:
        return []
    # A wrong sigma should not make every other minimum look unlikely.
    variance = max(1.0, minima[0].cost / (2.0 * count - UNKNOWNS - 1))
    least = minima[0].cost
    return [each for each in minima[:_MOST_LIKELY] if each.cost - least < _UNLIKELY * variance]


def _uncentered(pose: FloatArray, center: FloatArray, unit: float) -> FloatArray:
    """The pose of points x, from that of points (x - center) / unit."""
    pose = pose.copy()
    orthonormalize(pose)
    uncenter(pose, center, unit)
    return pose


def _starts(task: _Task) -> tuple[list[_Minimum], int, int]:
    """Starts: the optima at fixed focal lengths that no neighbouring one improves on."""
    given = task.points_2d, task.camera
    views = _with_linear_guess(task, focal_views(*given, task.options.focal_prior, task.sigma))
    focals = views.focals
    count, n = len(focals), len(task.points)
    poses, costs, _, _, info = optimal_batch(
        np.tile(task.points, (count, 1)),
        views.rays.reshape(-1, 2),
        np.repeat(views.whitening, n // views.whitening.shape[1], axis=1).reshape(-1, 3),
        np.arange(count + 1) * n,
        LOSSES[task.options.loss],
        np.full(count, task.options.loss_scale * task.noise),
        np.full(count, task.options.prior_weight * task.noise**2),
        task.options.free,
        0,
    )
    prior = task.prior
    costs = costs + (prior.weight * (np.log(focals) - prior.center) ** 2)[:, None]
    starts: list[_Minimum] = []
    for flat in np.argsort(costs, axis=None, kind="stable").tolist():
        k, row = divmod(flat, MAX_MINIMA)
        if not costs[k, row] < np.inf or len(starts) == _MOST_STARTS:
            break
        around = [j for j in (k - 1, k + 1) if 0 <= j < count]
        turned = np.linalg.norm(poses[around, :, :9] - poses[k, row, :9], axis=-1) < _SAME_BRANCH
        if not (turned & (costs[around] < costs[k, row])).any():
            starts.append(_Minimum(poses[k, row].copy(), float(focals[k]), float(costs[k, row])))
    return starts, int(info[:, 1].sum()), int(info[:, 2].sum())


def _with_linear_guess(task: _Task, views: Views) -> Views:
    """The views, and among them that of the linear solver's focal length, where it has one."""
    middle = len(views.focals) // 2
    focal = float(views.focals[middle] * linear_focal(task.points, views.rays[middle]))
    low, high = focal_bounds(task.camera)
    if not low < focal < high:
        return views
    try:
        rays, whitening = focal_view(task.points_2d, task.camera, focal, task.sigma)
    except InputError:  # the lens model cannot be undone there
        return views
    place = int(np.searchsorted(views.focals, focal))
    return Views(
        np.insert(views.focals, place, focal),
        np.insert(views.rays, place, rays, axis=0),
        np.insert(views.whitening, place, whitening, axis=0),
    )


def _descend(task: _Task, start: _Minimum, steps: int) -> tuple[_Minimum, int]:
    """The minimum of all 9 unknowns below a start, and the iterations it took."""
    prior = task.prior
    pose, focal, cost = start.pose.copy(), start.focal, np.inf
    iterations = 0
    for _ in range(_LENS_ROUNDS if task.camera.distortion else 1):
        try:
            objective = task.objective(focal)
        except InputError:
            break
        slopes = focal_slopes(
            task.points_2d, task.camera.with_focal(focal), objective.keypoints.rays
        )
        here = relative_to(prior, math.log(focal))
        system = FocalObjective(objective, slopes, here)
        cost, moved, used = refine_focal(system, steps, pose)
        iterations += used
        focal *= float(np.exp(moved))
        if abs(moved) < _LENS_TOLERANCE:  # slopes are valid near the focal length of their rays
            break
    return _Minimum(pose, focal, float(cost)), iterations


def _are_same(first: _Minimum, second: _Minimum) -> bool:
    turned = np.linalg.norm(first.pose[:9] - second.pose[:9])
    stretched = np.linalg.norm(np.log(first.pose[13:] / second.pose[13:]))
    zoomed = abs(np.log(first.focal / second.focal))
    return bool(np.hypot(turned, stretched) < _SAME_CHORD and zoomed < _SAME_FOCAL)


def _covariance(task: _Task, minimum: _Minimum) -> tuple[int, FloatArray]:
    """The number of an undetermined unknown or -1, and the covariance (9, 9)."""
    objective = task.objective(minimum.focal)
    camera = task.camera.with_focal(minimum.focal)
    slopes = focal_slopes(task.points_2d, camera, objective.keypoints.rays)
    covariance = np.zeros((UNKNOWNS + 1, UNKNOWNS + 1))
    here = relative_to(task.prior, math.log(minimum.focal))
    system = FocalObjective(objective, slopes, here)
    undetermined = focal_covariance(system, minimum.pose, covariance)
    return int(undetermined), covariance


def focal_views(
    points_2d: FloatArray, camera: Camera, prior: FocalPrior | None, sigma: Sigma | None
) -> Views:
    """The keypoints at the focal lengths of `focal_grid` at which the lens can be undone."""
    found = []
    problem: InputError | None = None
    for focal in focal_grid(camera, prior).tolist():
        try:
            found.append((focal, *focal_view(points_2d, camera, focal, sigma)))
        except InputError as error:
            problem = error
    if not found and problem is not None:
        raise problem
    return Views(*map(np.array, zip(*found, strict=True)))


def focal_view(
    points_2d: FloatArray, camera: Camera, focal: float, sigma: Sigma | None
) -> tuple[FloatArray, FloatArray]:
    """Rays (n, 2) and weights (1 or n, 3) at one focal length [px]."""
    camera = camera.with_focal(focal)
    rays = rays_of(points_2d, camera)
    return rays, whitening_of(sigma, rays, camera)
