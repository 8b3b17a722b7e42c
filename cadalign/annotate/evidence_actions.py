"""Actions of the page on what is known beside the pairs, and on other objects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from cadalign.annotate.annotation import Annotation
from cadalign.annotate.document import AnnotationDocument, History, Priors
from cadalign.annotate.evidence import (
    MarkedLengths,
    MarkedMask,
    cut_out,
    decode_runs,
    encode_runs,
    find_up,
)
from cadalign.annotate.files import NOTHING, AnnotationFiles
from cadalign.annotate.names import further_file
from cadalign.annotate.photos import FocalChoice
from cadalign.annotate.problem import LIKELY_STRETCH
from cadalign.errors import InputError
from cadalign.io.documents import Count, Finite, Point2
from cadalign.io.observation import Observation
from cadalign.io.observation_file import StartFields

_FOCAL_RANGE = (0.05, 200.0)  # of a focal length [image widths]
_STRETCH_RANGE = (0.01, 2.0)  # of the standard deviation of a prior on the log scales
_LEAST_VERTICAL = 5.0  # [px]


@dataclass(frozen=True)
class ActionOutcome:
    """Outcome of an action beside the changed document, for the user."""

    selected: int | None = None  # number of the pair that was placed or changed
    message: str = ""  # such as that the click missed the model
    shown: Annotation | None = None  # the one to go on with, if not the same


def another(state: Annotation) -> ActionOutcome:
    """Begin another object of the photo, with an observation file of its own."""
    session = state.session
    own = [each for each in session.photos if each.photo is state.photo]
    taken = {each.files.observation for each in session.photos}
    paths = (further_file(own[0].files.observation, number) for number in count(2))
    free = next(path for path in paths if path not in taken and not path.exists())
    stretch = None if session.shape.is_estimated else LIKELY_STRETCH
    priors = Priors(stretch, state.intrinsics.likely_focal)
    new = Annotation(
        session,
        state.photo,
        state.intrinsics,
        AnnotationFiles(free),
        Observation(*NOTHING, state.camera, up_axis=state.stored.up_axis),
        History(AnnotationDocument(focal=state.document.focal, priors=priors)),
        is_further=True,
    )
    session.photos.append(new)  # at the end: others keep their numbers
    return ActionOutcome(message="Mark the other object of this photo.", shown=new)


# What is known beside the pairs -------------------------------------------------------------------


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


def mask_load(state: Annotation, *, runs: list[Count]) -> None:
    """Take a mask as it is given; see `encode_runs`."""
    if not decode_runs(tuple(runs), state.photo.width, state.photo.height).any():
        what = "no pixel of the mask is white or coloured"
        fix = "draw it with 255 on the object; values of 16 bits are read by --mask"
        raise InputError(what, where="mask", fix=fix)
    state.mark(mask=MarkedMask(runs=tuple(runs)))


def mask_cut(state: Annotation, *, corners: tuple[Point2, Point2]) -> None:
    """Add what GrabCut finds in a box to the mask."""
    found = cut_out(state.session.pixels(state), np.array(corners, dtype=float))
    state.mark(mask=MarkedMask(runs=encode_runs(found | state.mask)))


def mask_clear(state: Annotation) -> None:
    """Remove the mask."""
    state.mark(mask=None)


def vertical(state: Annotation, *, ends: tuple[Point2, Point2]) -> ActionOutcome | None:
    """Mark an edge of the scene that is vertical."""
    for end in ends:
        state.require_inside(end)
    if np.hypot(*np.subtract(*ends)) < _LEAST_VERTICAL:
        fix = "mark both ends of a long vertical edge"
        raise InputError("the edge is too short", where="ends", fix=fix)
    verticals = (*state.document.evidence.verticals, ends)
    state.mark(verticals=verticals)
    if len(verticals) == 1:
        return ActionOutcome(message="Mark another vertical edge, apart from the first.")
    if find_up(verticals, state.camera) is None:
        message = "These edges leave the vertical open: mark one farther away."
        return ActionOutcome(message=message)
    return None


def gravity_clear(state: Annotation) -> None:
    """Remove the vertical edges and the direction of gravity."""
    state.mark(verticals=(), up=None, up_sigma_deg=None)


def lengths(
    state: Annotation,
    *,
    width: Finite | None = None,
    height: Finite | None = None,
    length: Finite | None = None,
    sigma: Finite | None = None,
) -> None:
    """Say which lengths are known along the model's x, y and z; ``sigma`` is relative."""
    given = MarkedLengths(width, height, length, () if sigma is None else (sigma,))
    state.mark(lengths=given.checked())


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


EVIDENCE_ACTIONS = (
    *(another, focal, prior, mask_load, mask_cut, mask_clear, vertical, gravity_clear),
    *(lengths, use_photo),
)
