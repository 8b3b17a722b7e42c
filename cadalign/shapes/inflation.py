"""Dependence of a shape model's inflation on the number of keypoints that are given."""

from __future__ import annotations

import math
from dataclasses import dataclass

from cadalign.arrays import is_number
from cadalign.errors import InputError

FEW = 6


@dataclass(frozen=True)
class FewKeypoints:
    """Share of the inflation that is left where few keypoints are given.

    The directions of shape that many keypoints determine vary little, and their variances are the
    least well learned; where few are given, errors are those along the main modes.

    Parameters
    ----------
    typical : float
        Number of keypoints from which on the inflation is the whole one.
    share : float
        Its share with `FEW` keypoints or less, in (0, 1].

    Raises
    ------
    InputError
        If a number is out of range.

    Examples
    --------
    >>> FewKeypoints(typical=12.0, share=0.81).share_of(6)
    0.81
    """

    typical: float
    share: float

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
