"""Noise of a contour's samples, learned from their residuals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.contours.contour import Contour

LOSS_SCALE = 2.4
"""Scale of Cauchy's loss, in standard deviations: it then keeps 95 % of the information."""
LEAST_LOSS_SCALE = 1.0
"""Least scale of Cauchy's loss [px]: where pixels end, they displace a contour by up to that."""
LEAST_OFFSET = 0.1
"""Least standard deviation of the offset that all of a contour has in common [px]."""
_LEAST_OWN = 0.3  # [px], standard deviation of the part that is the model's
_FIRST_SHARE, _LARGEST_SHARE = 0.8, 0.99  # of a contour, that is the model's
_ROUNDS = 30
_TO_SIGMA = 1.4826  # from the median of absolute values to the standard deviation of a Gaussian
_OUTLYING = 3.5  # in standard deviations
_MOST_LAGS = 100
_LEAST_PAIRS = 20
_ALIKE = 0.2  # change of a variance's logarithm


class Noise(NamedTuple):
    """Noise of a contour's samples.

    Their standard deviation ``sigma`` [px], or its factor where samples have their own, the number
    of neighbours that count as one, and the standard deviation of the ``offset`` [px] that all have
    in common.
    """

    sigma: float
    correlation: float
    offset: float

    @property
    def loss_scale(self) -> float:
        """Scale of Cauchy's loss, in standard deviations of a sample."""
        return max(LOSS_SCALE, LEAST_LOSS_SCALE / self.sigma)

    def cost(self, residual: float) -> float:
        """Cost of one sample's residual [px]."""
        square = self.loss_scale**2
        return float(square / self.correlation * np.log1p((residual / self.sigma) ** 2 / square))

    def is_like(self, other: Noise) -> bool:
        """True if samples weigh about the same."""
        weights = self.sigma**2 * self.correlation / (other.sigma**2 * other.correlation)
        offsets = (self.offset / other.offset) ** 2
        return bool(max(abs(np.log(weights)), abs(np.log(offsets))) < _ALIKE)


def robust_deviation(residuals: FloatArray) -> float:
    """Deviation of residuals (n,) about 0, outliers among them; 0 for none."""
    return _TO_SIGMA * float(np.median(np.abs(residuals))) if len(residuals) else 0.0


def trimmed_deviation(residuals: FloatArray, least: float) -> float:
    """Root mean square of residuals (n,) about 0 without outliers, which exceed ``least``.

    It is 0 for none.
    """
    if not len(residuals):
        return 0.0
    kept = residuals[np.abs(residuals) < max(_OUTLYING * robust_deviation(residuals), least)]
    return float(np.sqrt((kept**2).mean()))


def correlation_length(contour: Contour, residuals: FloatArray, kept: BoolArray) -> float:
    """Number of neighbouring samples that count as one, at least 1.

    The integrated autocorrelation ``1 + 2 sum of rho`` of the residuals (S,) that are ``kept``, up
    to the first lag without positive correlation (Geyer, "Practical Markov chain Monte Carlo",
    1992).
    """
    values = np.where(kept, residuals, 0.0)
    variance = float((values**2).sum() / max(kept.sum(), 1))
    if not variance > 0:
        return 1.0
    total = 1.0
    for lag in range(1, _MOST_LAGS):
        pairs = contour.neighbours(kept, lag)
        count = int(pairs.sum())
        if count < _LEAST_PAIRS:
            break
        rho = float((values[lag:] * values[:-lag])[pairs].sum() / count / variance)
        if rho <= 0:
            break
        total += 2 * rho
    return total


def influence_length(
    contour: Contour, residuals: FloatArray, kept: BoolArray, scale: float
) -> float:
    """The `correlation_length` of the residuals' influence under Cauchy's loss of a scale.

    Runs of outliers have it, too.
    """
    influence = residuals / (1 + (residuals / scale) ** 2)
    return correlation_length(contour, influence, kept)


def cost_of_contour(residuals: FloatArray, reach: float) -> float:
    """The mean of -log density of a contour's distances (S,) from a rim, at most ``reach`` [px].

    Part of the contour is an occluder's, and lies anywhere within the reach; the rest is Gaussian.
    Its share and standard deviation are the likeliest, by expectation and maximisation (Dempster,
    Laird and Rubin, "Maximum likelihood from incomplete data via the EM algorithm", 1977).
    """
    squares, elsewhere = residuals**2, 1 / (2 * reach)
    share, variance = _FIRST_SHARE, max(float(np.median(squares)), _LEAST_OWN**2)
    for _ in range(_ROUNDS):
        own = share * np.exp(-squares / (2 * variance)) / np.sqrt(2 * np.pi * variance)
        density = own + (1 - share) * elsewhere
        belongs = own / density
        share = min(float(belongs.mean()), _LARGEST_SHARE)
        variance = max(float(belongs @ squares / max(belongs.sum(), 1e-9)), _LEAST_OWN**2)
    return float(-np.log(density).mean())
