"""Regions of errors that are Gaussian or, with heavier tails, follow a t distribution.

A covariance stays that of the errors: with nu > 2 degrees of freedom, squared distances of k
coordinates in stated deviations are distributed as k (nu - 2) / nu times F with k and nu degrees of
freedom (Kotz and Nadarajah, "Multivariate t distributions and their applications", 2004).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt


def probability_within(
    squares: npt.ArrayLike, dimension: int, degrees_of_freedom: float | None = None
) -> Any:
    """Probability of the region about an estimate that reaches as far as given errors.

    Parameters
    ----------
    squares : array of float
        Squared errors of ``dimension`` coordinates in stated deviations.
    dimension : int
    degrees_of_freedom : float, optional
        More than 2; None for Gaussian errors.

    Examples
    --------
    >>> round(float(probability_within(1.0, 1)), 4), round(float(probability_within(1.0, 1, 5)), 4)
    (0.6827, 0.7468)
    """
    from scipy.special import fdtr, gammainc

    if degrees_of_freedom is None:
        return gammainc(dimension / 2, np.asarray(squares) / 2)  # the distribution of chi-square
    share = degrees_of_freedom / (degrees_of_freedom - 2)
    return fdtr(dimension, degrees_of_freedom, np.asarray(squares) / dimension * share)


def radius_of(
    probability: float, dimension: int = 1, degrees_of_freedom: float | None = None
) -> float:
    """Radius, in stated deviations, of the region that holds the truth with a probability.

    The inverse of `probability_within`.

    Examples
    --------
    >>> round(radius_of(0.95), 2), round(radius_of(0.95, 3), 2), round(radius_of(0.95, 1, 5), 2)
    (1.96, 2.8, 1.99)
    """
    from scipy.special import fdtri, gammaincinv

    if degrees_of_freedom is None:
        return float(np.sqrt(2 * gammaincinv(dimension / 2, probability)))
    share = (degrees_of_freedom - 2) / degrees_of_freedom
    return float(np.sqrt(dimension * share * fdtri(dimension, degrees_of_freedom, probability)))
