"""Actions of the page on evidence beside the pairs: focal length, priors, mask and photo."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cadalign.annotate.annotation import Annotation
from cadalign.annotate.document import Priors
from cadalign.annotate.evidence import MarkedMask, cut_out
from cadalign.annotate.photos import FocalChoice
from cadalign.errors import InputError
from cadalign.io.documents import Finite, Point2
from cadalign.io.observation_file import StartFields

_FOCAL_RANGE = (0.05, 200.0)  # of a focal length [image widths]
_STRETCH_RANGE = (0.01, 2.0)  # of the standard deviation of a prior on the log scales


@dataclass(frozen=True)
class ActionOutcome:
    """Outcome of an action beside the changed document, for the user."""

    selected: int | None = None  # number of the pair that was placed or changed
    message: str = ""  # such as that the click missed the model


def focal(state: Annotation, *, known: bool, pixels: Finite | None = None) -> None:
    """Choose a known or an estimated focal length."""
    low, high = (bound * state.photo.width for bound in _FOCAL_RANGE)
    if pixels is not None and not low <= pixels <= high:
        what = f"{pixels:g} px is no focal length of this photo"
        raise InputError(what, where="pixels", fix=f"give {low:.0f} to {high:.0f} px")
    state.record(replace(state.document, focal=FocalChoice(known, pixels)))


def prior(state: Annotation, *, stretch: Finite | None = None, focal: bool = True) -> None:
    """Choose the prior on the stretch, and whether an estimated focal length has one."""
    low, high = _STRETCH_RANGE
    if stretch is not None and not low <= stretch <= high:
        what = f"{100 * stretch:g} % is no weak prior on the stretch"
        fix = f"give {100 * low:g} to {100 * high:g} %, or switch it off"
        raise InputError(what, where="stretch", fix=fix)
    kept = state.document.priors.focal or state.intrinsics.likely_focal
    state.record(replace(state.document, priors=Priors(stretch, kept if focal else None)))


def mask_cut(state: Annotation, *, corners: tuple[Point2, Point2]) -> None:
    """Add what GrabCut finds in a box to the mask."""
    found = cut_out(state.session.pixels(state), np.array(corners, dtype=float))
    state.mark(mask=MarkedMask.of(found | state.mask))


def mask_clear(state: Annotation) -> None:
    """Remove the mask."""
    state.mark(mask=None)


def use_photo(state: Annotation, *, on: bool) -> ActionOutcome | None:
    """Choose whether the photo itself counts, which takes the place of the mask.

    What the mask alone has found is where the search in the photo begins.
    """
    evidence = state.document.evidence
    if not on or evidence.mask is None:
        state.mark(photo=on)
        return None
    live, _ = state.session.live(state)
    start = evidence.start if live.result is None else StartFields.of(live.alignment)
    state.mark(photo=on, mask=None, start=start)
    return ActionOutcome(message="The photo takes the place of the mask; undo brings it back.")


EVIDENCE_ACTIONS = (focal, prior, mask_cut, mask_clear, use_photo)
