"""Minima of the other evidence, refined with photos; photos that lack the outline are left out.

The likely minima and states beside the best one are brought to the outline in rounds
(`photo_rounds.py`), and ranked by the other evidence, by the colours that their silhouettes
separate, and by the places of the lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.contours.fit import Refined, tension
from cadalign.estimation.contours.measured import (
    Joined,
    Place,
    cost_of,
    weakest_steps,
    with_displacement_modes,
)
from cadalign.estimation.contours.photo_lines import (
    Outline,
    PhotoPyramid,
    photo_of,
)
from cadalign.estimation.contours.photo_rounds import (
    Approach,
    Pictured,
    approach,
    common_places,
    finish,
    noise_of_lines,
)
from cadalign.estimation.contours.surface import Surface, surfaces_of
from cadalign.estimation.model import Model
from cadalign.estimation.prior import ShapePrior
from cadalign.estimation.search import Minimum
from cadalign.estimation.uncertainty.summary import EvidenceSummary
from cadalign.estimation.view import View
from cadalign.estimation.warning import EstimateWarning
from cadalign.geometry.rotations import vector_from_rotation
from cadalign.io.images import ByteImage
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.joint.covariance import information_of
from cadalign.solvers.joint.evidence import State
from cadalign.solvers.joint.search import reduced, score_state

_TOLERANCE = 2.0  # [px], of a line that agrees, and the same relative to the silhouette's length
_RELATIVE_TOLERANCE = 0.01
_SIMILAR_TOLERANCE = 0.04  # where the model is only similar to the object
_STRAY = 0.2  # share of the lines whose places are of other things
_LINES_OF_PATCH = 5.0  # of which the colours count as independent
_MOST_MINIMA = 3  # that are starts
_MOST_FINISHED = 2
_UNLIKELY = 30.0  # excess score of a minimum that is still a start
_WEAKEST = 2  # directions of the pose along which further starts lie
_SIDEWAYS = 1.5  # standard deviations of these
_LEAST_TURN, _MOST_TURN = np.radians(2.0), np.radians(40.0)  # of a further start
_SAME_TURN = np.radians(1.0)
_LEAST_SUPPORT = 0.5  # share of the outline that must be found
_LEAST_CONTRAST = 2.0  # [nats], that colours must give the silhouette: noise gives one
_GOOD_SUPPORT = 0.75  # below which a warning says so
_MOST_RMS = 1.4  # of the lines found, in standard deviations, above which a warning says so
_LEAST_PROBABILITY = 1e-3  # of such a rise of the other residuals by chance


class OutlineSupport(NamedTuple):
    """Agreement of a photo with an outline.

    The ``share`` of it that was found within the tolerance, the number of ``lines``, their
    root mean square distance ``rms`` [px] and ``rms_sigmas``. The log likelihoods [nats] are those
    that the colours give the silhouette, ``contrast``, over one anywhere, and that the lines'
    places give the outline, ``agreement``, over places anywhere on the lines.
    """

    share: float
    lines: int
    rms: float
    rms_sigmas: float
    contrast: float
    agreement: float


_NO_SUPPORT = OutlineSupport(0.0, 0, 0.0, 0.0, 0.0, 0.0)


def _support_of(outline: Outline | None, own: FloatArray, *, is_exact: bool) -> OutlineSupport:
    """The support of an outline beside what all of it has in common, ``own`` (3,) as `Approach`."""
    if outline is None:
        return _NO_SUPPORT
    relative = _RELATIVE_TOLERANCE if is_exact else _SIMILAR_TOLERANCE
    tolerance = max(_TOLERANCE, relative * outline.silhouette.length)
    common = common_places(outline, own)
    distances = outline.places - common
    near: BoolArray = outline.is_told & (np.abs(distances) < tolerance)
    count = int(near.sum())
    contrast = 2 * len(near) / _LINES_OF_PATCH * outline.contrast
    factor, correlation = noise_of_lines(outline, own)
    residuals, told = outline.in_sigmas(common) / factor, outline.is_told
    sigmas = factor * np.where(told, outline.sigmas, 1.0)
    density = np.exp(-(residuals**2) / 2) / np.sqrt(2 * np.pi) / sigmas
    gains = np.log((1 - _STRAY) * density * 2 * outline.reach + _STRAY)  # some are other things'
    agreement = float(gains[told].sum() / correlation)
    if not count:
        return OutlineSupport(0.0, 0, 0.0, 0.0, contrast, agreement)
    rms = float(np.sqrt((distances[near] ** 2).mean()))
    rms_sigmas = float(np.sqrt((outline.in_sigmas(common)[near] ** 2).mean()))
    return OutlineSupport(count / len(near), count, rms, rms_sigmas, contrast, agreement)


class _Candidate(NamedTuple):
    """A start, what was refined from there, and where that led."""

    start: Minimum
    pictured: Pictured
    reached: Approach

    @property
    def supports(self) -> list[OutlineSupport]:
        """OutlineSupport of the outline by each photo."""
        is_exact, outlines = self.pictured.surface.is_exact, self.reached.outlines
        return [
            _support_of(outline, own, is_exact=is_exact)
            for outline, own in zip(outlines, self.reached.place.own, strict=True)
        ]

    @property
    def rank(self) -> float:
        """-2 log of its probability, by the other evidence and by the photos."""
        rest = cost_of(self.pictured.evidence, self.reached.place.state) + self.start.prior_score
        return rest - 2 * sum(each.contrast + each.agreement for each in self.supports)

    @property
    def minimum(self) -> Minimum:
        """The minimum, which lines count in by the colours that they separate."""
        evidence, state, *_ = cast(Joined, self.reached.joined)
        cost = cost_of(evidence, state)
        score = score_state(evidence, state) - cost + self.rank
        return self.start._replace(evidence=evidence, state=state, cost=cost, score=score)


def fit_photos(
    model: Model | ShapeModel,
    prior: ShapePrior,
    views: Sequence[View],
    minima: Sequence[Minimum],
) -> Refined:
    """Refine the likely minima of the other evidence with the views' photos.

    A photo counts where its view has no mask, which is the better outline: at least one must.
    Raises InputError if the model has no mesh.
    """
    cameras = minima[0].lenses.cameras
    photos = [
        photo_of(number, cameras[number], cast(ByteImage, view.image))
        for number, view in enumerate(views)
        if view.image is not None and view.mask is None
    ]
    keypoints = len(prior.ids)
    where = f"views[{views[photos[0].image].number}].image"
    surface = surfaces_of(model, minima[0].points[:keypoints], where).surfaces[0]
    warnings: list[EstimateWarning] = []
    found: dict[int, OutlineSupport] = {}
    left_out: dict[int, OutlineSupport] = {}
    refined = list(minima)
    while photos:
        best = _explored(minima, keypoints, photos, surface)
        wrong = _lacking(best, photos)
        if not wrong:
            supports = best[0].supports
            found = {photo.image: each for photo, each in zip(photos, supports, strict=True)}
            warnings.extend(_weak(found, views))
            refined = [each.minimum for each in best]
            break
        for photo, reason in wrong:
            number = views[photo.image].number
            text = f"views[{number}].image is left out: {reason}"
            warnings.append(EstimateWarning("photo", text, number))
            left_out[photo.image] = _NO_SUPPORT
            photos.remove(photo)
    summaries = [
        EvidenceSummary(
            "photo", views[image].number, own.lines, own.rms_sigmas, own.rms, "px", own.share
        )
        for image, own in {**found, **left_out}.items()
    ]
    return Refined(refined, summaries, warnings)


def _weak(found: dict[int, OutlineSupport], views: Sequence[View]) -> list[EstimateWarning]:
    """Warnings about photos that show only a part of the outline, or another thing's."""
    warnings = []
    for image, each in found.items():
        number = views[image].number
        where = f"views[{number}].image"
        if each.share < _GOOD_SUPPORT:
            text = f"{where} shows only {100 * each.share:.0f} % of the model's outline"
        elif each.rms_sigmas > _MOST_RMS:
            off = f"{each.rms_sigmas:.1f} standard deviations off the model's outline"
            text = f"{where}: edges lie {off}: some may be another object's"
        else:
            continue
        warnings.append(EstimateWarning("photo", text, number))
    return warnings


def _explored(
    minima: Sequence[Minimum], keypoints: int, photos: list[PhotoPyramid], surface: Surface
) -> list[_Candidate]:
    """The distinct best of all starts, the likeliest first."""
    near: list[_Candidate] = []
    for start, state in _starts(minima):
        evidence, state = with_displacement_modes(start.evidence, state)
        pictured = Pictured(evidence, keypoints, list(photos), surface)
        reached = approach(pictured, Approach(Place.of(state, len(photos))))
        if reached is not None:
            near.append(_Candidate(start, pictured, reached))
    finished = []
    for each in _distinct(near)[:_MOST_FINISHED]:
        reached = finish(each.pictured, each.reached)
        if reached is not None:
            finished.append(each._replace(reached=reached))
    return _distinct(finished)


def _distinct(candidates: list[_Candidate]) -> list[_Candidate]:
    """Candidates without those that equal a likelier one, the likeliest first."""
    kept: list[_Candidate] = []
    turns: list[FloatArray] = []
    for each in sorted(candidates, key=lambda candidate: candidate.rank):
        turn = each.reached.place.state.poses[0, :9].reshape(3, 3)
        gaps = [np.linalg.norm(vector_from_rotation(turn @ other.T)) for other in turns]
        if all(gap > _SAME_TURN for gap in gaps):
            kept.append(each)
            turns.append(turn)
    return kept


def _starts(minima: Sequence[Minimum]) -> list[tuple[Minimum, State]]:
    """The likely minima, and states beside the best one where its pose is known least."""
    best = minima[0]
    first = minima[:_MOST_MINIMA]
    starts = [(each, each.state) for each in first if each.score <= best.score + _UNLIKELY]
    _, information = information_of(*reduced(best.evidence, best.state))
    others = 6 * (len(best.state.poses) - 1) + len(best.state.log_focals) + 3
    for own in weakest_steps(information[:6, :6], _WEAKEST):
        step = np.concatenate([_SIDEWAYS * own, np.zeros(others)])
        if _LEAST_TURN < np.linalg.norm(step[:3]) < _MOST_TURN:
            starts.extend((best, Place.of(best.state).moved(sign * step).state) for sign in (1, -1))
    return starts


def _lacking(best: list[_Candidate], photos: list[PhotoPyramid]) -> list[tuple[PhotoPyramid, str]]:
    """Photos that lack the outline, or in which it contradicts the rest, and how.

    Of several that lack it the worse half comes first: these may have led the estimate astray.
    """
    if not best:
        return [(photos[0], "it shows no part of the model's outline")]
    supports = best[0].supports
    alike = [k for k, each in enumerate(supports) if each.contrast < _LEAST_CONTRAST]
    if alike:
        return [(photos[k], "the object has the colours of what is around it") for k in alike]
    shares = [each.share for each in supports]
    lacking = [k for k in np.argsort(shares).tolist() if shares[k] < _LEAST_SUPPORT]
    if lacking:
        worse = lacking[: -(-len(lacking) // 2)]
        text = "it shows only {:.0f} % of the model's outline"
        return [(photos[k], text.format(100 * shares[k])) for k in worse]
    start, pictured, reached = best[0]
    reason = tension(start, pictured.evidence, reached.place.state, _LEAST_PROBABILITY)
    return [] if reason is None else [(photos[int(np.argmin(shares))], reason)]
