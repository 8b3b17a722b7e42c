"""Likely estimates in the terms of the result, and the mixture of Gaussians that they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.geometry.alignment import Alignment
from cadalign.solvers.marginal.moments import Likely, Moments, moments_of

_SAME = 9.0  # squared distance of rotations, in the best one's deviations, of equal estimates


class Estimate(NamedTuple):
    """An estimate: points, the box's corners last, ``lengths`` of the box, covariances."""

    points: FloatArray
    scale: FloatArray
    poses: tuple[Alignment, ...]
    lengths: FloatArray
    covariance: FloatArray
    of_points: FloatArray
    of_seen: FloatArray
    likelihood: float


def stretch_of(lengths: FloatArray, of_mean: FloatArray) -> FloatArray:
    """Lengths (3,) over those of the mean; 1 where it has none."""
    has_length = of_mean > 0
    return np.where(has_length, lengths / np.where(has_length, of_mean, 1.0), 1.0)


def moments_of_estimates(estimates: Sequence[Estimate]) -> Moments:
    """Second moments of estimates about the first."""
    poses = [
        np.concatenate([each.poses[0].rotation.ravel(), each.poses[0].translation])
        for each in estimates
    ]
    return moments_of(
        Likely(
            np.array(poses),
            np.array([each.points * each.scale for each in estimates]),
            np.array([each.lengths for each in estimates]),
            np.array([each.covariance for each in estimates]),
            np.array([each.of_points for each in estimates]),
            np.array([each.of_seen for each in estimates]),
            np.array([each.likelihood for each in estimates]),
        )
    )


def is_other(moments: Moments, k: int) -> bool:
    """True if an estimate is not the first one within its deviations."""
    return bool(moments.distances[k] > _SAME)
