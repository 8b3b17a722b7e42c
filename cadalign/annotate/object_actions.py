"""Actions of the page on objects, their models and photos, and what is known beside pairs."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from cadalign.annotate.document import AnnotationDocument, FurtherView, History, Pair, Priors
from cadalign.annotate.evidence import (
    MarkedEvidence,
    MarkedLengths,
    MaskDrawing,
    Stroke,
    cut_out,
    decode_runs,
    encode_runs,
    find_up,
)
from cadalign.annotate.files import AnnotationFiles
from cadalign.annotate.models import KeypointRegistry
from cadalign.annotate.names import object_file, object_number
from cadalign.annotate.objects import AnnotatedObject, PhotoState, shown_objects
from cadalign.annotate.photos import FocalChoice
from cadalign.annotate.problem import LIKELY_STRETCH
from cadalign.errors import InputError, quote
from cadalign.io.documents import Count, Finite, Index, Point2, Positive, Text
from cadalign.io.observation_file import StartFields

_LONGEST_NAME = 60
_FOCAL_RANGE = (0.05, 200.0)  # of a focal length [image widths]
_STRETCH_RANGE = (0.01, 2.0)  # of the standard deviation of a prior on the log scales
_LEAST_VERTICAL = 5.0  # [px]


@dataclass(frozen=True)
class ActionOutcome:
    """Outcome of an action beside the changed document, for the user."""

    selected: int | None = None  # number of the pair that was placed or changed
    message: str = ""  # such as that the click missed the model
    shown: PhotoState | None = None  # the object and photo to go on with, if not the same


def add_object(state: PhotoState, *, name: str = "", model: Index | None = None) -> ActionOutcome:
    """Add an object to the photo, with the model of a number; by default that of this object."""
    session = state.session
    states = session.objects[state.place[0]]
    like = states[0]
    name = _free_name(name, states, None)
    chosen = state.model if model is None else session.models[model]
    if session.shape.learned is not None and chosen is not like.model:
        fix = "start without --shape for objects of several models"
        raise InputError(
            "the shape is that of one category, with one model", where="model", fix=fix
        )
    first = like.owner.files.observation
    taken = {object_number(each.owner.files.observation) for each in states if each.is_first}
    number = next(
        number
        for number in range(2, len(states) + 3)
        if number not in taken and not object_file(first, number).exists()
    )
    stretch = None if session.shape.is_estimated else LIKELY_STRETCH
    priors = Priors(stretch, like.intrinsics.likely_focal)
    history = History(AnnotationDocument(focal=like.document.focal, priors=priors, name=name))
    alike = next((each for each in session.owners if each.model is chosen), like.owner)
    files = AnnotationFiles(object_file(first, number))
    owner = AnnotatedObject(session, chosen, files, history, up_axis=alike.up_axis)
    owner.first = PhotoState(owner, like.photo, like.intrinsics)
    owner.views.append(owner.first)
    states.append(owner.first)
    return ActionOutcome(shown=owner.first)


def rename_object(state: PhotoState, *, name: str) -> None:
    """Rename the object; an empty name gives it its number again."""
    free = _free_name(name, state.session.objects[state.place[0]], state)
    state.record(replace(state.document, name=free))


def delete_object(state: PhotoState) -> ActionOutcome:
    """Delete the object with its files; it can be brought back while the program runs."""
    label, owner = state.label, state.owner
    kept = owner.document
    owner.history.record(
        AnnotationDocument(focal=kept.focal, priors=kept.priors, name=kept.name, is_deleted=True)
    )
    for view in owner.states:
        view.drawn = None
    state.session.note_deletion(owner)
    return ActionOutcome(message=f"Deleted: {label}. Ctrl+Z brings it back.")


def restore_object(state: PhotoState) -> ActionOutcome:
    """Bring back the object of the photo that was deleted last."""
    deleted = state.session.last_deleted(state.place[0])
    if deleted is None:
        raise InputError("no deleted object is left", where="restore", fix="add one")
    return bring_back(deleted)


def bring_back(deleted: PhotoState) -> ActionOutcome:
    """Undo the deletion of an object."""
    deleted.owner.history.undo()
    return ActionOutcome(shown=deleted, message=f"Brought back: {deleted.label}.")


def add_view(state: PhotoState, *, photo: Index) -> ActionOutcome:
    """Add another photo as a further view of the object, or one that was taken from it again."""
    session, owner = state.session, state.owner
    target = session.photo_state(photo)
    if any(view.key == target.key for view in owner.shown):
        what = f"{target.photo.path.name} is a photo of this object already"
        raise InputError(what, where="photo", fix="choose another one")
    if any(view.evidence.cam_from_rig is not None for view in owner.views):
        what = "the cameras of this object's photos are known, the new one's is not"
        fix = "write its camera pose into the observation"
        raise InputError(what, where="photo", fix=fix)
    like = session.objects[photo][0]
    view = next((each for each in owner.states if each.key == like.key), None)
    if view is None:
        view = PhotoState(owner, like.photo, like.intrinsics)
        owner.views.append(view)
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
    return ActionOutcome(shown=view)


def remove_view(state: PhotoState) -> ActionOutcome:
    """Take the photo from the object, with its pairs; undo brings it back."""
    if state.is_first:
        what = "the object's first photo cannot be taken from it"
        fix = "delete the object, or take its other photos from it"
        raise InputError(what, where="photo", fix=fix)
    owner = state.owner
    owner.history.record(owner.document.without_view(state.key))
    return ActionOutcome(shown=owner.first, message=f"{state.photo.path.name} is no longer used.")


def model(state: PhotoState, *, category: Text, model: Text) -> ActionOutcome | None:
    """Go on with another model of the library, in all photos of the object.

    Pairs keep their keypoints by semantic id or name.
    """
    session, owner = state.session, state.owner
    if session.choice is None:
        raise InputError("the session has no library", where="model", fix="start with --library")
    mesh = session.choice.model((category, model)).mesh_path
    assert mesh is not None
    session.before_saving()  # where nothing may be written, nothing is changed either
    old, new = owner.model, session.models.of(mesh)
    if new is old:
        return None
    if session.ready:
        new.prepare()
    carried = carry_keypoints(old.registry, new.registry, session.choice.ids_on(old.path))
    before = len(state.document.keypoints)
    owner.history = owner.history.changed(lambda document: _carried(document, carried))
    owner.model, owner.alone = new, None
    for each in owner.states:
        each.live = None
        each.detected = tuple(
            replace(one, keypoint=carried[one.keypoint])
            for one in each.detected
            if one.keypoint in carried
        )
    lost = before - len(state.document.keypoints)
    if not lost:
        return None
    pairs = "1 pair has" if lost == 1 else f"{lost} pairs have"
    return ActionOutcome(message=f"{pairs} no keypoint on this model: click on it.")


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
        what = f"{quote(name[:_LONGEST_NAME])}... is too long"
        raise InputError(what, where="name", fix=f"give at most {_LONGEST_NAME} characters")
    if any(each.label == name for each in shown_objects(states) if each is not own):
        what = f"another object of this photo is called {quote(name)}"
        raise InputError(what, where="name", fix="choose another name")
    return name


# What is known beside the pairs -------------------------------------------------------------------


def focal(state: PhotoState, *, known: bool, pixels: Finite | None = None) -> None:
    """Choose a known or an estimated focal length."""
    low, high = (bound * state.photo.width for bound in _FOCAL_RANGE)
    if pixels is not None and not low <= pixels <= high:
        what = f"{pixels:g} px is no focal length of this photo"
        raise InputError(what, where="pixels", fix=f"give {low:.0f} to {high:.0f} px")
    state.record(replace(state.document, focal=FocalChoice(known, pixels)))


def prior(state: PhotoState, *, stretch: Finite | None = None, focal: bool = True) -> None:
    """Choose the prior on the stretch, and whether an estimated focal length has one."""
    low, high = _STRETCH_RANGE
    if stretch is not None and not low <= stretch <= high:
        what = f"{100 * stretch:g} % is no weak prior on the stretch"
        fix = f"give {100 * low:g} to {100 * high:g} %, or switch it off"
        raise InputError(what, where="stretch", fix=fix)
    kept = state.document.priors.focal or state.intrinsics.likely_focal
    state.record(replace(state.document, priors=Priors(stretch, kept if focal else None)))


def mask_paint(
    state: PhotoState, *, points: list[Point2], radius: Positive | None = None, adds: bool = True
) -> None:
    """Add a polygon, or a brush stroke of a ``radius`` [px], to the mask, or take it away."""
    if len(points) < (1 if radius is not None else 3):
        raise InputError("a polygon has at least three corners", where="points", fix="add corners")
    _add(Stroke(tuple(points), radius, adds=adds), state)


def mask_load(state: PhotoState, *, runs: list[Count]) -> None:
    """Take a mask as it is given; see `encode_runs`."""
    if not decode_runs(tuple(runs), state.photo.width, state.photo.height).any():
        what = "no pixel of the mask is white or coloured"
        fix = "draw it with 255 on the object; values of 16 bits are read by --mask"
        raise InputError(what, where="mask", fix=fix)
    state.mark(mask=MaskDrawing(strokes=(Stroke(runs=tuple(runs)),)))


def mask_cut(state: PhotoState, *, corners: tuple[Point2, Point2]) -> None:
    """Add what GrabCut finds in a box to the mask."""
    mask = cut_out(state.session.pixels(state), np.array(corners, dtype=float))
    _add(Stroke(runs=encode_runs(mask)), state)


def mask_clear(state: PhotoState) -> None:
    """Remove the mask."""
    state.mark(mask=None)


def _add(stroke: Stroke, state: PhotoState) -> None:
    mask = state.document.evidence.mask or MaskDrawing()
    state.mark(mask=replace(mask, strokes=(*mask.strokes, stroke)))


def vertical(state: PhotoState, *, ends: tuple[Point2, Point2]) -> ActionOutcome | None:
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


def gravity_clear(state: PhotoState) -> None:
    """Remove the vertical edges and the direction of gravity."""
    state.mark(verticals=(), up=None, up_sigma_deg=None)


def lengths(
    state: PhotoState,
    *,
    width: Finite | None = None,
    height: Finite | None = None,
    length: Finite | None = None,
    sigma: Finite | None = None,
) -> None:
    """Say which lengths are known along the model's x, y and z; ``sigma`` is relative."""
    given = MarkedLengths(width, height, length, () if sigma is None else (sigma,))
    state.mark(lengths=given.checked())


def use_photo(state: PhotoState, *, on: bool) -> ActionOutcome | None:
    """Choose whether the photos themselves count; the photo takes the place of its mask.

    What the mask alone has found is where the search in the photo begins.
    """
    evidence = state.document.evidence
    if not on or evidence.mask is None:
        state.mark(photo=on)
        return None
    live, _ = state.session.live(state)
    start = evidence.start
    if live.result is not None and state.is_first:
        start = StartFields.of(live.alignment)
    state.mark(photo=on, mask=None, start=start)
    return ActionOutcome(message="The photo takes the place of the mask; undo brings it back.")


OBJECT_ACTIONS = (
    *(add_object, rename_object, delete_object, restore_object, add_view, remove_view, model),
)
EVIDENCE_ACTIONS = (
    *(focal, prior, mask_paint, mask_load, mask_cut, mask_clear, vertical, gravity_clear, lengths),
    use_photo,
)
