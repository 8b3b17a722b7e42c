"""Support of an estimate by keypoints: more than chance gives, or none."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import NoConsensusError
from cadalign.geometry.camera import Camera
from cadalign.solvers.minimal import MAX_SOLUTIONS

SOLUTIONS_OF_FOUR = 2.3
"""Valid alignments to 4 points, in the mean."""
LEAST_ERROR = 0.1
"""No keypoint is taken to be better than that [px]."""
_CHANCE_STRETCH = 3.2  # standard deviation of log scales of alignments by chance
_LEAST_SHARE = 0.01  # of alignments by chance that are as moderate, at a factor of 1.5
_MOST_NAMED = 5  # keypoints, in a message


class Support(NamedTuple):
    """Keypoints that support one pose.

    Their ``errors`` (k,) [px], the number of ``given`` keypoints, and the ``area`` [px^2] over
    which outliers are scattered.
    """

    errors: FloatArray
    given: int
    area: float


def area_of(points_2d: FloatArray, camera: Camera, max_reproj_error: float) -> float:
    """The area [px^2] over which the outliers among keypoints (n, 2) are scattered."""
    with np.errstate(over="ignore"):  # an infinite extent is more than the image's, too
        extent = np.ptp(points_2d, axis=0) + 2 * max_reproj_error
        return min(float(np.prod(extent)), float(camera.width) * float(camera.height))


def check_support(
    supports: Sequence[Support],
    size: int,
    *,
    max_reproj_error: float,
    score: float,
    where: str,
    solutions: float = MAX_SOLUTIONS,
    chance: float = 0.1,
    share: float = 1.0,
    disagreeing: str = "",
) -> None:
    """Refuse an estimate whose poses have no more support together than chance gives.

    ``size`` keypoints determine a pose, with so many ``solutions``; ``score`` is the truncated sum
    of squares [px^2], which the NoConsensusError carries. ``chance`` bounds the expected number of
    models with as much support, of which a ``share`` is as moderate as this one; ``disagreeing``
    are words about keypoints that disagree.
    """
    logarithm = sum(min(0.0, log_expected_by_chance(each, size, solutions)) for each in supports)
    if logarithm < 0 and share < 1:  # the distribution of the product of both
        logarithm += math.log(share)
        logarithm += math.log1p(-logarithm)
    if np.isfinite(score) and logarithm <= math.log(chance):
        return
    inliers, count = sum(len(each.errors) for each in supports), sum(n for _, n, _ in supports)
    raise NoConsensusError(
        f"no alignment is supported: the best has {inliers} of {count} keypoints within "
        f"{max_reproj_error:g} px, which chance gives as well (score {score:.4g} px^2)"
        + (f"; {disagreeing}" if disagreeing else ""),
        where=where,
        fix="check the correspondences and the camera, raise max_reproj_error or max_iterations, "
        'or use loss="cauchy" for a model that is only similar',
        score=score,
        inliers=inliers,
    )


def share_as_moderate(scale: FloatArray, free: int) -> float:
    """The share of alignments by chance whose stretch is at most that of ``scale`` (3,).

    Alignments that keypoints scattered at random support are stretched by factors of 25 and more,
    in ``free`` axes.
    """
    largest = float(np.abs(np.log(scale)).max())
    return max(math.erf(largest / (math.sqrt(2) * _CHANCE_STRETCH)) ** free, _LEAST_SHARE)


def disagreeing(errors: FloatArray, kept: BoolArray) -> str:
    """Words about the keypoints with the largest errors (n,) [px] of those that are not kept."""
    rows = [row for row in np.argsort(-errors).tolist() if not kept[row]]
    if not rows:
        return ""
    listed = ", ".join(
        f"{row} ({errors[row]:.3g} px)" if np.isfinite(errors[row]) else f"{row}"
        for row in rows[:_MOST_NAMED]
    )
    more = f" and {len(rows) - _MOST_NAMED} more" if len(rows) > _MOST_NAMED else ""
    return f"keypoints that disagree: {listed}{more}"


def log_expected_by_chance(support: Support, size: int, solutions: float) -> float:
    """Log of the expected number of models as well supported among keypoints scattered at random.

    Moisan, Stival, "A probabilistic criterion to detect rigid point matches between two images and
    estimate the fundamental matrix", 2004: for the k best supported keypoints, each a sample of
    ``size`` keypoints, all choices of k keypoints and of a sample among them are counted, and the
    chance that the others lie within the largest of the k errors; the least such number over k
    (over the smallest dozen and all of them, which is where it lies).
    """
    errors, count, area = support
    if len(errors) <= size:
        return math.inf
    radii = np.maximum(np.sort(errors), LEAST_ERROR)
    logarithms = [
        math.log(solutions * (count - size))
        + _log_choose(count, k)
        + _log_choose(k, size)
        + (k - size) * min(0.0, math.log(math.pi * radii[k - 1] ** 2 / area))
        for k in {*range(size + 1, min(size + 12, len(errors) + 1)), len(errors)}
    ]
    return float(min(logarithms))


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
