"""Keypoints that disagree with an estimate: support by chance, and the usual mistakes by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import NoConsensusError
from cadalign.estimation.warning import EstimateWarning, Warnings
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import PIXEL_CENTRE, rescaled_pixels
from cadalign.solvers.minimal import MAX_SOLUTIONS

OTHER_SIZES = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2.0, 3.0, 4.0)
"""Usual sizes of other images of a photo, over that of its camera."""
_LEAST_GAIN = 2.0  # of -2 log likelihood, by which corrected data must explain more
_DECISIVE = 12.0  # the same where nothing is rejected
_AS_LIKELY = 6.0  # difference of -2 log likelihoods of mistakes that are both named
_SURE = 2 * math.log(100)  # the same of an uncertain shape; chance gives odds of 100 once in 100
_LARGEST_LOG = math.log(1e6)  # of the odds, in a message
_UPRIGHT = 0.5  # cosine between the model's y axis and the photo's upwards, at least
_MOST_INSIDE = 0.8  # of the keypoints lie in their image
SOLUTIONS_OF_FOUR = 2.3  # valid alignments to 4 points, in the mean
LEAST_ERROR = 0.1  # no keypoint is taken to be better than that [px]
_CHANCE_STRETCH = 3.2  # standard deviation of log scales of alignments by chance
_LEAST_SHARE = 0.01  # of alignments by chance that are as moderate, at a factor of 1.5
_MOST_NAMED = 5  # keypoints, in a message
_SAME_MIDDLE = 0.02  # of an image's size, from its middle to a principal point taken for it


class Explained(NamedTuple):
    """Agreement of keypoints with an estimate: -2 log likelihood of all, and number of inliers.

    ``up`` is the cosine between the model's y axis and the photo's upwards.
    """

    score: float
    inliers: int
    up: float


class Mistake(NamedTuple):
    """A usual mistake in keypoints, named by a clause; made again, it is undone.

    The model mirrored across x, u or v counted from the photo's other side, u and v swapped, pixels
    of an image ``factor`` times as large as the camera's, or, beside the keypoints, an ``up`` that
    points down and poses of cameras that are ``inverted``.
    """

    clause: str
    mirrored: bool = False
    flipped: tuple[bool, bool] = (False, False)
    swapped: bool = False
    factor: float = 1.0
    downward: bool = False
    inverted: bool = False

    def undo_3d(self, points_3d: FloatArray) -> FloatArray:
        """Keypoints on the model (n, 3) without the mistake."""
        return points_3d * [-1.0, 1.0, 1.0] if self.mirrored else points_3d

    def undo_2d(self, points_2d: FloatArray, camera: Camera) -> FloatArray:
        """Keypoints in the image (n, 2) [px] without the mistake."""
        if self.swapped:
            return np.ascontiguousarray(points_2d[:, ::-1])
        if self.factor != 1:
            return rescaled_pixels(points_2d, 1 / self.factor)
        last = np.array([camera.width - 1.0, camera.height - 1.0])
        return np.where(self.flipped, last - points_2d, points_2d)


_MISTAKES = (
    Mistake("the model is mirrored", mirrored=True),
    Mistake("u and v are swapped", swapped=True),
    Mistake("the photo is flipped", flipped=(True, False)),
    Mistake("v counts from the bottom", flipped=(False, True)),
)
DOWNWARD = Mistake("`up` points down (give its opposite)", downward=True)
INVERTED = Mistake(
    "`cam_from_rig` is the inverse, rig_from_cam (give np.linalg.inv of each)", inverted=True
)
Tried = Sequence[tuple[Mistake, Explained]]


def try_mistakes(
    explain: Callable[[Mistake], Explained | None],
    count: int,
    mistakes: Iterable[Mistake] = _MISTAKES,
) -> list[tuple[Mistake, Explained]]:
    """Explain the best estimate after each mistake is undone, where there is one.

    Scores become those of ``count`` keypoints in the pixels that are given.
    """
    pairs = ((mistake, explain(mistake)) for mistake in mistakes)
    return [
        (mistake, each._replace(score=each.score + 4 * count * math.log(mistake.factor)))
        for mistake, each in pairs
        if each is not None
    ]


def other_sizes(points_2d: FloatArray, camera: Camera) -> list[Mistake]:
    """Mistakes in the resolution of keypoints (n, 2), of images that hold most of them."""
    own = f"{camera.width} x {camera.height} px"
    found = []
    for factor in OTHER_SIZES:
        inside = camera.contains(rescaled_pixels(points_2d, 1 / factor))
        if inside.sum() > _MOST_INSIDE * len(points_2d):
            size = f"{camera.width * factor:.0f} x {camera.height * factor:.0f} px"
            clause = f"the keypoints are of images of {size}, the camera of {own}"
            found.append(Mistake(clause, factor=factor))
    return found


def larger_sizes(points_2d: FloatArray, camera: Camera) -> list[Mistake]:
    """The `other_sizes`, where the camera's image does not hold most keypoints (n, 2)."""
    holds_most = camera.contains(points_2d).sum() > _MOST_INSIDE * len(points_2d)
    return [] if holds_most else other_sizes(points_2d, camera)


def find_in_all(
    score: float,
    count: int,
    explain: Callable[[Mistake], Explained | None],
    more: Sequence[Mistake] = (),
) -> tuple[str, Mistake, float] | None:
    """Name the mistake without which all keypoints of an estimate without search would agree.

    ``score`` is that of the ``count`` keypoints as given; ``explain`` says None where they do not
    agree after a mistake is undone, one of ``more`` mistakes among them. Returns clauses, the
    likeliest mistake and its score.
    """
    tried = try_mistakes(explain, count, (*_MISTAKES, *more))
    tried = [each for each in tried if each[1].score < score - _DECISIVE]
    if not tried:
        return None
    mistake, best = min(tried, key=lambda each: each[1].score)
    return name_likely(tried, best), mistake, best.score


def name_likely(tried: Tried, best: Explained) -> str:
    """Clauses of the mistakes that are as likely as the best; first those of an upright object."""
    likely = [(m.clause, each) for m, each in tried if each.score <= best.score + _AS_LIKELY]
    upright = [clause for clause, each in likely if each.up > _UPRIGHT]
    others = [clause for clause, each in likely if each.up <= _UPRIGHT]
    named = _listed(upright or others)
    if upright and others:
        named += f" (or, if y is not up in the photo, {_listed(others)})"
    return named


def find_mistake(
    found: Explained,
    given: int,
    explain: Callable[[Mistake], Explained | None],
    more: Sequence[Mistake] = (),
) -> EstimateWarning | None:
    """Name the mistake without which more keypoints of a robust search would agree.

    ``found`` is what the estimate explains of the ``given`` number of keypoints; ``explain`` says
    what the best estimate explains after a mistake is undone, None where there is none; ``more``
    are mistakes in the resolution or beside the keypoints, tried where keypoints are rejected.
    Returns a warning; None where no mistake makes the data likelier.
    """

    def is_better(each: Explained) -> bool:
        """Likelier, and by more keypoints: outliers and wrong shapes change the likelihood, too."""
        more = each.inliers > found.inliers or each.inliers == given
        return more and each.score < found.score - _LEAST_GAIN

    rejected = given - found.inliers
    # Where all agree, perspective is so weak that they agree with a mirrored model if with any.
    first = 2 if rejected else 1
    tried = try_mistakes(explain, given, (*_MISTAKES[:first], *(more if rejected else ())))
    if not any(is_better(each) for _, each in tried):
        return None
    tried += try_mistakes(explain, given, _MISTAKES[first:])
    best = min((each for _, each in tried if is_better(each)), key=lambda each: each.score)
    return EstimateWarning(
        "mistake",
        f"{name_likely(tried, best)}: corrected, {best.inliers} of {given} keypoints agree; as "
        f"given, {rejected} ({100 * rejected / given:.0f} %) are rejected",
    )


def find_likelier(
    score: float,
    count: int,
    explain: Callable[[Mistake], Explained | None],
    more: Sequence[Mistake] = (),
) -> EstimateWarning | None:
    """Name the mistake without which the keypoints of an uncertain shape are likelier.

    Such a shape follows the keypoints of most mistakes, so that none is rejected: the likelihoods
    tell them apart. ``score`` is that of the ``count`` keypoints as given; ``more`` are mistakes
    beside them.
    """

    def likelier(tried: Tried) -> list[Explained]:
        return [each for _, each in tried if each.score < score - _SURE]

    # About a centred principal point, flips are the same as a mirrored model.
    tried = try_mistakes(explain, count, (*_MISTAKES[:2], *more))
    if not likelier(tried):
        return None
    tried += try_mistakes(explain, count, _MISTAKES[2:])
    best = min(likelier(tried), key=lambda each: each.score)
    odds = math.exp(min((score - best.score) / 2, _LARGEST_LOG))
    text = f"{name_likely(tried, best)}: corrected, the keypoints are {odds:.2g} times as likely"
    return EstimateWarning("mistake", text)


def _listed(clauses: Sequence[str]) -> str:
    *some, last = clauses
    return f"{', '.join(some)} or {last}" if some else last


def outside_image(
    points_2d: FloatArray, camera: Camera, *, agree: bool, view: int = 0, where: str = ""
) -> Warnings:
    """Warn about keypoints (n, 2) and a principal point that are none of the image's.

    ``view`` is the number of the view, ``where`` what the texts begin with.

    All keypoints lie beyond one side, or, where they do not ``agree``, most outside: of an object
    that is hidden or cropped, some may, and they may surround the image.
    """
    wrong = _wrong_principal_point(camera)
    doubts = () if wrong is None else (EstimateWarning("camera", where + wrong, view),)
    outside = np.flatnonzero(~camera.contains(points_2d)).tolist()
    count = len(outside)
    if 2 * count <= len(points_2d):
        return doubts
    last = np.array([camera.width, camera.height]) - PIXEL_CENTRE
    beyond = (points_2d < -PIXEL_CENTRE).all(axis=0) | (points_2d > last).all(axis=0)
    if agree and not beyond.any():
        return doubts
    text = (
        f"{where}{count} of {len(points_2d)} keypoints lie outside of the image of {camera.width} "
        f"x {camera.height} px: are they of another resolution than the camera, or of another "
        "photo?"
    )
    return (*doubts, EstimateWarning("outside-image", text, view, tuple(outside)))


def _wrong_principal_point(camera: Camera) -> str | None:
    """Says that a principal point is the middle of another image, or outside of its own."""
    if camera.is_centred:
        return None
    size, own = f"{camera.width} x {camera.height} px", f"({camera.cx:.4g}, {camera.cy:.4g})"
    middle = 2 * (camera.cx + PIXEL_CENTRE), 2 * (camera.cy + PIXEL_CENTRE)
    for factor in OTHER_SIZES:
        other = camera.width * factor, camera.height * factor
        apart = (abs(a - b) / b for a, b in zip(middle, other, strict=True))
        if max(apart) < _SAME_MIDDLE:
            return (
                f"the camera's principal point {own} is the middle of an image of "
                f"{other[0]:.0f} x {other[1]:.0f} px, its own has {size}: if the photo was resized "
                f"(not cut out), give Camera.resized({camera.width}, {camera.height}) of the "
                "camera of that size"
            )
    if camera.contains(np.array([[camera.cx, camera.cy]])).all():
        return None
    return (
        f"the camera's principal point {own} lies outside of its image of {size}, which is right "
        "only for a photo cut out of a larger one: compare the camera with the photo's size"
    )


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
