"""Depths of keypoints in a depth image."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray

_RADIUS = 2  # of the window about a keypoint [px]
_GAP = 4.0  # between surfaces in a window [sigma]
_LEAST_PIXELS = 3  # of a surface in a window


def sample_depth(
    image: FloatArray, points_2d: FloatArray, *, sigma: float
) -> tuple[FloatArray, FloatArray]:
    """Depths (n,) of keypoints in a depth image, and their deviations; NaN where it holds none.

    At a silhouette, a window about the keypoint shows what is behind the object, too: it is split
    at gaps of some ``sigma`` (relative), and the nearest surface counts, with its spread where
    steep.
    """
    height, width = image.shape
    found, deviations = np.full((2, len(points_2d)), np.nan)
    for row, (x, y) in enumerate(points_2d):
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            continue
        left, top = round(float(x)) - _RADIUS, round(float(y)) - _RADIUS
        window = image[max(top, 0) : top + 2 * _RADIUS + 1, max(left, 0) : left + 2 * _RADIUS + 1]
        depths = np.sort(window[np.isfinite(window)])
        breaks = np.flatnonzero(np.diff(depths) > _GAP * sigma * depths[:-1]) + 1
        surfaces = [part for part in np.split(depths, breaks) if len(part) >= _LEAST_PIXELS]
        if surfaces:
            found[row] = np.median(surfaces[0])
            deviations[row] = max(sigma * found[row], surfaces[0].std())
    return found, deviations
