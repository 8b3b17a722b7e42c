"""Errors of a shape model: tails of their distribution, and inflation by the keypoints given."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import is_number
from cadalign.errors import InputError


def probability_within(
    squares: npt.ArrayLike, dimension: int, degrees_of_freedom: float | None = None
) -> Any:
    """Probability of the region about an estimate that reaches as far as given errors.

    ``squares`` are squared errors of ``dimension`` coordinates in stated standard deviations;
    ``degrees_of_freedom`` are more than 2, None for Gaussian errors.

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


FEW = 6


@dataclass(frozen=True)
class FewKeypoints:
    """Share of the inflation that is left where few keypoints are given.

    The directions of shape that many keypoints determine vary little, and their variances are the
    least well learned; where few are given, errors are those along the main modes.

    Raises InputError if a number is out of range.

    Examples
    --------
    >>> FewKeypoints(typical=12.0, share=0.81).share_of(6)
    0.81
    """

    typical: float  # number of keypoints from which on the inflation is the whole one
    share: float  # its share with `FEW` keypoints or less, in (0, 1]

    def __post_init__(self) -> None:
        if not is_number(self.typical) or self.typical <= FEW:
            raise InputError(f"{self.typical!r} is not a number above {FEW}", where="typical")
        if not is_number(self.share) or not 0 < self.share <= 1:
            raise InputError(f"{self.share!r} is not a number in (0, 1]", where="share")
        object.__setattr__(self, "typical", float(self.typical))
        object.__setattr__(self, "share", float(self.share))

    def share_of(self, count: float) -> float:
        """Share of the inflation with a number of keypoints."""
        position = math.log(max(count, FEW) / FEW) / math.log(self.typical / FEW)
        return math.pow(self.share, 1 - min(position, 1.0))


def inflation_with(count: float, inflation: float, few_keypoints: FewKeypoints | None) -> float:
    """Inflation where a number of keypoints is given."""
    return inflation if few_keypoints is None else inflation * few_keypoints.share_of(count)
