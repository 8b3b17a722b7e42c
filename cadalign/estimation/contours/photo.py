"""Minima of the other evidence, refined with photos; photos that lack the outline are left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.contours.descent import Place
from cadalign.estimation.contours.photo_descent import (
    COARSE,
    OWN_SIGMAS,
    Approach,
    LineNoise,
    OutlineSupport,
    Pictured,
    approach,
    cost_of_rest,
    finish,
    support_of,
)
from cadalign.estimation.contours.photo_lines import PhotoPyramid, photo_of
from cadalign.estimation.contours.surface import Surface, surfaces_of, with_displacement_modes
from cadalign.estimation.model import Model
from cadalign.estimation.prior import ShapePrior
from cadalign.estimation.result import Result
from cadalign.estimation.search import Minimum
from cadalign.estimation.uncertainty.stated import Stated
from cadalign.estimation.uncertainty.summary import EvidenceSummary
from cadalign.estimation.view import View
from cadalign.geometry.rotations import vector_from_rotation
from cadalign.io.images import ByteImage
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.joint.covariance import information_of
from cadalign.solvers.joint.evidence import Evidence, State
from cadalign.solvers.joint.search import reduced, score_state

_MOST_MINIMA = 3  # that are starts
_MOST_FINISHED = 2
_UNLIKELY = 30.0  # excess score of a minimum that is still a start
_WEAKEST = 2  # directions of the pose along which further starts lie
_SIDEWAYS = 1.5  # standard deviations of these
_LEAST_TURN = np.radians(2.0)  # of a further start
_MOST_TURN = np.radians(40.0)
_SAME_TURN = np.radians(1.0)
_LEAST_SUPPORT = 0.5  # share of the outline that must be found
_GOOD_SUPPORT = 0.75  # below which a warning says so
_MOST_RMS = 1.75  # of the lines found, in standard deviations, above which a warning says so
_LEAST_PROBABILITY = 1e-3  # of such a rise of the other residuals by chance


class PhotoFit(NamedTuple):
    """Minima with the photos, what each photo supports, and what is left out.

    ``found`` has the `OutlineSupport` of each view by its number, None where no outline was found.
    """

    minima: list[Minimum]
    found: dict[int, OutlineSupport | None]
    warnings: tuple[str, ...]

    def noted_in(self, result: Result) -> Result:
        """The result with what is known of the photos."""
        if not self.found:
            return result
        lacking = OutlineSupport(0.0, 0, 0.0, 0.0, 0.0, 0.0)
        summaries = []
        for view, support in self.found.items():
            share, lines, rms, rms_sigmas, *_ = support or lacking
            summaries.append(EvidenceSummary("photo", view, lines, rms_sigmas, rms, "px", share))
        used = frozenset(view for view, support in self.found.items() if support is not None)
        stated = Stated.of(result.statistics)
        basis = stated.basis
        if used and basis is not None:
            basis = replace(basis, photos=used)
        statistics = replace(
            stated,
            evidence=(*result.evidence, *summaries),
            warnings=(*result.warnings, *self.warnings),
            basis=basis,
        )
        return replace(result, statistics=statistics)


class _Candidate(NamedTuple):
    """A start, what was refined from there, and where that led."""

    start: Minimum
    pictured: Pictured
    reached: Approach

    @property
    def supports(self) -> list[OutlineSupport]:
        """OutlineSupport of the outline by each photo."""
        is_exact = self.pictured.surface.is_exact
        return [
            support_of(outline, own, is_exact=is_exact)
            for outline, own in zip(self.reached.outlines, self.reached.own, strict=True)
        ]

    @property
    def rank(self) -> float:
        """-2 log of its probability, by the other evidence and by the photos."""
        rest = cost_of_rest(self.pictured, self.reached.state) + self.start.prior_score
        return rest - 2 * sum(each.contrast + each.agreement for each in self.supports)

    @property
    def minimum(self) -> Minimum:
        """The minimum, which lines count in by the colours that they separate."""
        full = cast(Evidence, self.reached.full)
        room = cast(State, self.reached.room)
        cost, _ = information_of(*reduced(full, room))
        score = score_state(full, room) - cost + self.rank
        return self.start._replace(evidence=full, state=room, cost=cost, score=score)


def fit_photos(
    model: Model | ShapeModel,
    prior: ShapePrior,
    views: Sequence[View],
    minima: Sequence[Minimum],
) -> PhotoFit:
    """Refine the likely minima of the other evidence with the views' photos.

    A photo counts where its view has no mask, which is the better outline. Raises InputError if the
    model has no mesh.
    """
    lenses = minima[0].lenses
    photos = [
        photo_of(number, lenses.cameras[number], cast(ByteImage, view.image))
        for number, view in enumerate(views)
        if view.image is not None and view.mask is None
    ]
    if not photos:
        return PhotoFit(list(minima), {}, ())
    keypoints = len(prior.ids)
    where = f"views[{photos[0].image}].image"
    surface = surfaces_of(model, minima[0].points[:keypoints], where).surfaces[0]
    left_out: dict[int, OutlineSupport | None] = {}
    warnings = []
    while photos:
        best = _explored(minima, keypoints, photos, surface)
        wrong = _lacking(best, photos)
        if wrong is None:
            supports = best[0].supports
            known = {p.image: each for p, each in zip(photos, supports, strict=True)}
            warnings.extend(_weak(known))
            found = {**known, **left_out}
            return PhotoFit([each.minimum for each in best], found, tuple(warnings))
        photo, reason = wrong
        warnings.append(f"views[{photo.image}].image is left out: {reason}")
        left_out[photo.image] = None
        photos.remove(photo)
    return PhotoFit(list(minima), left_out, tuple(warnings))


def _weak(found: dict[int, OutlineSupport]) -> list[str]:
    """Warnings about photos that show only a part of the outline, or another thing's."""
    warnings = []
    for view, each in found.items():
        where = f"views[{view}].image"
        if each.share < _GOOD_SUPPORT:
            warnings.append(f"{where} shows only {100 * each.share:.0f} % of the model's outline")
        elif each.rms_sigmas > _MOST_RMS:
            off = f"{each.rms_sigmas:.1f} standard deviations off the model's outline"
            warnings.append(f"{where}: edges lie {off}: some may be another object's")
    return warnings


def _explored(
    minima: Sequence[Minimum], keypoints: int, photos: list[PhotoPyramid], surface: Surface
) -> list[_Candidate]:
    """The distinct best of all starts, the likeliest first."""
    near: list[_Candidate] = []
    noises = [LineNoise()] * len(photos)
    for start, state in _starts(minima):
        evidence, state = with_displacement_modes(start.evidence, state)
        pictured = Pictured(evidence, keypoints, list(photos), surface)
        reached = approach(
            pictured, Approach(state, np.zeros((len(photos), len(OWN_SIGMAS)))), COARSE, noises
        )
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
    for each in sorted(candidates, key=lambda candidate: candidate.rank):
        if all(_turn_between(each, other) > _SAME_TURN for other in kept):
            kept.append(each)
    return kept


def _turn_between(one: _Candidate, other: _Candidate) -> float:
    """Angle between the first poses [rad]."""
    first, second = (each.reached.state.poses[0, :9].reshape(3, 3) for each in (one, other))
    return float(np.linalg.norm(vector_from_rotation(first @ second.T)))


def _starts(minima: Sequence[Minimum]) -> list[tuple[Minimum, State]]:
    """The likely minima, and states beside the best one where its pose is known least."""
    best = minima[0]
    likely = [each for each in minima[:_MOST_MINIMA] if each.score <= best.score + _UNLIKELY]
    starts = [(each, each.state) for each in likely]
    for step in _sideways(best):
        for sign in (1.0, -1.0):
            starts.append((best, Place(best.state, np.zeros((0, 3))).moved(sign * step).state))
    return starts


def _sideways(minimum: Minimum) -> list[FloatArray]:
    """Steps (U,) of the first pose along the directions of which least is known."""
    _, information = information_of(*reduced(minimum.evidence, minimum.state))
    own = information[:6, :6]
    sizes = np.sqrt(np.maximum(own.diagonal(), 1e-300))
    values, vectors = np.linalg.eigh(own / np.outer(sizes, sizes))
    steps = []
    length = 6 * len(minimum.state.poses) + len(minimum.state.log_focals) + 3
    for value, vector in zip(values[:_WEAKEST], vectors.T, strict=False):
        step = np.zeros(length)
        step[:6] = _SIDEWAYS * vector / sizes / np.sqrt(max(float(value), 1e-12))
        turn = float(np.linalg.norm(step[:3]))
        if _LEAST_TURN < turn < _MOST_TURN:
            steps.append(step)
    return steps


def _lacking(best: list[_Candidate], photos: list[PhotoPyramid]) -> tuple[PhotoPyramid, str] | None:
    """The photo that lacks the outline, or in which it contradicts the rest, and how; or None."""
    if not best:
        return photos[0], "it shows no part of the model's outline"
    supports = best[0].supports
    worst = int(np.argmin([each.share for each in supports]))
    if supports[worst].share < _LEAST_SUPPORT:
        share = f"{100 * supports[worst].share:.0f} % of the model's outline"
        return photos[worst], f"it shows only {share}"
    tension = _tension(best[0])
    return None if tension is None else (photos[worst], tension)


def _tension(candidate: _Candidate) -> str | None:
    """Report other residuals that rise more than chance and noise explain."""
    from scipy.special import chdtri  # takes longer to import than all that is compiled

    pictured, start = candidate.pictured, candidate.start
    equations = 2 * int((pictured.evidence.sightings.whitening[:, 2] > 0).sum())
    if not equations:
        return None
    alone = cost_of_rest(pictured, with_displacement_modes(start.evidence, start.state)[1])
    joint = cost_of_rest(pictured, candidate.reached.state)
    free = 6 * len(start.state.poses) + int(pictured.evidence.scales.free.sum())
    redundancy = equations - free
    scale = max(1.0, alone / redundancy) if redundancy > 0 else 1.0
    unknowns = min(free + len(pictured.evidence.shape.modes), equations)
    if joint - alone <= scale * chdtri(unknowns, _LEAST_PROBABILITY):
        return None
    return f"with it the other residuals are {np.sqrt(joint / max(alone, 1.0)):.2g} times as large"
