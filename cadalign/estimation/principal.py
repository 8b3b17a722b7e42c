"""The principal point as two further unknowns, with a prior: of photos that may be cropped.

Gauss-Newton on the principal point alone, the alignment being searched anew for each: by the
envelope theorem the gradient of the cost at the best alignment is that of the residuals, and its
curvature is the Schur complement of the alignment's in the joint information.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError
from cadalign.estimation.options import FitOptions
from cadalign.estimation.result import Result
from cadalign.estimation.uncertainty.posterior import Likelihood
from cadalign.estimation.uncertainty.stated import KeypointStatistics, Stated
from cadalign.geometry.camera import Camera
from cadalign.solvers.projection import projection_jacobian

_MOST_STEPS = 20
_SETTLED = 1e-3  # of a standard deviation


def fit_with_principal_point(
    fit_at: Callable[[Camera], Result], camera: Camera, options: FitOptions
) -> Result:
    """Fit alignment and principal point.

    Parameters
    ----------
    fit_at : callable
        The fit with a camera whose principal point is known.
    camera : Camera
        Its principal point is the prior's mean.
    options : FitOptions
        ``principal_sigma`` is the prior's standard deviation.

    Returns
    -------
    Result
        With the estimated camera; ``principal_std`` has the standard deviations of its principal
        point, and the covariance what they add.

    Raises
    ------
    DegenerateError
        If the steps do not settle.
    """
    sigma = cast(float, options.principal_sigma)
    shift = np.zeros(2)
    for _ in range(_MOST_STEPS):
        result = fit_at(replace(camera, cx=camera.cx + shift[0], cy=camera.cy + shift[1]))
        gradient, information, by_unknowns = _linearised(result, options)
        precision = information + np.eye(2) / sigma**2
        covariance: FloatArray = np.asarray(np.linalg.inv(precision))
        step = -covariance @ (gradient + shift / sigma**2)
        deviations = np.sqrt(covariance.diagonal())
        if (np.abs(step) <= _SETTLED * deviations).all():
            return _with_principal_point(result, options, covariance, by_unknowns)
        shift = shift + step
    raise DegenerateError(
        "the estimate of the principal point does not settle",
        where="principal_sigma",
        fix="give a smaller one, or more keypoints",
    )


def _linearised(result: Result, options: FitOptions) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gradient (2,) and information (2, 2) of the principal point, and the unknowns (k, 2) by it.

    The information is what the keypoints leave of it once the unknowns follow.
    """
    statistics = cast(KeypointStatistics, result.statistics)
    assert result.fisher_covariance is not None
    inliers = result.inliers
    residuals = result.residuals[inliers]
    likelihood = Likelihood.of(statistics)
    weights = likelihood.weights(residuals)[:, None, None] * likelihood.information
    free = options.estimated_unknowns
    points = result.points_3d[inliers]
    rows = projection_jacobian(points, result.camera, result.alignment)[:, :, free]
    mixed = np.einsum("nik,nij->kj", rows, weights)
    by_unknowns = -result.fisher_covariance[np.ix_(free, free)] @ mixed
    information = weights.sum(axis=0) + mixed.T @ by_unknowns
    gradient = np.einsum("nij,nj->i", weights, residuals)
    return gradient, information, by_unknowns


def _with_principal_point(
    result: Result, options: FitOptions, covariance: FloatArray, by_unknowns: FloatArray
) -> Result:
    """The result with the uncertainty that the principal point adds."""
    assert result.covariance is not None
    assert result.fisher_covariance is not None
    added = np.zeros_like(result.covariance)
    free = options.estimated_unknowns
    added[np.ix_(free, free)] = by_unknowns @ covariance @ by_unknowns.T
    statistics = Stated(
        result.covariance + added,
        fisher_covariance=result.fisher_covariance + added,
        warnings=result.warnings,
        misfit=result.misfit,
        evidence=result.evidence,
    )
    first = replace(result.views[0], statistics=statistics)
    x, y = np.sqrt(covariance.diagonal()).tolist()
    return replace(
        result, views=(first,), statistics=statistics, principal_std=(x, y), options=options
    )
