"""Quantiles of the chi-squared distribution; importing SciPy's takes longer than a fit."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np


def upper_tail(value: float, freedom: int) -> float:
    """Probability that a chi-squared variable exceeds a value.

    The sum of Poisson terms for an even number of degrees of freedom, with the complementary error
    function for an odd one: Abramowitz and Stegun, 26.4.4 and 26.4.5.

    Examples
    --------
    >>> round(upper_tail(3.841, 1), 4), round(upper_tail(5.991, 2), 4)
    (0.05, 0.05)
    """
    if value <= 0 or value == math.inf:
        return float(value <= 0)
    half = value / 2
    powers = np.arange(freedom % 2 / 2, freedom / 2)
    steps = np.log(np.maximum(powers, 0.5))
    steps[:1] = math.lgamma(1 + freedom % 2 / 2)
    terms = float(np.exp(powers * math.log(half) - half - np.cumsum(steps)).sum())
    return terms + math.erfc(math.sqrt(half)) if freedom % 2 else terms


@lru_cache(maxsize=64)
def upper_quantile(freedom: int, probability: float) -> float:
    """The value that a chi-squared variable exceeds with a probability.

    Examples
    --------
    >>> round(upper_quantile(8, 0.05), 3)
    15.507
    """
    low, high = 0.0, float(freedom)
    while upper_tail(high, freedom) > probability:
        low, high = high, 2 * high
    while True:
        middle = (low + high) / 2
        if middle in (low, high):
            return high
        low, high = (middle, high) if upper_tail(middle, freedom) > probability else (low, middle)
