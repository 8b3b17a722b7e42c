"""Quantiles of the F distribution; importing SciPy's takes longer than a fit."""

from __future__ import annotations

import math
from functools import lru_cache

_MOST_STEPS = 200
_MOST_TERMS = 10_000
_PRECISION = 1e-15
_TINY = 1e-300


@lru_cache(maxsize=64)
def upper_quantile(first: float, second: float, probability: float) -> float:
    """The value that an F variable of these degrees of freedom exceeds with a probability.

    The root of the incomplete beta function, by Newton's method between bounds: Abramowitz and
    Stegun, 26.6.2.

    Examples
    --------
    >>> round(upper_quantile(8, 12, 0.05), 4)
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
