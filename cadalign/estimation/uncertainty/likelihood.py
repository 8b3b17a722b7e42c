"""Fitted keypoints of an exact or stretched model in one view, and the likelihood of residuals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.options import FitOptions, pixel_information
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry


@dataclass(frozen=True, eq=False)
class FittedKeypoints:
    """Keypoints of an exact or stretched model in one view, with the alignment that fits them.

    Parameters
    ----------
    points_3d : (n, 3) float
        The keypoints that the view shows, on the model.
    residuals, inliers, alignment, camera, sigma, symmetry
        As of `cadalign.Result`.
    options : FitOptions
    fisher_covariance : (9, 9) or (10, 10) float, optional
    """

    points_3d: FloatArray
    residuals: FloatArray
    inliers: BoolArray
    alignment: Alignment
    camera: Camera
    options: FitOptions
    sigma: float | None = None
    fisher_covariance: FloatArray | None = None
    symmetry: Symmetry | None = None

    @property
    def chosen_sigma(self) -> Any:
        """The keypoints' standard deviation or covariances [px]: given, or estimated."""
        return self.sigma if self.options.sigma is None else self.options.sigma


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Negative log likelihoods, times two, of residuals in pixels.

    Parameters
    ----------
    information : (2, 2) or (n, 2, 2) float
        Inverse covariance of the keypoints [1 / px^2].
    options : FitOptions
        Loss and priors.
    """

    information: FloatArray
    options: FitOptions

    @classmethod
    def of(cls, result: FittedKeypoints) -> Likelihood:
        """The likelihood of the inliers that the result maximises, at its estimated sigma."""
        options, sigma = result.options, result.chosen_sigma
        if np.ndim(sigma) == 0:
            return cls(np.eye(2) / float(sigma) ** 2, options)
        information = pixel_information(sigma, len(result.inliers))
        return cls(information[result.inliers], options)

    def squares(self, residuals: FloatArray) -> FloatArray:
        """Squared whitened lengths (..., n) of residuals (..., n, 2) [px]."""
        u, v = residuals[..., 0], residuals[..., 1]
        (a, b), (_, c) = self.information.T
        squares = u * u * a + v * v * c
        if b.any():
            squares += 2 * b * u * v
        return np.asarray(squares)

    def losses(self, residuals: FloatArray) -> FloatArray:
        """The loss (n,) on each of the residuals (n, 2) [px], at most its whitened square."""
        return bent(self.squares(residuals), self.options.loss, self.options.loss_scale)

    def weights(self, residuals: FloatArray) -> FloatArray:
        """Weights (n,) of the squares that stand for the loss near residuals (n, 2) [px]."""
        squares, bend = self.squares(residuals), self.options.loss_scale
        if self.options.loss == "huber":
            return np.asarray(bend / np.maximum(np.sqrt(squares), bend))
        if self.options.loss == "cauchy":
            return np.asarray(1 / (1 + squares / bend**2))
        return np.ones(len(squares))

    def penalties(self, log_scales: FloatArray, log_focals: FloatArray) -> FloatArray:
        """Squared deviations (k,) from the priors, of the log scales (k, 3) and focals (k,)."""
        total = self.options.prior_weight * (log_scales**2).sum(axis=1)
        prior = self.options.focal_prior
        if prior is not None:
            total = total + ((log_focals - np.log(prior.focal)) / prior.relative_sigma) ** 2
        return np.asarray(total)


def bent(squares: FloatArray, loss: str, bend: float) -> FloatArray:
    """The loss, linear, huber or cauchy, on squared whitened lengths of any shape."""
    if loss == "huber":
        linear = 2 * bend * np.sqrt(squares) - bend**2
        return np.asarray(np.where(squares <= bend**2, squares, linear))
    if loss == "cauchy":
        return np.asarray(bend**2 * np.log1p(squares / bend**2))
    return squares
