"""Options of `cadalign.Library.retrieve`, and the likelihood behind the ranking.

A model of the library is scored by the likelihood of everything in the image, under these
assumptions:

- A keypoint of the object is marked in the image with the probability 1/2, independently of the
  others; it may be hidden, or overlooked.
- A marked keypoint lies at the projection of the model's keypoint, with Gaussian noise of the
  standard deviation ``sigma``, to which ``shape_sigma`` adds the differences of shape. A robust
  loss takes the place of the squared error.
- An image shows .01 keypoints, on average, that the object does not have, anywhere in the image
  with equal density.
- The logarithms of the stretches along y and z are Gaussian about zero, with the standard deviation
  .4, within 1/4 and 4.

So with N the number of shared keypoints, their errors r_i whitened by their covariances C_i, m the
number of the model's keypoints that the image lacks and e of the image's that the model lacks::

    log-likelihood = sum over the shared [log(1/2) - log(2 pi) - log det(C_i) / 2 - |r_i|^2 / 2]
                     + m log(1/2) + e log(.01 / area) + log density of the stretches

at the pose and stretch that maximise it. A model that lacks keypoints of the image has fewer errors
to explain, but each of them costs some 15 units; each keypoint of a model that the image does not
show costs 0.7.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from cadalign.errors import InputError
from cadalign.estimation.options import FitOptions, Sigma

MISSING_PROB = 0.5
"""Probability that a keypoint of the object is not marked in the image."""
SPURIOUS = 0.01
"""Average number of keypoints in an image that the object does not have."""
STRETCH_SIGMA = 0.4
"""Standard deviation of a Gaussian prior on the logarithm of each stretch."""


@dataclass(frozen=True)
class RetrievalOptions:
    """Options of a retrieval."""

    sigma: Sigma | None = 1.0
    """Standard deviation of the keypoints [px], one per keypoint, or a 2 x 2 covariance per
    keypoint."""
    loss: str = "linear"
    """Loss on the length of a whitened residual: linear (squared error), or huber or cauchy, which
    tolerate outliers."""
    loss_scale: float = 2.0
    """Residual length at which huber or cauchy departs from the squared error [sigma]."""
    stretch: str | None = None
    """Axes whose scale is estimated: yz (the default), y, z or none."""
    top: int = 10
    """Maximum number of matches."""
    category: str | None = None
    """Search only this category (name or synset id); by default all."""
    shape_sigma: float = 0.0
    """Typical distance of the model's keypoints from the object's, as a share of the keypoints'
    extent in the image. Give about 0.03 if the library has only similar models."""

    def __post_init__(self) -> None:
        if not isinstance(self.top, int) or self.top < 1:
            raise InputError(f"must be a whole number >= 1, not {self.top!r}", where="top")
        if self.sigma is None:
            fix = "give pixels, and shape_sigma where shapes differ"
            raise InputError("the noise must be known to compare models", where="sigma", fix=fix)
        if not 0 <= self.shape_sigma < math.inf:
            raise InputError(f"must be >= 0, not {self.shape_sigma}", where="shape_sigma")
        _ = self.fitting  # checks the options that it shares with a fit

    @property
    def fitting(self) -> FitOptions:
        """Options of the fit of each model; its sigma is not used."""
        return FitOptions(
            loss=self.loss,
            loss_scale=self.loss_scale,
            stretch=self.stretch,
            stretch_sigma=STRETCH_SIGMA,
        )
