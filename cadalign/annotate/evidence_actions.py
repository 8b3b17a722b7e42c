"""Actions of the page on what is known beside the pairs: mask, edges, lengths, focal length."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cadalign.annotate.action import Action, ActionOutcome, inside
from cadalign.annotate.document import FocalChoice, Priors
from cadalign.annotate.evidence import (
    MarkedEvidence,
    MarkedLengths,
    MaskDrawing,
    Stroke,
    find_up,
)
from cadalign.annotate.masks import cut_out, decode_runs, encode_runs
from cadalign.annotate.objects import PhotoState
from cadalign.annotate.session import Session
from cadalign.errors import InputError
from cadalign.io.documents import Count, Finite, Point2, Positive

_FOCAL_RANGE = (0.05, 200.0)  # of a focal length [image widths]
_STRETCH_RANGE = (0.01, 2.0)  # of the standard deviation of a prior on the log scales
_LEAST_VERTICAL = 5.0  # [px]


class Focal(Action):
    """Choose a known or an estimated focal length."""

    known: bool
    pixels: Finite | None = None

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        if self.pixels is not None:
            low, high = (bound * state.photo.width for bound in _FOCAL_RANGE)
            if not low <= self.pixels <= high:
                raise InputError(
                    f"{self.pixels:g} px is no focal length of this photo",
                    where="pixels",
                    fix=f"give {low:.0f} to {high:.0f} px",
                )
        focal = FocalChoice(self.known, self.pixels)
        state.record(replace(state.document, focal=focal))
        return ActionOutcome()


class ChoosePriors(Action):
    """Choose the prior on the stretch, and whether an estimated focal length has one."""

    stretch: Finite | None = None
    focal: bool = True

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        low, high = _STRETCH_RANGE
        if self.stretch is not None and not low <= self.stretch <= high:
            raise InputError(
                f"{100 * self.stretch:g} % is no weak prior on the stretch",
                where="stretch",
                fix=f"give {100 * low:g} to {100 * high:g} %, or switch it off",
            )
        kept = state.document.priors.focal or state.intrinsics.likely_focal
        priors = Priors(self.stretch, kept if self.focal else None)
        state.record(replace(state.document, priors=priors))
        return ActionOutcome()


class PaintMask(Action):
    """Add a polygon, or a brush stroke of a ``radius`` [px], to the mask, or take it away."""

    points: list[Point2]
    radius: Positive | None = None
    adds: bool = True

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        least = 1 if self.radius is not None else 3
        if len(self.points) < least:
            raise InputError(
                "a polygon has at least three corners", where="points", fix="add corners"
            )
        return _add(Stroke(tuple(self.points), self.radius, adds=self.adds), state)


class LoadMask(Action):
    """Take a mask as it is given; see `encode_runs`."""

    runs: list[Count]

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        runs = tuple(self.runs)
        decode_runs(runs, state.photo.width, state.photo.height)
        evidence = state.document.evidence
        mask = MaskDrawing(strokes=(Stroke(runs=runs),))
        return _record(replace(evidence, mask=mask), state)


class CutOut(Action):
    """Add what GrabCut finds in a box to the mask."""

    corners: tuple[Point2, Point2]

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        mask = cut_out(session.pixels(state), np.array(self.corners, dtype=float))
        return _add(Stroke(runs=encode_runs(mask)), state)


class ClearMask(Action):
    """Remove the mask."""

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        return _record(replace(state.document.evidence, mask=None), state)


class AddVertical(Action):
    """Mark an edge of the scene that is vertical."""

    ends: tuple[Point2, Point2]

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        first, second = (inside(end, state) for end in self.ends)
        if np.hypot(first[0] - second[0], first[1] - second[1]) < _LEAST_VERTICAL:
            raise InputError(
                "the edge is too short", where="ends", fix="mark both ends of a long vertical edge"
            )
        evidence = state.document.evidence
        verticals = (*evidence.verticals, (first, second))
        outcome = _record(replace(evidence, verticals=verticals), state)
        camera = state.intrinsics.with_focal(state.document.focal)
        if len(verticals) == 1:
            return replace(outcome, message="Mark another vertical edge, apart from the first.")
        if find_up(verticals, camera) is None:
            return replace(
                outcome, message="These edges don't tell the vertical: mark one farther away."
            )
        return outcome


class ClearGravity(Action):
    """Remove the vertical edges and the direction of gravity."""

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        evidence = replace(state.document.evidence, verticals=(), up=None, up_sigma_deg=None)
        return _record(evidence, state)


class KnownLengths(Action):
    """Say which lengths are known along the model's x, y and z; ``sigma`` is relative."""

    width: Finite | None = None
    height: Finite | None = None
    length: Finite | None = None
    sigma: Finite | None = None

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        sigmas = () if self.sigma is None else (self.sigma,)
        lengths = MarkedLengths(self.width, self.height, self.length, sigmas).checked()
        return _record(replace(state.document.evidence, lengths=lengths), state)


EVIDENCE_ACTIONS: dict[str, type[Action]] = {
    "focal": Focal,
    "prior": ChoosePriors,
    "mask_paint": PaintMask,
    "mask_load": LoadMask,
    "mask_cut": CutOut,
    "mask_clear": ClearMask,
    "vertical": AddVertical,
    "gravity_clear": ClearGravity,
    "lengths": KnownLengths,
}
"""Actions by the name that the page sends as ``do``."""


def _add(stroke: Stroke, state: PhotoState) -> ActionOutcome:
    evidence = state.document.evidence
    mask = evidence.mask or MaskDrawing()
    drawn = replace(mask, strokes=(*mask.strokes, stroke))
    return _record(replace(evidence, mask=drawn), state)


def _record(evidence: MarkedEvidence, state: PhotoState) -> ActionOutcome:
    state.record(replace(state.document, evidence=evidence))
    return ActionOutcome()
