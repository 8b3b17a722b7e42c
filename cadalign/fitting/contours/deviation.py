"""Accuracy of a contour: deviation and correlation of the residuals along it."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.fitting.contours.contour import Contour

_TO_SIGMA = 1.4826  # from the median of absolute values to the deviation of a Gaussian
_MOST_LAGS = 100
_LEAST_PAIRS = 20


def robust_deviation(residuals: FloatArray) -> float:
    """Deviation of residuals (n,) about 0, outliers among them; 0 for none."""
    return _TO_SIGMA * float(np.median(np.abs(residuals))) if len(residuals) else 0.0


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
        pairs = kept[lag:] & kept[:-lag] & (contour.curve[lag:] == contour.curve[:-lag])
        count = int(pairs.sum())
        if count < _LEAST_PAIRS:
            break
        rho = float((values[lag:] * values[:-lag])[pairs].sum() / count / variance)
        if rho <= 0:
            break
        total += 2 * rho
    return total
