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
from cadalign.estimation.focal import PriorOption, focal_bounds, focal_grid, log_focal_range
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
    ScalePrior,
)
from cadalign.solvers.evidence import KeypointEvidence, LogFocalPrior, Views
from cadalign.solvers.focal import FocalObjective, focal_covariance, linear_focal, refine_focal
from cadalign.solvers.optimal import MAX_MINIMA, optimal_batch
from cadalign.solvers.search import Effort, Minima, add_minimum, room_for_minima, search
from cadalign.solvers.unknowns import orthonormalize, uncenter

_MOST_STARTS = 8
_COARSE_POINTS = 256  # that many separate the minima; all points then refine them
_MOST_LIKELY = 3  # coarse minima that all points refine
_UNLIKELY = 40.0  # excess cost, over a unit variance, at which a coarse minimum is given up
_SAME_BRANCH = 0.6  # chord between rotations of one minimum at neighbouring focal lengths
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

    def system(self, focal: float) -> FocalObjective:
        rays, whitening = focal_view(self.points_2d, self.camera, focal, self.sigma)
        loss, bend = LOSSES[self.options.loss], self.options.loss_scale * self.noise
        prior = LogFocalPrior(*log_focal_range(self.camera, self.options.focal_prior, focal))
        return FocalObjective(
            Objective(
                self.options.free,
                KeypointEvidence(self.points, rays, whitening, loss, bend),
                self.scale_prior,
            ),
            focal_slopes(self.points_2d, self.camera.with_focal(focal), rays),
            prior._replace(weight=prior.weight * self.noise**2),
        )

    @property
    def scale_prior(self) -> ScalePrior:
        """The prior on the log scales, in units of the whitening's sigma."""
        weight, width = self.options.scale_prior
        return ScalePrior(weight * self.noise**2, width)

    def thinned(self, most: int) -> _Task:
        """The task of at most ``most`` of its points, evenly spread over their order."""
        count = len(self.points)
        if count <= most:
            return self
        chosen = np.arange(most) * count // most
        sigma = self.sigma
        if sigma is not None and np.ndim(sigma) > 0:
            sigma = np.asarray(sigma, dtype=np.float64)[chosen]
        points, pixels = self.points[chosen], self.points_2d[chosen]
        return replace(self, points=points, points_2d=pixels, sigma=sigma)


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
            found, undetermined = len(minima[0]), -1
            if found:
                system = task.system(float(minima[1][0]))
                undetermined = focal_covariance(system, minima[0][0], covariances[b])
        except InputError as error:  # the lens model cannot be undone
            errors[b] = error
            continue
        except np.linalg.LinAlgError:
            statuses[b] = OUT_OF_RANGE
            continue
        poses[b, :found], focals[b, :found], costs[b, :found] = minima
        info[b] = found, iterations, hypotheses, undetermined
        if not found:
            statuses[b] = NOT_FOUND
        elif undetermined >= 0:
            statuses[b] = DEGENERATE
        elif not np.isfinite(covariances[b]).all():
            statuses[b] = OUT_OF_RANGE
    return Solutions(poses, costs, covariances, statuses, info, focals=focals, errors=errors)


def _minima(task: _Task) -> tuple[tuple[FloatArray, FloatArray, FloatArray], int, int]:
    """Minima, the best first, and the iterations and hypotheses that they took.

    Poses (k, 15), focal lengths (k,) [px] and costs (k,).
    """
    center = task.points.mean(axis=0)
    unit = float(np.sqrt(((task.points - center) ** 2).sum(axis=1).mean()))
    if not unit > 0:
        return (np.empty((0, POSE_SIZE)), np.empty(0), np.empty(0)), 0, 0
    local = replace(task, points=(task.points - center) / unit)
    coarse = local.thinned(_COARSE_POINTS)
    reference, starts, iterations, hypotheses = _starts(coarse)
    minima = _below(coarse, reference, starts, _STEPS)
    if coarse is not local:
        iterations += int(minima.counts[1])
        costs = minima.costs[: min(int(minima.counts[0]), _MOST_LIKELY)]
        # A wrong sigma should not make every other minimum look unlikely.
        variance = max(1.0, minima.costs[0] / (2.0 * len(coarse.points) - UNKNOWNS - 1))
        likely = int((costs - minima.costs[0] < _UNLIKELY * variance).sum())
        minima = _below(local, reference, minima.states[:likely], _STEPS_OF_ALL_POINTS)
    states = minima.states[: minima.counts[0]]
    poses = states[:, :POSE_SIZE].copy()
    for pose in poses:
        orthonormalize(pose)
        uncenter(pose, center, unit)
    focals, costs = reference * np.exp(states[:, POSE_SIZE]), minima.costs[: len(states)]
    return (poses, focals, costs), iterations + int(minima.counts[1]), hypotheses


def _below(task: _Task, reference: float, starts: FloatArray, steps: int) -> Minima:
    """The distinct minima below starts (S, 16); log focal lengths are relative to the reference."""
    minima = room_for_minima(MAX_MINIMA, POSE_SIZE + 1)
    system = task.system(reference)
    if not task.camera.distortion:
        search(system, starts, Effort(len(starts), steps, 0, np.inf), 0, 0.0, minima)
        return minima
    for start in starts:  # the lens is linear near the focal length of its rays alone
        pose, log_ratio, cost = start[:POSE_SIZE].copy(), float(start[POSE_SIZE]), np.inf
        for _ in range(_LENS_ROUNDS):
            try:
                here = task.system(reference * math.exp(log_ratio))
            except InputError:
                break
            cost, moved, used = refine_focal(here, steps, pose)
            minima.counts[1] += used
            log_ratio += moved
            if abs(moved) < _LENS_TOLERANCE:
                break
        add_minimum(system, np.append(pose, log_ratio), float(cost), 0, 0.0, minima)
    return minima


def _starts(task: _Task) -> tuple[float, FloatArray, int, int]:
    """Starts: the optima at fixed focal lengths that no neighbouring one improves on.

    Returns a reference focal length [px], the states (S, 16) relative to it, the iterations and the
    hypotheses that they took.
    """
    views = focal_views(task.points_2d, task.camera, task.options.focal_prior, task.sigma)
    views = _with_linear_guess(task, views)
    focals = views.focals
    count, n = len(focals), len(task.points)
    poses, costs, _, _, info = optimal_batch(
        np.tile(task.points, (count, 1)),
        views.rays.reshape(-1, 2),
        np.repeat(views.whitening, n // views.whitening.shape[1], axis=1).reshape(-1, 3),
        np.arange(count + 1) * n,
        LOSSES[task.options.loss],
        np.full(count, task.options.loss_scale * task.noise),
        np.full(count, task.scale_prior.weight),
        task.scale_prior.width,
        task.options.free,
        0,
    )
    *_, center, weight = log_focal_range(task.camera, task.options.focal_prior)
    costs = costs + (weight * task.noise**2 * (np.log(focals) - center) ** 2)[:, None]
    reference = float(focals[count // 2])
    starts: list[FloatArray] = []
    for flat in np.argsort(costs, axis=None, kind="stable").tolist():
        k, row = divmod(flat, MAX_MINIMA)
        if not costs[k, row] < np.inf or len(starts) == _MOST_STARTS:
            break
        around = [j for j in (k - 1, k + 1) if 0 <= j < count]
        turned = np.linalg.norm(poses[around, :, :9] - poses[k, row, :9], axis=-1) < _SAME_BRANCH
        if not (turned & (costs[around] < costs[k, row])).any():
            starts.append(np.append(poses[k, row], math.log(focals[k] / reference)))
    states = np.array(starts).reshape(-1, POSE_SIZE + 1)
    return reference, states, int(info[:, 1].sum()), int(info[:, 2].sum())


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


def focal_views(
    points_2d: FloatArray, camera: Camera, prior: PriorOption, sigma: Sigma | None
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
