"""Calibration of stated covariances: the probability of the region that just holds the truth."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.shapes.tails import probability_within

# Of a covariance's largest eigenvalue, and of the square of the largest length [units squared].
_NO_VARIANCE = 1e-12


def probability_level(
    error: FloatArray, covariance: FloatArray, degrees_of_freedom: float | None = None
) -> float | None:
    """Probability of the smallest ellipsoid about the estimate that holds the truth.

    Parameters
    ----------
    error : (k,) float
        Estimate minus truth.
    covariance : (k, k) float
        As the estimator states it. Directions without variance are held to be known.
    degrees_of_freedom : float, optional
        Of a t distribution; None for a Gaussian.

    Returns
    -------
    float or None
        In [0, 1], uniform where the covariance is that of the errors; 1 if the error has a part in
        a direction without variance; None if there is no variance at all.

    Examples
    --------
    >>> round(probability_level(np.array([1.0]), np.array([[1.0]])), 4)
    0.6827
    >>> probability_level(np.zeros(2), np.zeros((2, 2))) is None
    True
    """
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    free = values > _NO_VARIANCE * max(float(values[-1]), 0.0)
    if not np.isfinite(values).all() or not free.any():
        return None
    parts = vectors.T @ error
    if (parts[~free] ** 2 > 1e-6 * values[-1]).any():
        return 1.0
    square = float((parts[free] ** 2 / values[free]).sum())
    return float(probability_within(square, int(free.sum()), degrees_of_freedom))
