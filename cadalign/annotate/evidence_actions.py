"""Actions of the page on what is known beside the pairs: mask, edges, lengths, focal length."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cadalign.annotate.document import FocalChoice, Priors
from cadalign.annotate.evidence import MarkedEvidence, MarkedLengths, MaskDrawing, Stroke, find_up
from cadalign.annotate.masks import cut_out, decode_runs, encode_runs
from cadalign.annotate.objects import PhotoState
from cadalign.annotate.session import ActionOutcome, Session
from cadalign.errors import InputError
from cadalign.io.documents import Count, Finite, Point2, Positive

_FOCAL_RANGE = (0.05, 200.0)  # of a focal length [image widths]
_STRETCH_RANGE = (0.01, 2.0)  # of the standard deviation of a prior on the log scales
_LEAST_VERTICAL = 5.0  # [px]


def focal(
    session: Session, state: PhotoState, *, known: bool, pixels: Finite | None = None
) -> ActionOutcome:
    """Choose a known or an estimated focal length."""
    low, high = (bound * state.photo.width for bound in _FOCAL_RANGE)
    if pixels is not None and not low <= pixels <= high:
        raise InputError(
            f"{pixels:g} px is no focal length of this photo",
            where="pixels",
            fix=f"give {low:.0f} to {high:.0f} px",
        )
    state.record(replace(state.document, focal=FocalChoice(known, pixels)))
    return ActionOutcome()


def prior(
    session: Session, state: PhotoState, *, stretch: Finite | None = None, focal: bool = True
) -> ActionOutcome:
    """Choose the prior on the stretch, and whether an estimated focal length has one."""
    low, high = _STRETCH_RANGE
    if stretch is not None and not low <= stretch <= high:
        raise InputError(
            f"{100 * stretch:g} % is no weak prior on the stretch",
            where="stretch",
            fix=f"give {100 * low:g} to {100 * high:g} %, or switch it off",
        )
    kept = state.document.priors.focal or state.intrinsics.likely_focal
    state.record(replace(state.document, priors=Priors(stretch, kept if focal else None)))
    return ActionOutcome()


def mask_paint(
    session: Session,
    state: PhotoState,
    *,
    points: list[Point2],
    radius: Positive | None = None,
    adds: bool = True,
) -> ActionOutcome:
    """Add a polygon, or a brush stroke of a ``radius`` [px], to the mask, or take it away."""
    if len(points) < (1 if radius is not None else 3):
        raise InputError("a polygon has at least three corners", where="points", fix="add corners")
    return _add(Stroke(tuple(points), radius, adds=adds), state)


def mask_load(session: Session, state: PhotoState, *, runs: list[Count]) -> ActionOutcome:
    """Take a mask as it is given; see `encode_runs`."""
    decode_runs(tuple(runs), state.photo.width, state.photo.height)
    mask = MaskDrawing(strokes=(Stroke(runs=tuple(runs)),))
    return _record(replace(state.document.evidence, mask=mask), state)


def mask_cut(
    session: Session, state: PhotoState, *, corners: tuple[Point2, Point2]
) -> ActionOutcome:
    """Add what GrabCut finds in a box to the mask."""
    mask = cut_out(session.pixels(state), np.array(corners, dtype=float))
    return _add(Stroke(runs=encode_runs(mask)), state)


def mask_clear(session: Session, state: PhotoState) -> ActionOutcome:
    """Remove the mask."""
    return _record(replace(state.document.evidence, mask=None), state)


def vertical(session: Session, state: PhotoState, *, ends: tuple[Point2, Point2]) -> ActionOutcome:
    """Mark an edge of the scene that is vertical."""
    first, second = ends
    for end in ends:
        state.require_inside(end)
    if np.hypot(first[0] - second[0], first[1] - second[1]) < _LEAST_VERTICAL:
        raise InputError(
            "the edge is too short", where="ends", fix="mark both ends of a long vertical edge"
        )
    evidence = state.document.evidence
    verticals = (*evidence.verticals, (first, second))
    outcome = _record(replace(evidence, verticals=verticals), state)
    message = ""
    if len(verticals) == 1:
        message = "Mark another vertical edge, apart from the first."
    elif find_up(verticals, state.camera) is None:
        message = "These edges leave the vertical open: mark one farther away."
    return replace(outcome, message=message)


def gravity_clear(session: Session, state: PhotoState) -> ActionOutcome:
    """Remove the vertical edges and the direction of gravity."""
    evidence = replace(state.document.evidence, verticals=(), up=None, up_sigma_deg=None)
    return _record(evidence, state)


def lengths(
    session: Session,
    state: PhotoState,
    *,
    width: Finite | None = None,
    height: Finite | None = None,
    length: Finite | None = None,
    sigma: Finite | None = None,
) -> ActionOutcome:
    """Say which lengths are known along the model's x, y and z; ``sigma`` is relative."""
    given = MarkedLengths(width, height, length, () if sigma is None else (sigma,))
    return _record(replace(state.document.evidence, lengths=given.checked()), state)


EVIDENCE_ACTIONS = (
    *(focal, prior, mask_paint, mask_load, mask_cut, mask_clear, vertical, gravity_clear, lengths),
)


def _add(stroke: Stroke, state: PhotoState) -> ActionOutcome:
    evidence = state.document.evidence
    mask = evidence.mask or MaskDrawing()
    drawn = replace(mask, strokes=(*mask.strokes, stroke))
    return _record(replace(evidence, mask=drawn), state)


def _record(evidence: MarkedEvidence, state: PhotoState) -> ActionOutcome:
    state.record(replace(state.document, evidence=evidence))
    return ActionOutcome()
