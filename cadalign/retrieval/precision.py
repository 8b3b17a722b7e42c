"""Uncertainty of matches: of a pose and stretch that a search found, or that a shape gives."""

from __future__ import annotations

from typing import cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.assemble import KeypointPosterior
from cadalign.estimation.options import LOSSES, FitOptions, pixel_information
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import FittedKeypoints, Posterior, point_slopes, quickly
from cadalign.estimation.uncertainty.residuals import loss_slopes
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.solvers.constants import CAUCHY, HUBER


def posterior_of_keypoints(
    points_3d: FloatArray,
    residuals: FloatArray,
    alignment: Alignment,
    camera: Camera,
    options: FitOptions,
) -> Posterior:
    """The posterior at the optimum of keypoints (n, 3), with residuals (n, 2) [px].

    As of `cadalign.fit`; without a covariance where a pose is not determined at all.
    """
    information = pixel_information(options.sigma, len(points_3d))
    squares = np.einsum("ni,nij,nj->n", residuals, information, residuals)
    weights = loss_slopes(squares, LOSSES[options.loss], options.loss_scale)[0]
    slopes = camera.projection_slopes(alignment.apply(points_3d))
    slopes = slopes @ point_slopes(points_3d, alignment)
    total = np.einsum("nki,n,nkl,nlj->ij", slopes, weights, information, slopes)
    total[range(6, 9), range(6, 9)] += options.prior_weight
    free, covariance = options.estimated_unknowns, np.zeros((9, 9))
    try:
        covariance[np.ix_(free, free)] = np.linalg.inv(total[np.ix_(free, free)])
    except np.linalg.LinAlgError:
        return Posterior()
    inliers = np.ones(len(points_3d), dtype=bool)
    given = points_3d, residuals, inliers, alignment, camera, options
    keypoints = FittedKeypoints(*given, fisher_covariance=covariance)
    known = {"keypoints": keypoints, "diagnosis": None, "fisher_covariance": covariance}
    return quickly(KeypointPosterior, known)


def posterior_by_shape(shape: Result, alignment: Alignment, options: FitOptions) -> Posterior:
    """The posterior of an estimated shape in the unit of a match, whose held length sets it."""
    free = options.stretched_axes
    held = next(axis for axis, name in enumerate("xyz") if name not in free)
    change, size = np.eye(9), np.linalg.norm(shape.alignment.translation)
    change[3:6] *= np.linalg.norm(alignment.translation) / size
    change[3:6, 6 + held] = -alignment.translation
    change[6:, 6 + held] -= 1.0
    change[6:] *= np.array([[name in free] for name in "xyz"])
    covariance = cast(FloatArray, shape.covariance)
    return Posterior(change @ covariance @ change.T, degrees_of_freedom=shape.degrees_of_freedom)


def bent(squares: FloatArray, loss: int, bend: float) -> FloatArray:
    """Loss on squared whitened lengths of any shape, one of `cadalign.solvers.constants`."""
    if loss == HUBER:
        linear = 2 * bend * np.sqrt(squares) - bend**2
        return np.asarray(np.where(squares <= bend**2, squares, linear))
    if loss == CAUCHY:
        return np.asarray(bend**2 * np.log1p(squares / bend**2))
    return squares
