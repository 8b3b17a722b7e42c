"""Cramer-Rao bound, the least covariance of an unbiased estimate, and levels of stated ones."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError
from cadalign.estimation.options import Sigma, pixel_information
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import (
    Camera,
    projection_jacobian,
)
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.shapes.parts import probability_within
from cadalign.solvers.constants import UNKNOWNS

_LEAST_INFORMATION = 1e-12
_LARGEST_LOG = 50.0
# Smallest share of a covariance's largest eigenvalue that counts as variance.
_NO_VARIANCE = 1e-12
_FOCAL = 9  # row of the focal length
_OF_STRETCHED = [0, 1, 2, 3, 4, 5, 7, 8, _FOCAL]  # unknowns where x has the scale 1


def cramer_rao_bound(
    points_3d: FloatArray, camera: Camera, gt: Alignment, *, sigma: Sigma, focal: str
) -> FloatArray:
    """The least covariance that any unbiased estimate of an alignment can have.

    The inverse of the Fisher information (J' W J)^-1 at the truth, which has the scale 1 along x,
    for independent Gaussian noise of the keypoints; as `cadalign.Result.covariance`, (9, 9) or
    (10, 10). ``sigma`` and ``focal`` are as for `cadalign.fit`.
    """
    used = _OF_STRETCHED if focal == "estimate" else _OF_STRETCHED[:-1]
    whitening = np.linalg.cholesky(pixel_information(sigma, len(points_3d))).swapaxes(1, 2)
    rows = (whitening @ projection_jacobian(points_3d, camera, gt)[:, :, used]).reshape(
        -1, len(used)
    )
    scaled, norms = _scaled(rows)
    size = _FOCAL + 1 if focal == "estimate" else _FOCAL
    covariance = np.zeros((size, size))
    covariance[np.ix_(used, used)] = np.linalg.inv(scaled.T @ scaled) / np.outer(norms, norms)
    return covariance


def _scaled(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Equations with columns of length 1, and the lengths; raises DegenerateError if degenerate."""
    norms = np.linalg.norm(rows, axis=0)
    scaled = rows / np.where(norms > 0, norms, 1.0)
    if len(rows) < rows.shape[1] or np.linalg.eigvalsh(scaled.T @ scaled)[0] < _LEAST_INFORMATION:
        raise DegenerateError("the points do not determine the alignment", where="points_3d")
    return scaled, norms


def sample_limit(
    bound: FloatArray, *, rng: np.random.Generator, draws: int
) -> dict[str, FloatArray]:
    """Errors of an ideal estimator: draws from a Gaussian with the bound as its covariance.

    By name, each (draws,) float in the units of `cadalign.metrics`; ``focal_error``, relative, only
    if the focal length is unknown.
    """
    errors = np.zeros((draws, len(bound)))
    free = np.flatnonzero(bound.diagonal())
    own, mean = bound[np.ix_(free, free)], np.zeros(len(free))
    errors[:, free] = rng.multivariate_normal(mean, own, size=draws, method="eigh")
    focal = {"focal_error": np.abs(np.expm1(errors[:, _FOCAL]))} if len(bound) > _FOCAL else {}
    return focal | {
        "rotation_error_deg": np.degrees(np.linalg.norm(errors[:, :3], axis=1)),
        "translation_error": np.linalg.norm(errors[:, 3:6], axis=1),
        "scale_y_error": np.abs(np.expm1(errors[:, 7])),
        "scale_z_error": np.abs(np.expm1(errors[:, 8])),
    }


def limit_estimate(
    points_3d: FloatArray, points_2d: FloatArray, camera: Camera, gt: Alignment
) -> Alignment:
    """Estimate of an ideal estimator from noisy observations (n, 2) [px], to first order.

    The Gauss-Newton step from the truth, (J' J)^-1 J' e with the noise e of the observations. Over
    the noise its errors have exactly the Cramer-Rao bound as their covariance; the noise is that of
    the compared methods, so that no chance enters the comparison. The truth has the scale 1 along
    x, the camera no lens distortion.
    """
    jacobian = projection_jacobian(points_3d, camera, gt)[:, :, _OF_STRETCHED[:-1]]
    jacobian = jacobian.reshape(-1, UNKNOWNS)
    noise = (points_2d - camera.project(gt.apply(points_3d))).ravel()
    scaled, norms = _scaled(jacobian)
    step = np.linalg.solve(scaled.T @ scaled, scaled.T @ noise) / norms
    # The exponential of a weakly determined scale would overflow.
    factors = np.exp(np.clip(step[6:], -_LARGEST_LOG, _LARGEST_LOG))
    return Alignment(
        rotation_from_vector(step[:3]) @ gt.rotation,
        gt.translation + step[3:6],
        gt.scale * np.append(1.0, factors),
    )


def probability_level(
    error: FloatArray, covariance: FloatArray, degrees_of_freedom: float | None = None
) -> float | None:
    """Probability of the smallest ellipsoid about the estimate that holds the truth.

    ``error`` (k,) is estimate minus truth, ``covariance`` (k, k) as the estimator states it, where
    directions without variance are held to be known; with ``degrees_of_freedom`` errors follow a t
    distribution, without a Gaussian. The level is uniform over [0, 1] where the covariance is that
    of the errors, 1 if the error has a part in a direction without variance, and None if there is
    no variance at all.
    """
    if not np.isfinite(covariance).all():
        return None
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    free = values > _NO_VARIANCE * max(float(values[-1]), 0.0)
    if not free.any():
        return None
    parts = vectors.T @ error
    if (parts[~free] ** 2 > 1e-6 * values[-1]).any():
        return 1.0
    square = float((parts[free] ** 2 / values[free]).sum())
    return float(probability_within(square, int(free.sum()), degrees_of_freedom))
