"""Quantiles of the chi-squared and F distributions; importing SciPy's takes longer than a fit."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

_MOST_STEPS = 200
_MOST_TERMS = 10_000
_PRECISION = 1e-15
_TINY = 1e-300


def chi_square_tail(value: float, freedom: int) -> float:
    """Probability that a chi-squared variable exceeds a value.

    The sum of Poisson terms for an even number of degrees of freedom, with the complementary error
    function for an odd one: Abramowitz and Stegun, 26.4.4 and 26.4.5.

    Examples
    --------
    >>> round(chi_square_tail(3.841, 1), 4), round(chi_square_tail(5.991, 2), 4)
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
def chi_square_quantile(freedom: int, probability: float) -> float:
    """The value that a chi-squared variable exceeds with a probability.

    Examples
    --------
    >>> round(chi_square_quantile(8, 0.05), 3)
    15.507
    """
    low, high = 0.0, float(freedom)
    while chi_square_tail(high, freedom) > probability:
        low, high = high, 2 * high
    while True:
        middle = (low + high) / 2
        if middle in (low, high):
            return high
        is_above = chi_square_tail(middle, freedom) > probability
        low, high = (middle, high) if is_above else (low, middle)


@lru_cache(maxsize=64)
def f_quantile(first: float, second: float, probability: float) -> float:
    """The value that an F variable of these degrees of freedom exceeds with a probability.

    The root of the incomplete beta function, by Newton's method between bounds: Abramowitz and
    Stegun, 26.6.2.

    Examples
    --------
    >>> round(f_quantile(8, 12, 0.05), 4)
    2.8486
    """
    a, b = first / 2, second / 2
    low, high = 0.0, 1.0
    x = a / (a + b)
    for _ in range(_MOST_STEPS):
        excess = _incomplete_beta(a, b, x) - (1 - probability)
        low, high = (low, x) if excess > 0 else (x, high)
        density = math.exp(_log_weight(a, b, x)) / (x * (1 - x))
        step = x - excess / density if density > 0 else low
        following = step if low < step < high else (low + high) / 2
        if abs(following - x) <= _PRECISION * x * (1 - x):
            break
        x = following
    return second * x / (first * (1 - x))


def _incomplete_beta(a: float, b: float, x: float) -> float:
    """The regularised incomplete beta function, by its continued fraction (26.5.8 there)."""
    if x > (a + 1) / (a + b + 2):  # there the fraction of the complement converges sooner
        return 1 - _incomplete_beta(b, a, 1 - x)
    fraction = c = 1.0
    d = 0.0
    for term in range(_MOST_TERMS):
        m = (term + 1) // 2
        if term == 0:
            numerator = 1.0
        elif term % 2:
            numerator = -(a + m - 1) * (a + b + m - 1) * x / ((a + 2 * m - 2) * (a + 2 * m - 1))
        else:
            numerator = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        d = 1 / ((1 + numerator * d) or _TINY)
        c = (1 + numerator / c) or _TINY
        fraction *= c * d
        if term and abs(c * d - 1) < _PRECISION:
            break
    return math.exp(_log_weight(a, b, x)) / a * (fraction - 1)


def _log_weight(a: float, b: float, x: float) -> float:
    """Logarithm of ``x^a (1 - x)^b / B(a, b)``."""
    beta = math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)
    return a * math.log(x) + b * math.log1p(-x) - beta
