"""Support of an alignment by keypoints with outliers: their order, and a test against chance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats
from cadalign.errors import InputError, NoConsensusError
from cadalign.geometry.camera import Camera
from cadalign.solvers.minimal import MAX_SOLUTIONS

_CHANCE = 0.1  # expected number of models with as much support by chance
_LEAST_ERROR = 0.1  # no keypoint is taken to be better than that [px]


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
    extent = np.ptp(points_2d, axis=0) + 2 * max_reproj_error
    return min(float(np.prod(extent)), float(camera.width) * float(camera.height))


def check_support(
    supports: Sequence[Support],
    size: int,
    *,
    max_reproj_error: float,
    score: float,
    where: str,
) -> None:
    """Refuse an estimate whose poses have no more support together than chance gives.

    ``size`` keypoints determine a pose; ``score`` is the truncated sum of squares [px^2].

    Raises
    ------
    NoConsensusError
        It carries the score.
    """
    logarithm = sum(min(0.0, _log_expected_by_chance(each, size)) for each in supports)
    if np.isfinite(score) and logarithm <= math.log(_CHANCE):
        return
    inliers, count = sum(len(each.errors) for each in supports), sum(n for _, n, _ in supports)
    raise NoConsensusError(
        f"no alignment is supported: the best has {inliers} of {count} keypoints within "
        f"{max_reproj_error:g} px, which chance gives as well (score {score:.4g} px^2)",
        where=where,
        fix="check the correspondences and the camera, or raise max_reproj_error or max_iterations",
        score=score,
        inliers=inliers,
    )


def order_of_confidence(
    confidences: npt.ArrayLike | None, count: int
) -> npt.NDArray[np.intp] | None:
    """The order of falling confidence; None where there are none, or all are alike."""
    if confidences is None:
        return None
    values = as_floats(confidences, name="confidences", shape=(count,))
    if (values < 0).any():
        raise InputError(
            f"keypoint {int(np.argmax(values < 0))} has the confidence {values.min():g}",
            where="confidences",
            fix="give numbers that are not negative",
        )
    return np.argsort(-values, kind="stable") if np.ptp(values) > 0 else None


def _log_expected_by_chance(support: Support, size: int) -> float:
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
    radii = np.maximum(np.sort(errors), _LEAST_ERROR)
    logarithms = [
        math.log(MAX_SOLUTIONS * (count - size))
        + _log_choose(count, k)
        + _log_choose(k, size)
        + (k - size) * min(0.0, math.log(math.pi * radii[k - 1] ** 2 / area))
        for k in {*range(size + 1, min(size + 12, len(errors) + 1)), len(errors)}
    ]
    return float(min(logarithms))


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
