"""Actions of the page: a function each, of which the keyword arguments are the JSON document."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from typing import Any, get_type_hints

import msgspec

from cadalign.annotate.document import AnnotationDocument, Pair, Pixel
from cadalign.annotate.masks import nearest_corner
from cadalign.annotate.models import SAME_PLACE
from cadalign.annotate.object_actions import EVIDENCE_ACTIONS, OBJECT_ACTIONS, bring_back
from cadalign.annotate.objects import PhotoState
from cadalign.annotate.photos import Mark
from cadalign.annotate.session import ActionOutcome, Session
from cadalign.errors import InputError, quote
from cadalign.io.documents import ForeignDocument, Index, NotNegative, Point2, Point3, Text, convert

_LONGEST_REACH = 200.0  # of a corner of the photo [px]
_MISSED = "That click missed the model."
MIRRORED = 0.01
"""Largest distance of a point from a mirror image that it counts as [diagonals]."""


def perform(
    session: Session, number: int, action: Mapping[str, Any], *, slot: int | None = None
) -> ActionOutcome:
    """Do an action of the page, its name ``do`` and its arguments, and save its changes.

    It is done on an object of the photo of a number; see `Session.photo_state`.
    """
    with session.lock:
        state = session.photo_state(number, slot)
        if slot == 0 and session.objects[number][0].is_shown:
            state = session.objects[number][0]  # which is not listed while nothing is marked
        elif slot not in (None, session.place_of(state)[1]):
            raise InputError(
                "this object was deleted, or the photo is no longer one of its photos",
                where="object",
                fix="reload the page",
            )
        name = action.get("do")
        function = ACTIONS.get(name) if isinstance(name, str) else None
        if function is None:
            raise InputError(
                f"{quote(name)} is not an action", where="do", fix=f"known are {', '.join(ACTIONS)}"
            )
        before = {id(each): each.history.document for each in session.states}
        arguments = convert(action, _arguments_of(function))
        outcome = function(session, state, **msgspec.structs.asdict(arguments))
        owners = [each for each in session.states if each.lead is None]
        changed = [each for each in owners if before.get(id(each)) is not each.document]
        for each in changed:
            session.save(each)
        if changed and name not in _DELETING:
            session.deletions.note_change(number)
        if name in _RENAMING:
            session.save(state)
        return outcome


@cache
def _arguments_of(function: Callable[..., ActionOutcome]) -> type[msgspec.Struct]:
    """The document of a function's keyword arguments."""
    hints = get_type_hints(function, include_extras=True)
    fields = [
        (name, hints[name], msgspec.NODEFAULT if each.default is each.empty else each.default)
        for name, each in inspect.signature(function).parameters.items()
        if each.kind is each.KEYWORD_ONLY
    ]
    return msgspec.defstruct(function.__name__, fields, bases=(ForeignDocument,), kw_only=True)


def place_uv(
    session: Session,
    state: PhotoState,
    *,
    uv: Point2,
    pair: Index | None = None,
    snap: NotNegative = 0.0,
) -> ActionOutcome:
    """Place a photo half, by preference of the given pair; see `move` for ``snap``."""
    place = _snapped(uv, snap, session, state)
    document, number = state.document.place_uv(place, pair)
    state.record(document)
    return ActionOutcome(number, _no_corner(snap, moved=place != uv))


def place_keypoint(
    session: Session, state: PhotoState, *, keypoint: Index, pair: Index | None = None
) -> ActionOutcome:
    """Place a model half, a keypoint of the registry, by preference of the given pair."""
    state.model.registry[keypoint]  # refuses an unknown one
    document, number = state.document.place_keypoint(keypoint, pair)
    state.record(document)
    return ActionOutcome(number)


def pick(
    session: Session,
    state: PhotoState,
    *,
    origin: Point3,
    direction: Point3,
    near: Index | None = None,
    snap: NotNegative = 0.0,
    pair: Index | None = None,
) -> ActionOutcome:
    """Place a model half by a ray; see `_aimed_at`."""
    keypoint = _aimed_at(state, origin, direction, near, snap)
    if keypoint is None:
        return ActionOutcome(message=_MISSED)
    return place_keypoint(session, state, keypoint=keypoint, pair=pair)


def repick(
    session: Session,
    state: PhotoState,
    *,
    pair: Index,
    origin: Point3,
    direction: Point3,
    near: Index | None = None,
    snap: NotNegative = 0.0,
) -> ActionOutcome:
    """Move the model half of a pair by a ray; see `_aimed_at`."""
    keypoint = _aimed_at(state, origin, direction, near, snap)
    if keypoint is None:
        return ActionOutcome(pair, _MISSED)
    state.record(state.document.exchange_keypoint(pair, keypoint))
    return ActionOutcome(pair)


def mirrored(session: Session, state: PhotoState, *, pair: Index) -> ActionOutcome:
    """Begin a pair at the mirror image of another's model point."""
    keypoint = state.document.pair(pair).keypoint
    registry, model = state.model.registry, state.model.cad
    point = None if keypoint is None else model.mirrored(registry[keypoint].xyz)
    if point is None:
        raise InputError(
            "its model point has no mirror image", where="pair", fix="choose another pair"
        )
    known = registry.find(point.xyz, tolerance=MIRRORED * model.diagonal)
    image = registry.add(point) if known is None else known
    return place_keypoint(session, state, keypoint=image)


def suggested(session: Session, state: PhotoState, *, pair: Index | None = None) -> ActionOutcome:
    """Place the suggested keypoint, by preference of the given pair."""
    _, suggestion = session.live(state)
    if suggestion is None:
        raise InputError(
            "there is no suggested keypoint yet", where="suggestion", fix="place more pairs"
        )
    keypoint = suggestion.point.semantic_id
    if keypoint is None:
        keypoint = state.model.registry.add(suggestion.point)
    return place_keypoint(session, state, keypoint=keypoint, pair=pair)


def move(
    session: Session,
    state: PhotoState,
    *,
    pair: Index,
    uv: Point2,
    gesture: Index | None = None,
    snap: NotNegative = 0.0,
) -> ActionOutcome:
    """Move a photo half; moves of one gesture are undone together.

    It goes to a corner of the photo at most ``snap`` px away.
    """
    place = _snapped(uv, snap, session, state)
    step = None if gesture is None else (pair, gesture)
    state.record(state.document.move(pair, place), step=step)
    return ActionOutcome(pair, _no_corner(snap, moved=place != uv))


def release(session: Session, state: PhotoState, *, pair: Index) -> ActionOutcome:
    """Remove the model half of a pair."""
    state.record(state.document.release_keypoint(pair))
    return ActionOutcome(pair)


def delete(session: Session, state: PhotoState, *, pair: Index) -> ActionOutcome:
    """Delete a pair."""
    state.record(state.document.delete(pair))
    return ActionOutcome()


def rename(session: Session, state: PhotoState, *, pair: Index, name: Text) -> ActionOutcome:
    """Rename the keypoint of a pair."""
    keypoint = state.document.pair(pair).keypoint
    if keypoint is None:
        raise InputError(
            "this pair has no model point yet", where="pair", fix="click on the model first"
        )
    state.model.registry.rename(keypoint, name)
    return ActionOutcome(pair)


def identify(
    session: Session, state: PhotoState, *, pair: Index, label: Index | Text
) -> ActionOutcome:
    """Say which keypoint of the category's shape the model point of a pair is."""
    keypoint, shape = state.document.pair(pair).keypoint, session.shape
    if keypoint is None or shape is None or label not in shape.ids:
        raise InputError(
            f"{quote(label)} is no keypoint of the shape", where="label", fix="choose one"
        )
    registry = state.model.registry
    if shape.is_named:
        registry.rename(keypoint, str(label))
        return ActionOutcome(pair)
    point = registry[keypoint]
    own = point.name if point.name != f"point {keypoint}" else f"keypoint {label}"
    known = registry.add_as(int(label), replace(point, name=own))
    state.record(state.document.exchange_keypoint(pair, known))
    return ActionOutcome(pair)


def accept(
    session: Session, state: PhotoState, *, keypoints: list[Index] | None = None
) -> ActionOutcome:
    """Place pairs at a detector's proposals for some keypoints, or for all that are left."""
    document, number = state.document, None
    for proposal in session.proposals(state):
        keypoint = proposal.keypoint
        if (keypoints is None or keypoint in keypoints) and keypoint not in document.keypoints:
            number = document.next_number
            document = document.append(Pair(number, proposal.uv, keypoint))
    if number is None:
        return ActionOutcome(message="Nothing is proposed that is not placed.")
    state.record(document)
    return ActionOutcome(number)


def mark(session: Session, state: PhotoState, *, mark: Mark | None = None) -> ActionOutcome:
    """Say that a photo is done or skipped, or neither."""
    session.before_saving()
    session.worklist = session.worklist.marked(state.photo.path.name, mark)
    return ActionOutcome()


def undo(session: Session, state: PhotoState) -> ActionOutcome:
    """Undo the last change."""
    deleted = session.deletions.last(session.place_of(state)[0], at_once=True)
    if deleted is not None:
        return bring_back(deleted)
    before = state.marked
    return _gone(state, before, "" if state.history.undo() else "There is nothing to undo.")


def redo(session: Session, state: PhotoState) -> ActionOutcome:
    """Redo the last undone change."""
    before = state.marked
    is_done = state.history.redo()
    if state.owner.document.is_gone:
        session.deletions.add(session.place_of(state)[0], state.owner)
    return _gone(state, before, "" if is_done else "There is nothing to redo.")


ACTIONS: dict[str, Callable[..., ActionOutcome]] = {
    function.__name__: function
    for function in (
        *(place_uv, place_keypoint, pick, repick, mirrored, suggested, move, release, delete),
        *(rename, identify, *EVIDENCE_ACTIONS, *OBJECT_ACTIONS, accept, mark, undo, redo),
    )
}
"""Actions by the name that the page sends as ``do``."""

# Actions after which undoing brings back what was deleted, and actions that may change the names
# of keypoints instead of the document.
_DELETING = ("delete_object", "undo", "redo")
_RENAMING = ("rename", "identify")


def _gone(state: PhotoState, before: AnnotationDocument, nothing: str) -> ActionOutcome:
    """The outcome of undoing or redoing, which may concern another photo of the object.

    ``nothing`` says that nothing was done, if so; ``before`` is what was marked in the photo.
    """
    if nothing:
        return ActionOutcome(message=nothing)
    if not state.is_shown:
        return ActionOutcome(message="This photo is no longer one of the object's.")
    if len(state.all_views) > 1 and state.marked == before:
        return ActionOutcome(message="That was a change in another photo of this object.")
    return ActionOutcome()


def _aimed_at(
    state: PhotoState, origin: Point3, direction: Point3, near: int | None, snap: float
) -> int | None:
    """The keypoint that a ray points at, registered; None if it misses the model.

    It is the keypoint ``near`` it if that is visible. For ``snap`` see `ClickableModel.pick`.
    """
    model, registry = state.model.cad, state.model.registry
    start = model.from_display(origin)
    if near is not None and model.is_seen(start, registry[near].xyz):
        return near
    point = model.pick(start, direction, snap=snap)
    if point is None:
        return None
    known = registry.find(point.xyz, tolerance=SAME_PLACE * model.diagonal)
    return registry.add(point) if known is None else known


def _snapped(uv: Pixel, reach: float, session: Session, state: PhotoState) -> Pixel:
    """The nearest corner of the photo within reach [px], or the place itself."""
    state.require_inside(uv)
    if not reach > 0:
        return uv
    corner = nearest_corner(session.pixels(state), uv, reach=min(reach, _LONGEST_REACH))
    return uv if corner is None else corner


def _no_corner(snap: float, *, moved: bool) -> str:
    return "No corner of the photo near this place." if snap > 0 and not moved else ""
