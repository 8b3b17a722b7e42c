"""Actions of the page on one photo, as declared JSON documents."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from cadalign.annotate.action import Action, ActionOutcome, inside
from cadalign.annotate.document import AnnotationDocument, Pair, Pixel
from cadalign.annotate.evidence_actions import EVIDENCE_ACTIONS
from cadalign.annotate.masks import nearest_corner
from cadalign.annotate.models import SAME_PLACE
from cadalign.annotate.object_actions import OBJECT_ACTIONS, bring_back
from cadalign.annotate.objects import PhotoState
from cadalign.annotate.session import Session
from cadalign.annotate.worklist import Mark
from cadalign.errors import InputError, quote
from cadalign.io.documents import (
    Index,
    NotNegative,
    Point2,
    Point3,
    Text,
    convert,
)

_LONGEST_REACH = 200.0  # of a corner of the photo [px]
_MISSED = "That click missed the model."
MIRRORED = 0.01
"""Largest distance of a point from a mirror image that it counts as [diagonals]."""


class _Placing(Action, kw_only=True):
    """Place a half, by preference of the given pair."""

    pair: Index | None = None


class PlaceUv(_Placing):
    """Place a photo half."""

    uv: Point2
    snap: NotNegative = 0.0  # farthest corner of the photo that it goes to [px]

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        uv = _snapped(self.uv, self.snap, session, state)
        document, pair = state.document.place_uv(uv, self.pair)
        state.record(document)
        return ActionOutcome(pair, _no_corner(self.snap, moved=uv != self.uv))


class PlaceKeypoint(_Placing):
    """Place a model half: a keypoint of the registry."""

    keypoint: Index

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        state.model.registry[self.keypoint]  # refuses an unknown one
        return _place(self.keypoint, self.pair, state)


class _Aiming(Action, kw_only=True):
    """Point at the model by a ray, or at the keypoint ``near`` it if that is visible."""

    origin: Point3
    direction: Point3
    near: Index | None = None
    snap: NotNegative = 0.0  # see `CadModel.pick`

    def target(self, state: PhotoState) -> int | None:
        """The keypoint pointed at, registered; None if the ray misses the model."""
        model, registry = state.model.cad, state.model.registry
        origin = model.from_display(self.origin)
        if self.near is not None and model.is_seen(origin, registry[self.near].xyz):
            return self.near
        point = model.pick(origin, self.direction, snap=self.snap)
        if point is None:
            return None
        known = registry.find(point.xyz, tolerance=SAME_PLACE * model.diagonal)
        return registry.add(point) if known is None else known


class Pick(_Aiming):
    """Place a model half."""

    pair: Index | None = None

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        keypoint = self.target(state)
        if keypoint is None:
            return ActionOutcome(message=_MISSED)
        return _place(keypoint, self.pair, state)


class Repick(_Aiming):
    """Move the model half of a pair."""

    pair: Index

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        keypoint = self.target(state)
        if keypoint is None:
            return ActionOutcome(self.pair, _MISSED)
        state.record(state.document.exchange_keypoint(self.pair, keypoint))
        return ActionOutcome(self.pair)


class PlaceMirrored(Action):
    """Begin a pair at the mirror image of another's model point."""

    pair: Index

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        keypoint = state.document.pair(self.pair).keypoint
        registry, model = state.model.registry, state.model.cad
        point = None if keypoint is None else model.mirrored(registry[keypoint].xyz)
        if point is None:
            raise InputError(
                "its model point has no mirror image", where="pair", fix="choose another pair"
            )
        known = registry.find(point.xyz, tolerance=MIRRORED * model.diagonal)
        return _place(registry.add(point) if known is None else known, None, state)


class PlaceSuggested(_Placing):
    """Place the suggested keypoint."""

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        _, suggestion = session.live(state)
        if suggestion is None:
            raise InputError(
                "there is no suggested keypoint yet", where="suggestion", fix="place more pairs"
            )
        keypoint = suggestion.point.semantic_id
        if keypoint is None:
            keypoint = state.model.registry.add(suggestion.point)
        return _place(keypoint, self.pair, state)


class Move(Action):
    """Move a photo half; moves of one gesture are undone together."""

    pair: Index
    uv: Point2
    gesture: Index | None = None
    snap: NotNegative = 0.0  # as of `PlaceUv`

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        uv = _snapped(self.uv, self.snap, session, state)
        moved = state.document.move(self.pair, uv)
        step = None if self.gesture is None else (self.pair, self.gesture)
        state.record(moved, step=step)
        return ActionOutcome(self.pair, _no_corner(self.snap, moved=uv != self.uv))


class Release(Action):
    """Remove the model half of a pair."""

    pair: Index

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        state.record(state.document.release_keypoint(self.pair))
        return ActionOutcome(self.pair)


class Delete(Action):
    """Delete a pair."""

    pair: Index

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        state.record(state.document.delete(self.pair))
        return ActionOutcome()


class Rename(Action):
    """Rename the keypoint of a pair."""

    pair: Index
    name: Text

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        keypoint = state.document.pair(self.pair).keypoint
        if keypoint is None:
            raise InputError(
                "this pair has no model point yet", where="pair", fix="click on the model first"
            )
        state.model.registry.rename(keypoint, self.name)
        return ActionOutcome(self.pair)


class Identify(Action):
    """Say which keypoint of the category's shape the model point of a pair is."""

    pair: Index
    label: Index | Text

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        keypoint = state.document.pair(self.pair).keypoint
        shape = session.shape
        if keypoint is None or shape is None or self.label not in shape.ids:
            raise InputError(
                f"{quote(self.label)} is no keypoint of the shape", where="label", fix="choose one"
            )
        registry = state.model.registry
        if shape.is_named:
            registry.rename(keypoint, str(self.label))
            return ActionOutcome(self.pair)
        point = registry[keypoint]
        own = point.name if point.name != f"point {keypoint}" else f"keypoint {self.label}"
        known = registry.add_as(int(self.label), replace(point, name=own))
        state.record(state.document.exchange_keypoint(self.pair, known))
        return ActionOutcome(self.pair)


class Accept(Action):
    """Place pairs as a detector proposes: those of some keypoints, or all that are left."""

    keypoints: list[Index] | None = None

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        document, number = state.document, None
        for proposal in state.proposals:
            keypoint = proposal.keypoint
            if self.keypoints is not None and keypoint not in self.keypoints:
                continue
            if keypoint not in document.keypoints:
                number = document.next_number
                document = document.append(Pair(number, proposal.uv, keypoint))
        if number is None:
            return ActionOutcome(message="Nothing is proposed that is not placed.")
        state.record(document)
        return ActionOutcome(number)


class MarkPhoto(Action):
    """Say that a photo is done or skipped, or neither."""

    mark: Mark | None = None

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        session.before_saving()
        session.worklist = session.worklist.marked(state.photo.path.name, self.mark)
        return ActionOutcome()


class Undo(Action):
    """Undo the last change."""

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        deleted = session.deletions.last(session.place_of(state)[0], at_once=True)
        if deleted is not None:
            return bring_back(deleted)
        before = state.marked
        is_done = state.history.undo()
        return _gone_through(state, before, "" if is_done else "There is nothing to undo.")


class Redo(Action):
    """Redo the last undone change."""

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        before = state.marked
        is_done = state.history.redo()
        if state.owner.document.is_gone:
            session.deletions.add(session.place_of(state)[0], state.owner)
        return _gone_through(state, before, "" if is_done else "There is nothing to redo.")


ACTIONS: dict[str, type[Action]] = {
    "place_uv": PlaceUv,
    "place_keypoint": PlaceKeypoint,
    "pick": Pick,
    "repick": Repick,
    "mirrored": PlaceMirrored,
    "suggested": PlaceSuggested,
    "move": Move,
    "release": Release,
    "delete": Delete,
    "rename": Rename,
    "identify": Identify,
    **EVIDENCE_ACTIONS,
    **OBJECT_ACTIONS,
    "accept": Accept,
    "mark": MarkPhoto,
    "undo": Undo,
    "redo": Redo,
}
"""Actions by the name that the page sends as ``do``."""

DELETING = ("delete_object", "undo", "redo")
"""Those after which undoing brings back what was deleted."""

RENAMING = ("rename", "identify")
"""Those that may change the names of keypoints instead of the document."""


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
        kind = ACTIONS.get(name) if isinstance(name, str) else None
        if kind is None:
            raise InputError(
                f"{quote(name)} is not an action",
                where="do",
                fix=f"known are {', '.join(ACTIONS)}",
            )
        before = {id(each): each.history.document for each in session.states}
        outcome: ActionOutcome = convert(action, kind).apply(session, state)
        owners = [each for each in session.states if each.lead is None]
        changed = [each for each in owners if before.get(id(each)) is not each.document]
        for each in changed:
            session.save(each)
        if changed and name not in DELETING:
            session.deletions.note_change(number)
        if name in RENAMING:
            session.save(state)
        return outcome


def _gone_through(state: PhotoState, before: AnnotationDocument, nothing: str) -> ActionOutcome:
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


def _place(keypoint: int, pair: int | None, state: PhotoState) -> ActionOutcome:
    document, number = state.document.place_keypoint(keypoint, pair)
    state.record(document)
    return ActionOutcome(number)


def _snapped(uv: Pixel, reach: float, session: Session, state: PhotoState) -> Pixel:
    """The nearest corner of the photo within reach [px], or the place itself."""
    uv = inside(uv, state)
    if not reach > 0:
        return uv
    corner = nearest_corner(session.pixels(state), uv, reach=min(reach, _LONGEST_REACH))
    return uv if corner is None else corner


def _no_corner(snap: float, *, moved: bool) -> str:
    return "No corner of the photo near this place." if snap > 0 and not moved else ""
