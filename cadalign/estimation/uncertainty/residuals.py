"""Whitened residuals: their losses, and the distributions of sums of their squares."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.solvers.constants import CAUCHY, HUBER


def whitening_matrices(whitening: FloatArray) -> FloatArray:
    """Whitening (n, 3) as upper triangular matrices (n, 2, 2); see `whitening_of`."""
    matrices = np.zeros((len(whitening), 2, 2))
    matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1] = whitening.T
    return matrices


def bent(squares: FloatArray, loss: int, bend: float) -> FloatArray:
    """Loss on squared whitened lengths of any shape, one of `cadalign.solvers.constants`."""
    if loss == HUBER:
        linear = 2 * bend * np.sqrt(squares) - bend**2
        return np.asarray(np.where(squares <= bend**2, squares, linear))
    if loss == CAUCHY:
        return np.asarray(bend**2 * np.log1p(squares / bend**2))
    return squares


def loss_slopes(squares: FloatArray, loss: int, bend: float) -> tuple[FloatArray, FloatArray]:
    """First and second derivatives of a loss by the squared length: the first are weights."""
    if loss == HUBER:
        length = np.sqrt(np.maximum(squares, bend**2))
        is_bent = squares > bend**2
        return bend / length, np.where(is_bent, -bend / (2.0 * length**3), 0.0)
    if loss == CAUCHY:
        first = 1.0 / (1.0 + squares / bend**2)
        return first, -(first**2) / bend**2
    return np.ones_like(squares), np.zeros_like(squares)


def chi_square_tail(value: float, freedom: int) -> float:
    """Probability that a chi-squared variable exceeds a value.

    The sum of Poisson terms for an even number of degrees of freedom, with the complementary error
    function for an odd one: Abramowitz and Stegun, 26.4.4 and 26.4.5. Importing SciPy's takes
    longer than a fit.

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


def f_quantile(first: float, second: float, probability: float) -> float:
    """The value that an F variable of these degrees of freedom exceeds with a probability."""
    from scipy.special import fdtri  # only where sigma is estimated

    return float(fdtri(first, second, 1 - probability))


def f_quantile_of_two(second: float, probability: float) -> float:
    """`f_quantile` of 2 and some degrees of freedom in closed form; infinitely many are allowed."""
    if math.isinf(second):
        return -math.log(probability)
    return second / 2 * (math.pow(probability, -2 / second) - 1)
