"""Errors of a keypoint that successive frames have in common, as those of most detectors.

Errors that are correlated by r from frame to frame, an autoregression of first order, have at slow
changes a spectral density that is (1 + r) / (1 - r) times that of independent errors (Priestley,
"Spectral Analysis and Time Series", 1981). Shape and smooth path rest on slow changes alone, so
that such errors count as independent ones of that variance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.estimation.joint_robust import whitened_residuals
from cadalign.solvers.joint.evidence import Evidence, State

_SURE = 2.0  # standard errors by which a correlation must differ from zero to be taken for one
_LARGEST = 0.9


class SuccessiveErrors(NamedTuple):
    """Sums over pairs of a keypoint's whitened residuals in a frame and in the next one.

    ``products`` are of both, ``squares`` of the later one, over ``number`` coordinates.
    """

    products: float = 0.0
    squares: float = 0.0
    number: int = 0

    @classmethod
    def of(cls, evidence: Evidence, state: State, *, first: int = 0) -> SuccessiveErrors:
        """The sums at a state, of pairs whose earlier frame is the ``first`` one or later."""
        sightings, residuals = evidence.sightings, whitened_residuals(evidence, state)
        order = np.lexsort((evidence.rig.pose[sightings.image], sightings.point))
        points, frames = sightings.point[order], evidence.rig.pose[sightings.image[order]]
        follows = (np.diff(points) == 0) & (np.diff(frames) == 1) & (frames[:-1] >= first)
        before, after = residuals[order[:-1]][follows], residuals[order[1:]][follows]
        if not np.isfinite(before).all() or not np.isfinite(after).all():
            return cls()
        return cls(float((before * after).sum()), float((after**2).sum()), before.size)

    def plus(self, other: SuccessiveErrors) -> SuccessiveErrors:
        """The sums of both."""
        return SuccessiveErrors(
            self.products + other.products,
            self.squares + other.squares,
            self.number + other.number,
        )

    @property
    def correlation(self) -> float:
        """Correlation of successive errors, 0 where it is not sure that there is one."""
        if not self.squares > 0:
            return 0.0
        found = self.products / self.squares
        return min(found, _LARGEST) if found > _SURE / np.sqrt(self.number) else 0.0


def weakened(evidence: Evidence, correlation: float) -> Evidence:
    """The evidence of keypoints whose errors are correlated in time, as if independent."""
    factor = np.sqrt((1 - correlation) / (1 + correlation))
    old = evidence.sightings
    return evidence._replace(sightings=old._replace(whitening=factor * old.whitening))
