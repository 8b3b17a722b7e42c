"""Rays and weights of keypoints at every focal length that a search tries."""

from __future__ import annotations

import math

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.fitting.focal.prior import FocalPrior, focal_bounds, focal_grid
from cadalign.fitting.noise import rays_of, whitening_of
from cadalign.fitting.options import FitOptions, Sigma
from cadalign.geometry.camera import Camera
from cadalign.solvers.evidence import LogFocalPrior, Views


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


def focal_slopes(points_2d: FloatArray, camera: Camera, rays: FloatArray) -> FloatArray:
    """Derivatives of undistorted pixels, over the focal length, by its logarithm.

    (n, 2) float for pixels and rays (n, 2); (0, 2) for a lens without distortion, where they are 0.
    """
    if not camera.distortion:
        return np.empty((0, 2))
    distorted = (points_2d - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    inverse = np.linalg.inv(camera.distortion_jacobian(rays))
    return np.asarray(rays - np.einsum("nij,nj->ni", inverse, distorted))


def log_focal_prior(camera: Camera, options: FitOptions) -> LogFocalPrior:
    """Bounds of the log focal length, which a prior may widen, and that prior."""
    low, high = focal_bounds(camera)
    prior = options.focal_prior
    if prior is None:
        return LogFocalPrior(math.log(low), math.log(high), 0.0, 0.0)
    return LogFocalPrior(
        math.log(min(low, prior.focal)),
        math.log(max(high, prior.focal)),
        math.log(prior.focal),
        prior.relative_sigma**-2,
    )
