"""Support of an estimate by keypoints: chance, or data with a usual mistake, may give as much."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import NoConsensusError
from cadalign.geometry.camera import Camera
from cadalign.solvers.minimal import MAX_SOLUTIONS

LEAST_ERROR = 0.1  # no keypoint is taken to be better than that [px]
_MOST_NAMED = 5  # keypoints, in a message
_LEAST_GAIN = 2.0  # of -2 log likelihood, by which corrected data must explain more
_AS_LIKELY = 6.0  # difference of -2 log likelihoods of mistakes that are both named
_UPRIGHT = 0.5  # cosine between the model's y axis and the photo's upwards, at least


class Support(NamedTuple):
    """Keypoints that support one pose.

    Their ``errors`` (k,) [px], the number of ``given`` keypoints, and the ``area`` [px^2] over
    which outliers are scattered.
    """

    errors: FloatArray
    given: int
    area: float


class Explained(NamedTuple):
    """Agreement of keypoints with an estimate: -2 log likelihood of all, and number of inliers.

    ``up`` is the cosine between the model's y axis and the photo's upwards.
    """

    score: float
    inliers: int
    up: float


class Mistake(NamedTuple):
    """A usual mistake in keypoints, named by a clause; made again, it is undone.

    The model mirrored across x, u or v counted from the photo's other side, or u and v swapped.
    """

    clause: str
    mirrored: bool = False
    flipped: tuple[bool, bool] = (False, False)
    swapped: bool = False

    def undo_3d(self, points_3d: FloatArray) -> FloatArray:
        """Keypoints on the model (n, 3) without the mistake."""
        return points_3d * [-1.0, 1.0, 1.0] if self.mirrored else points_3d

    def undo_2d(self, points_2d: FloatArray, camera: Camera) -> FloatArray:
        """Keypoints in the image (n, 2) [px] without the mistake."""
        if self.swapped:
            return np.ascontiguousarray(points_2d[:, ::-1])
        last = np.array([camera.width - 1.0, camera.height - 1.0])
        return np.where(self.flipped, last - points_2d, points_2d)


# About a centred principal point, flips are the same as a mirrored model.
_MISTAKES = (
    Mistake("the model is mirrored", mirrored=True),
    Mistake("u and v are swapped", swapped=True),
    Mistake("the photo is flipped", flipped=(True, False)),
    Mistake("v counts from the bottom", flipped=(False, True)),
)


def find_mistake(
    found: Explained, given: int, explain: Callable[[Mistake], Explained | None]
) -> str | None:
    """Name the mistake without which the keypoints would agree much better.

    Parameters
    ----------
    found : Explained
        By the estimate.
    given : int
        Number of keypoints.
    explain : callable
        What the best estimate explains after a mistake is undone; None where there is none.

    Returns
    -------
    str or None
        A warning; None where no mistake makes the data likelier.
    """

    def explained(mistakes: Sequence[Mistake]) -> list[tuple[Mistake, Explained]]:
        pairs = ((mistake, explain(mistake)) for mistake in mistakes)
        return [(mistake, each) for mistake, each in pairs if each is not None]

    def is_better(each: Explained) -> bool:
        """Likelier, and by more keypoints: outliers and wrong shapes change the likelihood, too."""
        more = each.inliers > found.inliers or each.inliers == given
        return more and each.score < found.score - _LEAST_GAIN

    rejected = given - found.inliers
    # Where all agree, perspective is so weak that they agree with a mirrored model if with any.
    first = 2 if rejected else 1
    tried = explained(_MISTAKES[:first])
    if not any(is_better(each) for _, each in tried):
        return None
    tried += explained(_MISTAKES[first:])
    best = min((each for _, each in tried if is_better(each)), key=lambda each: each.score)
    likely = [(m.clause, each) for m, each in tried if each.score < best.score + _AS_LIKELY]
    upright = [clause for clause, each in likely if each.up > _UPRIGHT]
    others = [clause for clause, each in likely if each.up <= _UPRIGHT]
    named = _listed(upright or others)
    if upright and others:
        named += f" (or, if y is not up in the photo, {_listed(others)})"
    return (
        f"{named}: corrected, {best.inliers} of {given} keypoints agree; as given, "
        f"{rejected} ({100 * rejected / given:.0f} %) are rejected"
    )


def _listed(clauses: Sequence[str]) -> str:
    *some, last = clauses
    return f"{', '.join(some)} or {last}" if some else last


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
    solutions: float = MAX_SOLUTIONS,
    chance: float = 0.1,
    disagreeing: str = "",
) -> None:
    """Refuse an estimate whose poses have no more support together than chance gives.

    ``size`` keypoints determine a pose, with so many ``solutions``; ``score`` is the truncated sum
    of squares [px^2]. ``chance`` bounds the expected number of models with as much support;
    ``disagreeing`` are words about keypoints that disagree.

    Raises
    ------
    NoConsensusError
        It carries the score.
    """
    logarithm = sum(min(0.0, log_expected_by_chance(each, size, solutions)) for each in supports)
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
