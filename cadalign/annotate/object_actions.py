"""Actions of the page on objects, their models and photos, and what is known beside pairs."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from cadalign.annotate.document import AnnotationDocument, FocalChoice, FurtherView, Pair, Priors
from cadalign.annotate.estimate import LIKELY_STRETCH
from cadalign.annotate.evidence import (
    ChosenStart,
    FurtherEvidence,
    MarkedEvidence,
    MarkedLengths,
    MaskDrawing,
    Stroke,
    find_up,
)
from cadalign.annotate.files import AnnotationFiles
from cadalign.annotate.history import History
from cadalign.annotate.live import candidates_of
from cadalign.annotate.masks import cut_out, decode_runs, encode_runs
from cadalign.annotate.models import KeypointRegistry, OpenedModel
from cadalign.annotate.names import object_file, object_number
from cadalign.annotate.objects import PhotoState, label_of, shown_objects
from cadalign.annotate.session import ActionOutcome, Session
from cadalign.errors import InputError, quote
from cadalign.io.documents import Count, Finite, Index, Point2, Positive, Text

_LONGEST_NAME = 60


def add_object(
    session: Session, state: PhotoState, *, name: str = "", model: Index | None = None
) -> ActionOutcome:
    """Add an object to the photo, with the model of a number; by default that of this object."""
    photo, _ = session.place_of(state)
    free = _free_name(name, session.objects[photo], None)
    chosen = state.model if model is None else session.models[model]
    return ActionOutcome(shown=_add_object(session, photo, chosen, free))


def rename_object(session: Session, state: PhotoState, *, name: str) -> ActionOutcome:
    """Rename the object; an empty name gives it its number again."""
    photo, _ = session.place_of(state)
    free = _free_name(name, session.objects[photo], state)
    state.record(replace(state.document, name=free))
    return ActionOutcome()


def delete_object(session: Session, state: PhotoState) -> ActionOutcome:
    """Delete the object with its files; it can be brought back while the program runs."""
    label, owner = label_of(state), state.owner
    kept = owner.document
    owner.record(
        AnnotationDocument(focal=kept.focal, priors=kept.priors, name=kept.name, is_deleted=True)
    )
    for view in (owner, *owner.views):
        view.drawn = None
        session.deletions.add(session.place_of(view)[0], owner)
    return ActionOutcome(message=f"Deleted: {label}. Ctrl+Z brings it back.")


def restore_object(session: Session, state: PhotoState) -> ActionOutcome:
    """Bring back the object of the photo that was deleted last."""
    deleted = session.deletions.last(session.place_of(state)[0])
    if deleted is None:
        raise InputError("no deleted object is left", where="restore", fix="add one")
    return bring_back(deleted)


def add_view(session: Session, state: PhotoState, *, photo: Index) -> ActionOutcome:
    """Add another photo as a further view of the object."""
    target = session.photo_state(photo)
    if any(view.key == target.key for view in state.all_views):
        raise InputError(
            f"{target.photo.path.name} is a photo of this object already",
            where="photo",
            fix="choose another one",
        )
    if state.owner.is_rigid:
        raise InputError(
            "the cameras of this object's photos are known, the new one's is not",
            where="photo",
            fix="write its camera pose into the observation",
        )
    return ActionOutcome(shown=_add_view(session, state.owner, photo))


def remove_view(session: Session, state: PhotoState) -> ActionOutcome:
    """Take the photo from the object, with its pairs; undo brings it back."""
    if state.lead is None:
        raise InputError(
            "the object's first photo cannot be taken from it",
            where="photo",
            fix="delete the object, or take its other photos from it",
        )
    state.history.record(state.history.document.without_view(state.key))
    return ActionOutcome(shown=state.owner, message=f"{state.photo.path.name} is no longer used.")


def model(session: Session, state: PhotoState, *, category: Text, model: Text) -> ActionOutcome:
    """Go on with another model of the library, in all photos of the object.

    Pairs keep their keypoints by semantic id or name.
    """
    choice = session.choice
    if choice is None:
        raise InputError("the session has no library", where="model", fix="start with --library")
    mesh = choice.model((category, model)).mesh_path
    assert mesh is not None
    session.before_saving()  # where nothing may be written, nothing is changed either
    owner = state.owner
    old, new = owner.model, session.models.of(mesh)
    if new is old:
        return ActionOutcome()
    if session.ready:
        new.prepare(has_shape=session.shape is not None)
    carried = carry_keypoints(old.registry, new.registry, choice.ids_on(old.path))
    before = sum(pair.keypoint is not None for pair in state.document.pairs)
    history = owner.history.changed(lambda document: _carried(document, carried))
    for each in (owner, *owner.views):
        each.model, each.history = new, history
        each.files = replace(each.files, model=new.path)
        each.live = each.estimate = None
        each.proposals = tuple(
            replace(proposal, keypoint=carried[proposal.keypoint])
            for proposal in each.proposals
            if proposal.keypoint in carried
        )
    lost = before - sum(pair.keypoint is not None for pair in state.document.pairs)
    if not lost:
        return ActionOutcome()
    pairs = "1 pair has" if lost == 1 else f"{lost} pairs have"
    return ActionOutcome(message=f"{pairs} no keypoint on this model: click on it.")


OBJECT_ACTIONS = (
    *(add_object, rename_object, delete_object, restore_object, add_view, remove_view, model),
)


def bring_back(deleted: PhotoState) -> ActionOutcome:
    """Undo the deletion of an object."""
    deleted.history.undo()
    return ActionOutcome(shown=deleted, message=f"Brought back: {label_of(deleted)}.")


def carry_keypoints(
    old: KeypointRegistry, new: KeypointRegistry, known: Collection[int]
) -> dict[int, int]:
    """Ids of the old model's keypoints on the new one, by the same semantic id, else name.

    Only semantic ids that are ``known`` mean the same on both. A keypoint that was renamed keeps
    its name.
    """
    carried = {number: number for number, _ in old if number in known and number in new}
    for number in carried:
        if old[number].name != new[number].name:
            new.rename(number, old[number].name)
    free = {point.name: number for number, point in new if number not in carried}
    return carried | {
        number: free[point.name]
        for number, point in old
        if number not in carried and point.name in free
    }


def _carried(document: AnnotationDocument, carried: Mapping[int, int]) -> AnnotationDocument:
    """The document with its pairs' keypoints on the new model; halves without any are left out."""
    moved: list[Pair] = []
    for pair in document.pairs:
        keypoint = None if pair.keypoint is None else carried.get(pair.keypoint)
        if keypoint is not None or pair.uv is not None:
            moved.append(replace(pair, keypoint=keypoint))
    views = tuple(
        FurtherView(view.photo, _carried(view.document, carried)) for view in document.further_views
    )
    return replace(document, pairs=tuple(moved), further_views=views)


def _free_name(name: str, states: list[PhotoState], own: PhotoState | None) -> str:
    """The name without superfluous blanks; refuses one that is too long or another object's."""
    name = " ".join(name.split())
    if len(name) > _LONGEST_NAME:
        raise InputError(
            f"{quote(name[:_LONGEST_NAME])}... is too long",
            where="name",
            fix=f"give at most {_LONGEST_NAME} characters",
        )
    if any(label_of(each) == name for each in shown_objects(states) if each is not own):
        raise InputError(
            f"another object of this photo is called {quote(name)}",
            where="name",
            fix="choose another name",
        )
    return name


def _add_object(session: Session, photo: int, model: OpenedModel, name: str) -> PhotoState:
    """Add an object to the photo of a number; with the camera of the photo's other objects."""
    states = session.objects[photo]
    like = states[0]
    if session.shape is not None and session.shape.learned is not None and model is not like.model:
        raise InputError(
            "the shape is that of one category, with one model",
            where="model",
            fix="start without --shape for objects of several models",
        )
    first = like.files.observation
    taken = {object_number(each.files.observation) for each in states if each.lead is None}
    number = next(
        number
        for number in range(2, len(states) + 3)
        if number not in taken and not object_file(first, number).exists()
    )
    stretch = LIKELY_STRETCH if session.shape is None else None
    priors = Priors(stretch, like.intrinsics.likely_focal)
    document = AnnotationDocument(focal=like.document.focal, priors=priors, name=name)
    files = AnnotationFiles(object_file(first, number), like.photo.path, model.path)
    alike = next((each for each in session.states if each.model is model), like)
    further = FurtherEvidence(up_axis=alike.owner.further.up_axis)
    added = PhotoState(like.photo, files, like.intrinsics, History(document), model, further)
    states.append(added)
    return added


def _add_view(session: Session, owner: PhotoState, photo: int) -> PhotoState:
    """Add the photo of a number to an object, or one that was taken from it again."""
    like = session.objects[photo][0]
    view = next((each for each in owner.views if each.key == like.key), None)
    if view is None:
        view = owner.add_view(like.photo, like.intrinsics)
        session.objects[photo].append(view)
    shared = owner.document
    view.record(
        AnnotationDocument(
            focal=like.document.focal,
            priors=Priors(shared.priors.stretch, like.intrinsics.likely_focal),
            evidence=shared.evidence.shared_with(MarkedEvidence()),
            name=shared.name,
        )
    )
    return view


# What is known beside the pairs -------------------------------------------------------------------


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


def use_photo(session: Session, state: PhotoState, *, on: bool) -> ActionOutcome:
    """Choose whether the photos themselves count; the photo takes the place of its mask.

    What the mask alone has found is where the search in the photo begins.
    """
    evidence = replace(state.document.evidence, photo=on)
    if not on or evidence.mask is None:
        return _record(evidence, state)
    live, _ = session.live(state)
    if live.result is not None and state.lead is None:
        evidence = replace(evidence, start=ChosenStart.of(live.alignment))
    outcome = _record(replace(evidence, mask=None), state)
    return replace(outcome, message="The photo takes the place of the mask; undo brings it back.")


def begin_at(
    session: Session, state: PhotoState, *, candidate: Index | None = None
) -> ActionOutcome:
    """Begin at one of the alignments that the mask allows, 0 for the one shown; None for none."""
    if candidate is None:
        return _record(replace(state.document.evidence, start=None), state)
    live, _ = session.live(state)
    known = [] if live.result is None else candidates_of(live.result)
    if candidate >= len(known):
        raise InputError(
            f"there is no candidate {candidate}", where="candidate", fix="reload the page"
        )
    start = ChosenStart.of(known[candidate].alignment)
    return _record(replace(state.document.evidence, start=start), state)


EVIDENCE_ACTIONS = (
    *(focal, prior, mask_paint, mask_load, mask_cut, mask_clear, vertical, gravity_clear, lengths),
    *(use_photo, begin_at),
)


def _add(stroke: Stroke, state: PhotoState) -> ActionOutcome:
    evidence = state.document.evidence
    mask = evidence.mask or MaskDrawing()
    drawn = replace(mask, strokes=(*mask.strokes, stroke))
    return _record(replace(evidence, mask=drawn), state)


def _record(evidence: MarkedEvidence, state: PhotoState) -> ActionOutcome:
    state.record(replace(state.document, evidence=evidence))
    return ActionOutcome()
