"""Minima of the other evidence, refined with masks; masks that contradict it are left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, cast

import cv2
import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import DegenerateError
from cadalign.estimation.contours.contour import SPACING, Sight
from cadalign.estimation.contours.descent import ContourFit, Masked, Settled, settle, settle_with
from cadalign.estimation.contours.measured import (
    Place,
    cost_of,
    weakest_steps,
    with_displacement_modes,
)
from cadalign.estimation.contours.surface import Surface, SurfaceChoice, surfaces_of
from cadalign.estimation.contours.view_contour import ViewContour, contour_view, cost_of_contour
from cadalign.estimation.model import Model
from cadalign.estimation.prior import ShapePrior
from cadalign.estimation.result import Result
from cadalign.estimation.search import Minimum
from cadalign.estimation.uncertainty.summary import EvidenceSummary, MaskResiduals
from cadalign.estimation.view import View
from cadalign.estimation.warning import EstimateWarning
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.joint.covariance import information_of, scaled_information
from cadalign.solvers.joint.evidence import Evidence, State
from cadalign.solvers.joint.search import reduced, score_state

_MOST_STARTS = 4
_MOST_OPEN_STARTS = 8  # where nothing but the masks determines the estimate
_LEAST_INFORMATION = 1e-9  # about the worst known direction of the unknowns, relative
_UNLIKELY = 60.0  # excess score of a minimum without masks that is still tried with them
_AGREEING = 2.0  # [px], of the misfit of an exact model, above which other starts are tried
_DISPLACED = (-2.0, -1.0, 1.0, 2.0)  # standard deviations
# Standard deviations of a logarithm of a scale: below the first the rims are found from the
# estimate without masks, above the second its misfit says little about whether they were.
_WELL_KNOWN, _POORLY_KNOWN = 0.05, 0.25
_LEAST_SUPPORT = 0.5  # share of the contour that must agree
_LEAST_KEYPOINTS = 4  # that tell whether a mask is inverted
_LEAST_TOLERANCE = 3.0  # [px], of a sample that agrees, and the same relative to the mask's size
_RELATIVE_TOLERANCE = 0.02
_WARPED_TOLERANCE = 0.06  # where the model is only similar to the object
_LEAST_PROBABILITY = 1e-5  # of such a rise of the other residuals by chance
_LARGEST = 24.0  # [px]
_HULL_GAIN = 0.5  # misfit of hulls, relative, below which these take the place of the outlines
_INLIER = 3.5  # in standard deviations
_UNCOVERED = 0.1  # share of a mask, outside of the model's silhouette
_MOST_PIXELS = 5000  # of a mask, at which rays are cast for it
_OPEN_BORDER = 3  # [px], within which a mask may go on outside of the image
_LEAST_PIECE = 0.003  # of a piece of the mask, relative to the largest


class Refined(NamedTuple):
    """Minima with masks or photos, and what is to be noted of these in the result."""

    minima: list[Minimum]
    summaries: list[EvidenceSummary]
    warnings: list[EstimateWarning]
    residuals: tuple[MaskResiduals | None, ...] = ()
    """The contours of every view's mask."""

    def noted_in(self, result: Result) -> Result:
        """The result with what is known of the masks or photos."""
        posterior = result.posterior.stating(
            evidence=(*result.evidence, *self.summaries),
            warnings=(*result.warnings, *self.warnings),
        )
        residuals = self.residuals or result.mask_residuals
        return replace(result, mask_residuals=residuals, posterior=posterior)


class _Candidate(NamedTuple):
    """A start, what is to be refined from there, and where the steps led."""

    start: Minimum
    masked: Masked
    settled: Settled

    @property
    def score(self) -> float:
        """-2 log of its probability."""
        own, known = self.settled.score + self.start.prior_score, self.start.outline_score
        return own if known is None or not np.isfinite(own) else known

    def scored_by_outline(self, correlation: float) -> _Candidate:
        """The same with the score of a contour of which an occluder may have made a part.

        So many neighbours as the ``correlation`` count as one.
        """
        evidence, state, place, *_ = self.settled.joined
        rest = score_state(evidence, state) - self.settled.cost + self.start.prior_score
        rest += cost_of(self.masked.evidence, place.state)
        samples = sum(len(fit.residuals) for fit in self.settled.fits)
        outline = 2 * samples / correlation * _outline_cost(self.settled)
        return self._replace(start=self.start._replace(outline_score=rest + outline))

    @property
    def minimum(self) -> Minimum:
        evidence, state, *_ = self.settled.joined
        return self.start._replace(
            evidence=evidence, state=state, cost=self.settled.cost, score=self.score
        )


def fit_masks(
    model: Model | ShapeModel,
    prior: ShapePrior,
    views: Sequence[View],
    minima: Sequence[Minimum],
) -> Refined:
    """Refine the likely minima of the other evidence with the views' masks.

    The ``minima`` without masks, the likeliest first, are starts where these leave something open.
    Raises InputError if a mask has no contour, or the model has no mesh; DegenerateError if there
    is no estimate without the masks and no rim near them.
    """
    used = [
        contour_view(number, view, _mask_of(view), minima[0].lenses.cameras[number])
        for number, view in enumerate(views)
        if view.mask_image is not None
    ]
    where = _mask_of(views[used[0].image])
    choice = surfaces_of(model, minima[0].points[: len(prior.ids)], where)
    search = _Search.of(minima, len(prior.ids), choice)
    left_out: list[ViewContour] = []
    warnings: list[EstimateWarning] = []
    best: list[_Candidate] = []
    while used:
        best, used = search.best(used, views)
        wrong = _contradicting(best, used)
        if wrong is None:
            break
        contour, reason = wrong
        view = views[contour.image]
        where = _mask_of(view)
        if len(used) == 1 and search.is_open:
            if not best:
                raise DegenerateError(
                    "no part of the model's outline comes near its contour",
                    where=where,
                    fix="give an init that shows the model near the mask, or keypoints",
                )
            warnings.append(EstimateWarning("mask", f"{where}: {reason}", view.number))
            break
        text = f"{where} contradicts the rest and is left out: {reason}{_off_mask(view)}"
        warnings.append(EstimateWarning("mask", text, view.number))
        left_out.append(contour)
        used = [each for each in used if each is not contour]
    if used and search.by_outline:
        warnings.extend(_uncovered(best[0], views))
    fits = best[0].settled.fits if used else ()
    residuals: list[MaskResiduals | None] = [None] * len(views)
    for contour, fit in [*zip(used, fits, strict=True), *((each, None) for each in left_out)]:
        residuals[contour.image] = _residuals(contour, fit)
    summaries = [
        EvidenceSummary(
            "mask", view.number, int(each.inliers.sum()), each.rms / each.sigma, each.rms, "px"
        )
        for view, each in zip(views, residuals, strict=True)
        if each is not None
    ]
    found = [each.minimum for each in best] if used else list(minima)
    return Refined(found, summaries, warnings, tuple(residuals))


class _Search(NamedTuple):
    """Minima without masks, and the surfaces that are brought to the masks' contours from there.

    The search ``is_open`` where nothing but the masks determines the estimate. The minima of a mask
    alone are near their ends, and some of their ends may explain no more than a part of the
    contour: the outline's likelihood ranks them, ``by_outline``.
    """

    first: Minimum
    starts: list[tuple[Minimum, State]]
    keypoints: int
    choice: SurfaceChoice
    is_open: bool
    by_outline: bool

    @classmethod
    def of(cls, minima: Sequence[Minimum], keypoints: int, choice: SurfaceChoice) -> _Search:
        """The search from the likely ones of minima."""
        first = minima[0]
        is_open = not _is_determined(first)
        likely = [each for each in minima if is_open or each.score < first.score + _UNLIKELY]
        starts = [(each, each.state) for each in likely]
        most = _MOST_OPEN_STARTS if is_open else _MOST_STARTS
        by_outline = first.outline_score is not None
        return cls(first, starts[:most], keypoints, choice, is_open, by_outline)

    def best(
        self, contours: list[ViewContour], views: Sequence[View]
    ) -> tuple[list[_Candidate], list[ViewContour]]:
        """Candidates, the likeliest first, and the contours, or those of hulls in their place."""
        if self.by_outline:
            return self._by_outline(contours), contours
        surfaces, convex = self.choice
        best = self._explored(contours, surfaces)
        if not convex and not self.is_open:
            agrees = bool(best) and _misfit(best[0].settled) <= _AGREEING
            if not agrees or best[0].masked.surface.is_exact:
                others = _displaced(self.first, _POORLY_KNOWN if agrees else _WELL_KNOWN)
                best += self._replace(starts=others)._explored(contours, surfaces)
                best.sort(key=lambda each: _misfit(each.settled))
        hulls = [_hull_contour(each, views[each.image]) for each in contours] if convex else []
        known = [each for each in hulls if each is not None]
        if known and len(known) == len(contours):
            by_hulls = self._explored(known, convex)
            # Hulls that agree so much better: the rest of the outline is another object's.
            if by_hulls and (
                not best or _misfit(by_hulls[0].settled) < _HULL_GAIN * _misfit(best[0].settled)
            ):
                best, contours = by_hulls, known
        return _finished(best), contours

    def _by_outline(self, contours: list[ViewContour]) -> list[_Candidate]:
        """Candidates by the likelihood of a contour that is theirs in part."""
        best = _finished(self._explored(contours, self.choice.surfaces))
        if best:
            correlation = best[0].settled.noises[0].correlation
            best = [each.scored_by_outline(correlation) for each in best]
        return sorted(best, key=lambda each: each.score)

    def _explored(self, contours: list[ViewContour], surfaces: list[Surface]) -> list[_Candidate]:
        """Every start with the surface of the least cost, the least first.

        Surfaces of a learned shape follow its modes alone: with the keypoints' own displacements a
        step takes several times as long, and modes distinguish the surfaces.
        """
        cost = _outline_cost if self.by_outline else _misfit
        is_wide = self.is_open and not self.by_outline
        found = []
        for start, state in self.starts:
            evidence = start.evidence
            if not len(evidence.shape.modes):
                evidence, state = with_displacement_modes(evidence, state)
            tried = []
            for surface in surfaces:
                masked = Masked(evidence, self.keypoints, contours, surface)
                settled = settle(masked, state, is_wide=is_wide)
                if settled is not None:
                    tried.append(_Candidate(start, masked, settled))
            if tried:
                found.append(min(tried, key=lambda each: cost(each.settled)))
        return sorted(found, key=lambda each: cost(each.settled))


def _is_determined(minimum: Minimum) -> bool:
    """True if the evidence without masks determines all unknowns."""
    _, information = information_of(*reduced(minimum.evidence, minimum.state))
    if not np.isfinite(information.diagonal()).all() or not (information.diagonal() > 0).all():
        return False
    return bool(np.linalg.eigvalsh(scaled_information(information)[0])[0] > _LEAST_INFORMATION)


def _displaced(start: Minimum, least: float) -> list[tuple[Minimum, State]]:
    """States of an estimate without masks along the direction of which it knows least.

    Empty where the logarithms of all stretches have a standard deviation below ``least`` there.
    """
    _, information = information_of(start.evidence, start.state)
    (step,) = weakest_steps(information, 1)
    place = Place.of(start.state)
    if np.abs(place.moved(step).state.log_scales - start.state.log_scales).max() < least:
        return []
    return [(start, place.moved(sigmas * step).state) for sigmas in _DISPLACED]


def _finished(candidates: list[_Candidate]) -> list[_Candidate]:
    """The candidates with all that their shapes can follow, the likeliest first.

    Their scores are made comparable by the noise of the one that fits best.
    """
    if not candidates or (
        len(candidates) == 1 and not candidates[0].masked.evidence.shape.spread.any()
    ):
        return candidates
    noises, found = candidates[0].settled.noises, []
    for each in candidates:
        evidence, state = with_displacement_modes(
            each.masked.evidence, each.settled.joined.place.state
        )
        masked = each.masked._replace(evidence=evidence)
        own = each.settled.joined.place
        # The depths that meet the surface are points of the shape, and not the same everywhere.
        others = [
            other.settled.joined.place
            for other in candidates
            if other is not each
            and len(other.settled.joined.place.state.displacements) == len(own.state.displacements)
        ]
        place = own._replace(state=state)
        settled = settle_with(masked, place, noises, others)
        if settled is not None:
            found.append(each._replace(masked=masked, settled=settled))
    return sorted(found, key=lambda each: each.score)


def _misfit(settled: Settled) -> float:
    """Mean residual [px] of all samples, each at most `_LARGEST`, as of those without a rim."""
    return float(_distances(settled).mean())


def _outline_cost(settled: Settled) -> float:
    """Mean of -log density [1/px] of all samples, which an occluder may have made in part."""
    return cost_of_contour(_distances(settled), _LARGEST)


def _distances(settled: Settled) -> FloatArray:
    every = [np.nan_to_num(np.abs(fit.residuals), nan=_LARGEST) for fit in settled.fits]
    return np.asarray(np.minimum(np.concatenate(every), _LARGEST))


def _uncovered(best: _Candidate, views: Sequence[View]) -> list[EstimateWarning]:
    """Report masks of which no occluder, but a wrong pose or model leaves a part uncovered.

    The contour alone does not tell where the parts of an object are few pixels wide.
    """
    masked, state = best.masked, best.settled.joined.place.state
    posed, poses = masked.at(state)
    found = []
    for contour, fit in zip(masked.views, best.settled.fits, strict=True):
        camera = masked.camera_at(contour.image, contour.camera, state)
        rows, columns = np.nonzero(contour.mask[0] >= 0.5)
        pixels = np.column_stack([columns, rows]).astype(float)[:: 1 + len(rows) // _MOST_PIXELS]
        covered = Sight(posed.caster, camera, poses[contour.image]).covers(pixels)
        dilated = SPACING * len(contour.contour.points) * max(fit.offset, 0.0) / len(rows)
        share = 1 - float(covered.mean()) - dilated
        if share > _UNCOVERED:
            view = views[contour.image]
            text = (
                f"{_mask_of(view)}: the silhouette of the best pose found leaves "
                f"{100 * share:.0f} % of it uncovered: the pose may be wrong, or the model "
                "another; a larger image of the object, or keypoints, tell more"
            )
            found.append(EstimateWarning("mask", text, view.number))
    return found


def _contradicting(
    candidates: list[_Candidate], contours: list[ViewContour]
) -> tuple[ViewContour, str] | None:
    """The mask that contradicts the rest, and how; None where all agree."""
    if not candidates:
        return contours[0], "no part of the model's outline comes near its contour"
    best = candidates[0]
    relative = _RELATIVE_TOLERANCE if best.masked.surface.is_exact else _WARPED_TOLERANCE
    supports = []
    for contour, fit in zip(contours, best.settled.fits, strict=True):
        tolerance = max(_LEAST_TOLERANCE, relative * contour.contour.size)
        supports.append(
            float((np.abs(np.nan_to_num(fit.residuals, nan=np.inf)) < tolerance).mean())
        )
    worst = int(np.argmin(supports))
    if supports[worst] < _LEAST_SUPPORT:
        share = f"{100 * supports[worst]:.0f} % of its contour"
        return contours[worst], f"only {share} can be the model's outline"
    reason = tension(
        best.start, best.masked.evidence, best.settled.joined.place.state, _LEAST_PROBABILITY
    )
    return None if reason is None else (contours[worst], reason)


def _off_mask(view: View) -> str:
    """Report that most keypoints lie off a view's mask, as they do where it is inverted."""
    mask = cast("FloatArray | BoolArray", view.mask_image)
    pixels = np.round(view.pixels).astype(int)
    u, v = pixels[((pixels >= 0) & (pixels < mask.shape[::-1])).all(axis=1)].T
    count, off = len(u), int((mask[v, u] < 0.5).sum())
    if count < _LEAST_KEYPOINTS or 2 * off <= count:
        return ""
    return f"; {off} of {count} keypoints lie off it: it may be inverted, or another object's"


def tension(
    start: Minimum, evidence: Evidence, state: State, least_probability: float
) -> str | None:
    """Report other residuals that rise from a start's more than chance and noise explain."""
    from scipy.special import chdtri  # takes longer to import than all that is compiled

    equations = 2 * int((evidence.sightings.whitening[:, 2] > 0).sum())
    if not equations:
        return None
    alone = cost_of(*with_displacement_modes(start.evidence, start.state))
    joint = cost_of(evidence, state)
    free = 6 * len(start.state.poses) + int(evidence.scales.free.sum())
    redundancy = equations - free
    scale = max(1.0, alone / redundancy) if redundancy > 0 else 1.0
    unknowns = min(free + len(evidence.shape.modes), equations)
    if joint - alone <= scale * chdtri(unknowns, least_probability):
        return None
    times = np.sqrt(joint / max(alone, float(max(redundancy, 1))))
    return f"with it the other residuals are {times:.2g} times as large"


def _residuals(contour: ViewContour, fit: ContourFit | None) -> MaskResiduals:
    """The residuals of a mask; without a fit those of one that was left out."""
    points, normals, _ = contour.contour
    if fit is None:
        lacking = np.full(len(points), np.nan)
        unused = np.zeros(len(points), dtype=bool)
        nothing = float("nan"), 1.0, 0.0
        return MaskResiduals(points, normals, lacking, unused, *nothing, is_used=False)
    sigma, correlation, _ = fit.noise
    near = np.abs(np.nan_to_num(fit.residuals, nan=np.inf)) < _INLIER * sigma
    return MaskResiduals(points, normals, fit.residuals, near, sigma, correlation, fit.offset)


def _hull_contour(contour: ViewContour, view: View) -> ViewContour | None:
    """The contour of the convex hull of a view's mask; None where the mask leaves the image."""
    inside = np.asarray(view.mask_image) >= 0.5
    if inside.sum() > inside[_OPEN_BORDER:-_OPEN_BORDER, _OPEN_BORDER:-_OPEN_BORDER].sum():
        return None
    pieces, _ = cv2.findContours(
        inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE
    )
    largest = max(cv2.contourArea(piece) for piece in pieces)
    kept = [piece for piece in pieces if cv2.contourArea(piece) >= _LEAST_PIECE * largest]
    filled = np.zeros(inside.shape, dtype=np.uint8)
    cv2.fillConvexPoly(filled, cv2.convexHull(np.concatenate(kept)), 1)
    hull = replace(view, mask=filled > 0)
    return contour_view(contour.image, hull, _mask_of(view), contour.camera)


def _mask_of(view: View) -> str:
    return f"views[{view.number}].mask"
