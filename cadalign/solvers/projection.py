"""Compiled passes over keypoints: are they finite, and what are their rays."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel


@kernel
def all_finite(points_3d: FloatArray, points_2d: FloatArray) -> bool:
    """Say whether no coordinate is NaN or infinite: a sum of zeros is zero only then."""
    total = 0.0
    for i in range(points_3d.shape[0]):
        total += 0.0 * (points_3d[i, 0] + points_3d[i, 1] + points_3d[i, 2])
    for i in range(points_2d.shape[0]):
        total += 0.0 * (points_2d[i, 0] + points_2d[i, 1])
    return total == 0.0


@kernel
def pinhole_rays(points_2d: FloatArray, fx: float, fy: float, cx: float, cy: float) -> FloatArray:
    """Normalised image coordinates (n, 2) of pixels (n, 2), for a lens without distortion."""
    rays = np.empty((points_2d.shape[0], 2))
    for i in range(points_2d.shape[0]):
        rays[i, 0] = (points_2d[i, 0] - cx) / fx
        rays[i, 1] = (points_2d[i, 1] - cy) / fy
    return rays
