"""Pose, stretch and focal length of one view's keypoints, by the joint system of all unknowns."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError
from cadalign.estimation.focal import log_focal_range
from cadalign.estimation.model import Model
from cadalign.estimation.options import LOSSES, FitOptions, Sigma, pixel_information
from cadalign.estimation.problem import compile_problem
from cadalign.estimation.problems import (
    Problems,
    Solutions,
    rays_of,
    whitening_of,
    with_log_focal,
)
from cadalign.estimation.search import search_at_noise
from cadalign.estimation.uncertainty.posterior import Likelihood
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera, projection_jacobian
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
from cadalign.solvers.optimal import MAX_MINIMA
from cadalign.solvers.unknowns import orthonormalize, uncenter

_UNKNOWNS_OF_MODEL = [0, 1, 2, 3, 4, 5, 7, 8, 9]  # of a result where the scale of x is known


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
        focals=(focals := np.full((1, MAX_MINIMA), np.nan)),
    )
    sigma = float(noises[0]) if options.sigma is None else options.sigma
    if len(points) < options.min_points:
        return found._replace(statuses=np.array([TOO_FEW]))
    view = View(problems.camera(0), problems.points_2d, sigma=sigma)
    try:
        minima, iterations, hypotheses = _minima(points, view, options)
        count, undetermined = len(minima), -1
        covariance = np.zeros((UNKNOWNS + 1, UNKNOWNS + 1))
        if count:
            camera = view.camera.with_focal(minima[0, -1])
            covariance, undetermined = _covariance(
                points, problems.points_2d, sigma, camera, options, minima[0, 1:-1]
            )
    except CadalignError as error:  # the lens model cannot be undone
        return found._replace(errors={0: error})
    except np.linalg.LinAlgError:
        return found._replace(statuses=np.array([OUT_OF_RANGE]))
    found.costs[0, :count] = noises**2 * minima[:, 0]
    found.poses[0, :count] = minima[:, 1:-1]
    focals[0, :count] = minima[:, -1]
    found.info[0] = count, iterations, hypotheses, undetermined
    covariance /= noises**2
    status = OK if np.isfinite(covariance).all() else OUT_OF_RANGE
    status = NOT_FOUND if not count else DEGENERATE if undetermined >= 0 else status
    return found._replace(covariances=covariance[None], statuses=np.array([status]))


def _minima(points: FloatArray, view: View, options: FitOptions) -> tuple[FloatArray, int, int]:
    """Minima, the best first, and the iterations and hypotheses that they took.

    Costs, packed poses and focal lengths [px], a row (17,) each.
    """
    center = points.mean(axis=0)
    unit = float(np.sqrt(((points - center) ** 2).sum(axis=1).mean()))
    if not unit > 0:
        return np.empty((0, POSE_SIZE + 2)), 0, 0
    stretched = "".join(axis for axis, free in zip("yz", options.free[6:], strict=True) if free)
    local, prior = (points - center) / unit, options.stretch_sigma
    model = Model(points_3d=local, stretch=stretched or "none", stretch_sigma=prior)
    problem = compile_problem(model, [view], None, [None], options, None)
    _, minima, iterations, hypotheses = search_at_noise(problem, [None])
    minima = sorted(minima, key=lambda minimum: minimum.cost)[:MAX_MINIMA]
    rows = np.empty((len(minima), POSE_SIZE + 2))
    for row, minimum in zip(rows, minima, strict=True):
        scale = np.exp(minimum.state.log_scales)
        row[:] = [minimum.cost, *minimum.state.poses[0], *scale, *minimum.focal_lengths]
        orthonormalize(row[1:-1])
        uncenter(row[1:-1], center, unit)
    return rows, iterations, hypotheses


def _covariance(
    points: FloatArray,
    points_2d: FloatArray,
    sigma: Sigma,
    camera: Camera,
    options: FitOptions,
    pose: FloatArray,
) -> tuple[FloatArray, int]:
    """Covariance (9, 9) of all unknowns at a pose (15,), and an undetermined one's number.

    The order is rotation vector, translation, log scales, log focal length. The number is -1 if
    all are determined; the focal length is never one. Bounds of the focal length don't count.
    """
    rays = rays_of(points_2d, camera)
    whitening = whitening_of(sigma, rays, camera)
    keypoints = KeypointEvidence(points, rays, whitening, LOSSES[options.loss], options.loss_scale)
    covariance = np.zeros((UNKNOWNS, UNKNOWNS))
    objective = Objective(options.free, keypoints, options.scale_prior)
    undetermined = covariance_of(objective, pose, covariance)
    alignment = Alignment.from_packed(pose)
    residuals = camera.project(alignment.apply(points)) - points_2d
    information = pixel_information(sigma, len(residuals))
    roots = np.sqrt(Likelihood(information, options).weights(residuals))[:, None, None]
    rows = np.linalg.cholesky(information).swapaxes(1, 2) * roots
    rows = rows @ projection_jacobian(points, camera, alignment)[:, :, _UNKNOWNS_OF_MODEL]
    weight, width = options.scale_prior
    of_scales = np.where(np.abs(np.log(pose[13:])) >= width, weight, 0.0)
    of_focal = log_focal_range(camera, options.focal_prior)[3]
    return with_log_focal(covariance, rows, of_scales, of_focal), undetermined
