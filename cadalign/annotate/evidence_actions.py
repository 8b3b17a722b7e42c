"""Actions of the page on evidence beside the pairs: mask, vertical edges, known lengths."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cadalign.annotate.action import Action, Outcome, inside
from cadalign.annotate.evidence import (
    Evidence,
    Lengths,
    MaskDrawing,
    Stroke,
    check_lengths,
    find_up,
)
from cadalign.annotate.masks import cut_out, decode_runs, encode_runs
from cadalign.errors import InputError
from cadalign.io.documents import Count, Finite, Point2, Positive

if TYPE_CHECKING:
    from cadalign.annotate.session import PhotoState, Session

_LEAST_VERTICAL = 5.0  # [px]


class PaintMask(Action):
    """Add a polygon, or a brush stroke of a ``radius`` [px], to the mask, or take it away."""

    points: list[Point2]
    radius: Positive | None = None
    adds: bool = True

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        least = 1 if self.radius is not None else 3
        if len(self.points) < least:
            raise InputError(
                "a polygon has at least three corners", where="points", fix="add corners"
            )
        return _add(Stroke(tuple(self.points), self.radius, adds=self.adds), state)


class LoadMask(Action):
    """Take a mask as it is given; see `encode_runs`."""

    runs: list[Count]

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        runs = tuple(self.runs)
        decode_runs(runs, state.photo.width, state.photo.height)
        evidence = state.document.evidence
        mask = MaskDrawing(strokes=(Stroke(runs=runs),))
        return _record(replace(evidence, mask=mask), state)


class CutOut(Action):
    """Add what GrabCut finds in a box to the mask."""

    corners: tuple[Point2, Point2]

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        mask = cut_out(session.pixels(state), np.array(self.corners, dtype=float))
        return _add(Stroke(runs=encode_runs(mask)), state)


class ClearMask(Action):
    """Remove the mask."""

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        return _record(replace(state.document.evidence, mask=None), state)


class AddVertical(Action):
    """Mark an edge of the scene that is vertical."""

    ends: tuple[Point2, Point2]

    def apply(self, session: Session, state: PhotoState) -> Outcome:
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

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        evidence = replace(state.document.evidence, verticals=(), up=None, up_sigma_deg=None)
        return _record(evidence, state)


class KnownLengths(Action):
    """Say which lengths are known along the model's x, y and z; ``sigma`` is relative."""

    width: Finite | None = None
    height: Finite | None = None
    length: Finite | None = None
    sigma: Finite | None = None

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        sigmas = () if self.sigma is None else (self.sigma,)
        lengths = check_lengths(Lengths(self.width, self.height, self.length, sigmas))
        return _record(replace(state.document.evidence, lengths=lengths), state)


EVIDENCE_ACTIONS: dict[str, type[Action]] = {
    "mask_paint": PaintMask,
    "mask_load": LoadMask,
    "mask_cut": CutOut,
    "mask_clear": ClearMask,
    "vertical": AddVertical,
    "gravity_clear": ClearGravity,
    "lengths": KnownLengths,
}
"""Actions by the name that the page sends as ``do``."""


def _add(stroke: Stroke, state: PhotoState) -> Outcome:
    evidence = state.document.evidence
    mask = evidence.mask or MaskDrawing()
    drawn = replace(mask, strokes=(*mask.strokes, stroke))
    return _record(replace(evidence, mask=drawn), state)


def _record(evidence: Evidence, state: PhotoState) -> Outcome:
    state.history.record(replace(state.document, evidence=evidence))
    return Outcome()
