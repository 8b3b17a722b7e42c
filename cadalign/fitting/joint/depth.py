"""Depth images, sampled at keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.fitting.joint.view import View
from cadalign.solvers.constants import CAUCHY
from cadalign.solvers.joint.evidence import Planes, Shape

_RADIUS = 2  # of the window about a keypoint [px]
_GAP = 4.0  # between surfaces in a window [sigma]
_LEAST_PIXELS = 3  # of a surface in a window
_LOSS_SCALE = 3.0  # a keypoint that something hides has the depth of what hides it


def sampled_planes(shape: Shape, rows: Sequence[list[int]], views: Sequence[View]) -> Planes:
    """Depths of the keypoints ``rows`` of every view that its depth image holds.

    They count under Cauchy's loss: a keypoint may be hidden by something nearer.
    """
    points, images, depths, sigmas = [], [], [], []
    for number, view in enumerate(views):
        image = view.depth_image
        if image is None:
            continue
        relative = float(cast(float, view.depth_sigma))
        depth = sample_depth(image, cast(FloatArray, view.points_2d), sigma=relative)
        known = np.isfinite(depth)
        points.append(np.array(rows[number], dtype=np.int64)[known])
        images.append(np.full(int(known.sum()), number))
        depths.append(depth[known])
        sigmas.append(relative * depth[known])
    if not points:
        none, no_value = np.empty(0, dtype=np.int64), np.empty(0)
        return Planes(none, none, np.empty((0, 3)), no_value, no_value, none, no_value)
    point = np.concatenate(points)
    count = len(point)
    return Planes(
        point,
        np.concatenate(images),
        np.tile([0.0, 0.0, 1.0], (count, 1)),
        np.concatenate(depths),
        1.0 / np.hypot(np.concatenate(sigmas), shape.spread[point]),
        np.full(count, CAUCHY),
        np.full(count, _LOSS_SCALE),
    )


def sample_depth(image: FloatArray, points_2d: FloatArray, *, sigma: float) -> FloatArray:
    """Depths (n,) of keypoints in a depth image; NaN where it holds none.

    At a silhouette, a window about the keypoint shows the object and what is behind it: the depths
    are split at gaps of some ``sigma`` (relative), and the nearest surface's median is taken.

    Examples
    --------
    >>> image = np.full((5, 8), 9.0)
    >>> image[:, :4] = 2.0
    >>> sample_depth(image, np.array([[3.4, 2.0], [7.0, 2.0], [60.0, 2.0]]), sigma=0.01).tolist()
    [2.0, 9.0, nan]
    """
    height, width = image.shape
    found = np.full(len(points_2d), np.nan)
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
    return found
