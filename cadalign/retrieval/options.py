"""Options of `cadalign.Library.retrieve`, and the likelihood behind the ranking.

A model of the library is scored by the likelihood of everything in the image, under these
assumptions:

- Each keypoint of the object is marked in the image with the probability 1/2, independently.
- A marked keypoint is at the projection of the model's keypoint, with Gaussian noise of the
  standard deviation ``sigma``; ``shape_sigma`` adds the differences of shape. A robust loss
  replaces the squared error.
- An image has 0.01 spurious keypoints on average, uniformly distributed over the image.
- The logarithms of the stretches along y and z are Gaussian with the mean 0 and the standard
  deviation 0.4; stretches are limited to 1/4 to 4.

Let r_i be the errors of the shared keypoints, whitened by their covariances C_i. Let m be the
number of the model's keypoints that the image lacks, and e the number of the image's keypoints that
the model lacks::

    log-likelihood = sum over the shared [log(1/2) - log(2 pi) - log det(C_i) / 2 - |r_i|^2 / 2]
                     + m log(1/2) + e log(0.01 / area) + log density of the stretches

at the pose and stretch that maximise it. Each keypoint of the image that a model lacks lowers the
log-likelihood by about 15, and each keypoint of a model that the image lacks by 0.7.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from cadalign.errors import InputError
from cadalign.estimation.options import FitOptions, Sigma

MISSING_PROB = 0.5
"""Probability that a keypoint of the object is not marked in the image."""
SPURIOUS = 0.01
"""Average number of spurious keypoints in an image."""
STRETCH_SIGMA = 0.4
"""Standard deviation of the Gaussian prior on the logarithm of each stretch."""


@dataclass(frozen=True)
class RetrievalOptions:
    """Options of a retrieval."""

    sigma: Sigma | None = 1.0
    """Standard deviation of the keypoints [px], one per keypoint, or a 2 x 2 covariance per
    keypoint."""
    loss: str = "linear"
    """Loss on the length of a whitened residual: linear (squared), huber or cauchy. The last two
    tolerate outliers."""
    loss_scale: float = 2.0
    """Length at which a robust loss departs from the squared loss [sigma]."""
    stretch: str | None = None
    """Axes whose stretch is estimated: "y", "z" or "none"; by default both y and z."""
    top: int = 10
    """Maximum number of matches."""
    category: str | None = None
    """Name or synset id of the category to search; by default all."""
    shape_sigma: float = 0.0
    """Typical distance of a model's keypoints from the object's, as a share of the extent of the
    keypoints in the image: for example 0.03 if the library only has similar models."""

    def __post_init__(self) -> None:
        if not isinstance(self.top, int) or self.top < 1:
            raise InputError(f"must be a whole number >= 1, not {self.top!r}", where="top")
        if self.sigma is None:
            fix = "give pixels, and shape_sigma where shapes differ"
            raise InputError("the noise must be known to compare models", where="sigma", fix=fix)
        if not 0 <= self.shape_sigma < math.inf:
            raise InputError(f"must be >= 0, not {self.shape_sigma}", where="shape_sigma")
        _ = self.fitting  # checks the other options

    @property
    def fitting(self) -> FitOptions:
        """Options of each model's fit; its sigma is not used."""
        return FitOptions(
            loss=self.loss,
            loss_scale=self.loss_scale,
            stretch=self.stretch,
            stretch_sigma=STRETCH_SIGMA,
        )
