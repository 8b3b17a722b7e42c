"""Pose, stretch and focal length of one view's keypoints, by the joint system of all unknowns.

The search starts from the optima of pose and stretch at a grid of focal lengths.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.focal import focal_grid, log_focal_range
from cadalign.estimation.model import Model
from cadalign.estimation.options import LOSSES, FitOptions, Sigma, pixel_information
from cadalign.estimation.pack import evidence_of
from cadalign.estimation.prior import Lenses, ShapePrior, prior_of
from cadalign.estimation.problems import (
    Problems,
    Solutions,
    rays_of,
    whitening_of,
    with_log_focal,
)
from cadalign.estimation.uncertainty.posterior import Likelihood
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.solvers.alignment import Objective, covariance_of
from cadalign.solvers.constants import (
    DEGENERATE,
    NOT_FOUND,
    OK,
    OUT_OF_RANGE,
    POSE_SIZE,
    TOO_FEW,
    UNKNOWNS,
)
from cadalign.solvers.evidence import KeypointEvidence
from cadalign.solvers.joint.evidence import Evidence, State
from cadalign.solvers.joint.search import refine_joint, search_joint
from cadalign.solvers.optimal import MAX_MINIMA, optimal_batch
from cadalign.solvers.projection import projection_jacobian
from cadalign.solvers.unknowns import orthonormalize, uncenter

_MOST_STARTS = 8
_COARSE_POINTS = 256  # that many separate the starts
_SAME_BRANCH = 0.6  # chord between rotations of one minimum at neighbouring focal lengths
_SAME = 1e-3  # difference of rotations and log focal lengths of one minimum
_LENS_ROUNDS = 12
_LENS_TOLERANCE = 1e-10
_ITERATIONS = 200
_UNKNOWNS_OF_MODEL = [0, 1, 2, 3, 4, 5, 7, 8, 9]  # of a result where the scale of x is known


@dataclass(frozen=True, eq=False)
class _Task:
    """Keypoints (n, 3) of a model, whose x is known, and (n, 2) of an image [px]."""

    points: FloatArray
    points_2d: FloatArray
    camera: Camera
    sigma: Sigma
    options: FitOptions

    @cached_property
    def prior(self) -> ShapePrior:
        """The points as an exact model, with the scales that are estimated."""
        options = self.options
        prior = prior_of(Model(points_3d=self.points, stretch_sigma=options.stretch_sigma))
        free = np.append(0.0, options.free[6:])
        return replace(prior, scales=prior.scales._replace(free=free))

    def evidence(self, focal: float) -> Evidence:
        """The keypoints with a lens linearised about a focal length, which is unknown."""
        view = View(self.camera, self.points_2d, sigma=self.sigma)
        lenses = Lenses((self.camera.with_focal(focal),), (0,), self.options.focal_prior)
        return evidence_of(self.prior, [view], options=self.options, lenses=lenses)

    def on_grid(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Focal lengths (k,) of the grid [px], and rays (k, n, 2) and whitening (k, 1 or n, 3).

        Those at which the lens can be undone; InputError if there are none.
        """
        found = []
        problem: InputError | None = None
        for focal in focal_grid(self.camera, self.options.focal_prior).tolist():
            camera = self.camera.with_focal(focal)
            try:
                rays = rays_of(self.points_2d, camera)
            except InputError as error:
                problem = error
            else:
                found.append((focal, rays, whitening_of(self.sigma, rays, camera)))
        if not found and problem is not None:
            raise problem
        focals, rays, whitening = map(np.array, zip(*found, strict=True))
        return focals, rays, whitening

    def covariance(self, pose: FloatArray, focal: float) -> tuple[FloatArray, int]:
        """Covariance (9, 9) of all unknowns at a pose (15,), and an undetermined one's number.

        The order is rotation vector, translation, log scales, log focal length. The number is -1 if
        all are determined; the focal length is never one. Bounds of the focal length don't count.
        """
        options, camera = self.options, self.camera.with_focal(focal)
        rays = rays_of(self.points_2d, camera)
        whitening = whitening_of(self.sigma, rays, camera)
        loss = LOSSES[options.loss], options.loss_scale
        keypoints = KeypointEvidence(self.points, rays, whitening, *loss)
        covariance = np.zeros((UNKNOWNS, UNKNOWNS))
        objective = Objective(options.free, keypoints, options.scale_prior)
        undetermined = covariance_of(objective, pose, covariance)
        alignment = Alignment.from_packed(pose)
        residuals = camera.project(alignment.apply(self.points)) - self.points_2d
        information = pixel_information(self.sigma, len(residuals))
        roots = np.sqrt(Likelihood(information, options).weights(residuals))[:, None, None]
        rows = np.linalg.cholesky(information).swapaxes(1, 2) * roots
        rows = rows @ projection_jacobian(self.points, camera, alignment)[:, :, _UNKNOWNS_OF_MODEL]
        weight, width = options.scale_prior
        of_scales = np.where(np.abs(np.log(pose[13:])) >= width, weight, 0.0)
        of_focal = log_focal_range(camera, options.focal_prior)[3]
        return with_log_focal(covariance, rows, of_scales, of_focal), undetermined

    def thinned(self) -> _Task:
        """The task of at most `_COARSE_POINTS` points, evenly spread over their order."""
        count = len(self.points)
        if count <= _COARSE_POINTS:
            return self
        chosen = np.arange(_COARSE_POINTS) * count // _COARSE_POINTS
        sigma = self.sigma
        if np.ndim(sigma) > 0:
            sigma = np.asarray(sigma, dtype=np.float64)[chosen]
        points, pixels = self.points[chosen], self.points_2d[chosen]
        return replace(self, points=points, points_2d=pixels, sigma=sigma)


def search_focal(
    problems: Problems, options: FitOptions, points: FloatArray, noises: FloatArray
) -> Solutions:
    """Find the minima over alignment and focal length of the only problem.

    The model ``points`` have the known axis first; costs and covariance of keypoints without sigma
    are those of 1 px, where priors and loss scales are multiplied by ``noises`` (1,).
    """
    found = Solutions(
        np.zeros((1, MAX_MINIMA, POSE_SIZE)),
        np.full((1, MAX_MINIMA), np.inf),
        np.zeros((1, UNKNOWNS + 1, UNKNOWNS + 1)),
        np.array([OK]),
        np.zeros((1, 4), dtype=np.int64),
        focals=np.full((1, MAX_MINIMA), np.nan),
    )
    sigma = float(noises[0]) if options.sigma is None else options.sigma
    if len(points) < options.min_points:
        return found._replace(statuses=np.array([TOO_FEW]))
    task = _Task(points, problems.points_2d, problems.camera(0), sigma, options)
    try:
        minima, iterations, hypotheses = _minima(task)
        count, undetermined = len(minima), -1
        covariance = np.zeros((UNKNOWNS + 1, UNKNOWNS + 1))
        if count:
            covariance, undetermined = task.covariance(minima[0, 1:-1], minima[0, -1])
    except CadalignError as error:  # the lens model cannot be undone
        return found._replace(errors={0: error})
    except np.linalg.LinAlgError:
        return found._replace(statuses=np.array([OUT_OF_RANGE]))
    found.costs[0, :count] = noises**2 * minima[:, 0]
    found.poses[0, :count] = minima[:, 1:-1]
    assert found.focals is not None
    found.focals[0, :count] = minima[:, -1]
    found.info[0] = count, iterations, hypotheses, undetermined
    covariance /= noises**2
    status = OK if np.isfinite(covariance).all() else OUT_OF_RANGE
    status = NOT_FOUND if not count else DEGENERATE if undetermined >= 0 else status
    return found._replace(covariances=covariance[None], statuses=np.array([status]))


def _minima(task: _Task) -> tuple[FloatArray, int, int]:
    """Minima, the best first, and the iterations and hypotheses that they took.

    Costs, packed poses and focal lengths [px], a row (17,) each.
    """
    center = task.points.mean(axis=0)
    unit = float(np.sqrt(((task.points - center) ** 2).sum(axis=1).mean()))
    if not unit > 0:
        return np.empty((0, POSE_SIZE + 2)), 0, 0
    local = replace(task, points=(task.points - center) / unit)
    starts, iterations, hypotheses = _starts(local.thinned())
    found, used = _below(local, starts)
    minima = np.array(sorted(found, key=lambda row: row[0])[:MAX_MINIMA])
    minima = minima.reshape(-1, POSE_SIZE + 2)
    for row in minima:
        orthonormalize(row[1:-1])
        uncenter(row[1:-1], center, unit)
    return minima, iterations + used, hypotheses


def _starts(task: _Task) -> tuple[FloatArray, int, int]:
    """Starts: the optima at fixed focal lengths that no neighbouring one improves on.

    Returns packed poses and focal lengths [px], a row (16,) each, the best first, and the
    iterations and hypotheses that they took.
    """
    focals, rays, whitening = task.on_grid()
    count, n, options = len(focals), len(task.points), task.options
    poses, costs, _, _, info = optimal_batch(
        np.tile(task.points, (count, 1)),
        rays.reshape(-1, 2),
        np.repeat(whitening, n // whitening.shape[1], axis=1).reshape(-1, 3),
        np.arange(count + 1) * n,
        LOSSES[options.loss],
        np.full(count, options.loss_scale),
        np.full(count, options.scale_prior.weight),
        options.scale_prior.width,
        options.free,
        0,
    )
    *_, center, weight = log_focal_range(task.camera, options.focal_prior)
    costs = costs + (weight * (np.log(focals) - center) ** 2)[:, None]
    starts: list[FloatArray] = []
    for flat in np.argsort(costs, axis=None, kind="stable").tolist():
        k, row = divmod(flat, MAX_MINIMA)
        if not costs[k, row] < np.inf or len(starts) == _MOST_STARTS:
            break
        around = [j for j in (k - 1, k + 1) if 0 <= j < count]
        turned = np.linalg.norm(poses[around, :, :9] - poses[k, row, :9], axis=-1) < _SAME_BRANCH
        if not (turned & (costs[around] < costs[k, row])).any():
            starts.append(np.append(poses[k, row], focals[k]))
    states = np.array(starts).reshape(-1, POSE_SIZE + 1)
    return states, int(info[:, 1].sum()), int(info[:, 2].sum())


def _below(task: _Task, starts: FloatArray) -> tuple[list[FloatArray], int]:
    """The distinct minima below starts, rows as those of `_minima`, and the iterations."""
    if not len(starts):
        return [], 0
    if not task.camera.distortion:
        reference = float(starts[0, -1])
        evidence, logs = task.evidence(reference), np.log(starts[:, -1:] / reference)
        given = starts[:, None, :12].copy(), logs, np.log(starts[:, 12:15])
        minima, used = search_joint(evidence, *given)
        pairs = zip(minima.costs.tolist(), minima.states, strict=True)
        return [_row_of(cost, state, reference) for cost, state in pairs], used
    found: list[FloatArray] = []
    iterations = 0
    for start in starts:  # the lens is linear near the focal length of its rays alone
        cost, focal, state = math.inf, float(start[-1]), _state_of(task, start)
        for _ in range(_LENS_ROUNDS):
            try:
                evidence = task.evidence(focal)
            except InputError:
                break
            cost, state, used, _ = refine_joint(evidence, _ITERATIONS, state)
            iterations += used
            log_ratio = float(state.log_focals[0])
            focal, state = focal * math.exp(log_ratio), state._replace(log_focals=np.zeros(1))
            if abs(log_ratio) < _LENS_TOLERANCE:
                break
        row = _row_of(cost, state, focal)
        if cost < math.inf and not any(_are_same(row, other) for other in found):
            found.append(row)
    return found, iterations


def _state_of(task: _Task, start: FloatArray) -> State:
    still = np.zeros_like(task.prior.components[0].mean)
    pose, log_scales = start[None, :12].copy(), np.log(start[12:15])
    return State(pose, np.zeros(1), log_scales, np.empty(0), still)


def _row_of(cost: float, state: State, reference: float) -> FloatArray:
    focal = reference * np.exp(state.log_focals[0])
    return np.concatenate([[cost], state.poses[0], np.exp(state.log_scales), [focal]])


def _are_same(first: FloatArray, second: FloatArray) -> bool:
    zoom = abs(math.log(first[-1] / second[-1]))
    return zoom < _SAME and float(np.abs(first[1:10] - second[1:10]).max()) < _SAME
