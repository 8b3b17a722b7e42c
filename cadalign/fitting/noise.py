"""From pixels and their uncertainties to rays and the weights of their residuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray, IntArray, as_floats, is_number
from cadalign.errors import InputError, quote
from cadalign.fitting.options import Sigma
from cadalign.geometry.camera import Camera
from cadalign.solvers.projection import pinhole_rays


def rays_of(points_2d: FloatArray, camera: Camera) -> FloatArray:
    """Normalised image coordinates (n, 2) of checked pixels (n, 2)."""
    if camera.distortion:
        return camera.normalize(points_2d)
    return pinhole_rays(points_2d, camera.fx, camera.fy, camera.cx, camera.cy)


def whitening_of(sigma: Sigma | None, rays: FloatArray, camera: Camera) -> FloatArray:
    """Weights (1 or n, 3) that turn errors of the rays (n, 2) into errors of unit covariance.

    A row (a, b, c) is such that (a du + b dv, c dv) has unit covariance for the error (du, dv) of a
    ray: the upper Cholesky factor of its information matrix. Lens distortion enters by its
    derivative. A sigma of None counts as 1 px.
    """
    if sigma is None:
        sigma = 1.0
    if isinstance(sigma, int | float) and not camera.distortion:
        if not (is_number(sigma) and sigma > 0):
            raise InputError(f"{quote(sigma)} is not a standard deviation", where="sigma", fix=_FIX)
        return np.array([[camera.fx / sigma, 0.0, camera.fy / sigma]])
    information = pixel_information(sigma, len(rays))
    to_pixels = np.diag([camera.fx, camera.fy]) @ camera.distortion_jacobian(rays)
    of_rays = np.swapaxes(to_pixels, 1, 2) @ information @ to_pixels
    a = np.sqrt(of_rays[:, 0, 0])
    b = of_rays[:, 0, 1] / a
    c = np.sqrt(of_rays[:, 1, 1] - b * b)
    return np.stack([a, b, c], axis=1)


def check_sigmas(sigmas: Sequence[Sigma | None], counts: IntArray) -> None:
    """Check the standard deviations of problems of so many keypoints each, or one for all.

    Raises
    ------
    InputError
        If one is no standard deviation, or has another shape than its keypoints.
    """
    for b, sigma in enumerate(sigmas):
        if sigma is None or (isinstance(sigma, int | float) and is_number(sigma) and sigma > 0):
            continue
        if np.ndim(sigma) == 0 or len(sigmas) > 1:
            pixel_information(sigma, int(counts[b]))
        else:
            for count in set(counts.tolist()):
                pixel_information(sigma, count)


_FIX = "give a positive number, one per keypoint, or a 2 x 2 covariance per keypoint, in pixels"


def pixel_information(sigma: Any, count: int) -> FloatArray:
    """Inverse covariances (n, 2, 2) of the pixels of n keypoints; checks sigma."""
    dimensions = np.ndim(sigma)
    if dimensions < 2:
        shape: tuple[int | None, ...] = () if dimensions == 0 else (count,)
        deviations = as_floats(sigma, name="sigma", shape=shape)
        if not (deviations > 0).all():
            raise InputError("has values that are not positive", where="sigma", fix=_FIX)
        weights = np.broadcast_to(1.0 / deviations**2, (count,))
        return np.asarray(weights[:, None, None] * np.eye(2))
    covariances = as_floats(sigma, name="sigma", shape=(count, 2, 2))
    definite = (np.linalg.eigvalsh(covariances)[:, 0] > 0) & (
        np.abs(covariances[:, 0, 1] - covariances[:, 1, 0])
        <= 1e-9 * np.abs(covariances).max(axis=(1, 2))
    )
    if not definite.all():
        raise InputError(
            f"the covariance of keypoint {np.flatnonzero(~definite)[0]} is not symmetric and "
            "positive definite",
            where="sigma",
            fix=_FIX,
        )
    return np.asarray(np.linalg.inv(covariances))
