"""Actions of the page on one photo, as declared JSON documents."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cadalign.annotate.document import FocalChoice, Pixel
from cadalign.errors import InputError, quote
from cadalign.io.documents import Finite, ForeignDocument, Index, Point2, Point3, Text

if TYPE_CHECKING:
    from cadalign.annotate.session import PhotoState, Session

_FOCAL_RANGE = (0.05, 200.0)  # of a focal length [image widths]


@dataclass(frozen=True)
class Outcome:
    """Outcome of an action beside the changed document, for the user."""

    selected: int | None = None  # number of the pair that was placed or changed
    message: str = ""  # such as that the click missed the model


class Action(ForeignDocument):
    """Base of the actions; ``pair`` fields are numbers of pairs."""

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        """Record the changed document, or raise a CadalignError."""
        raise NotImplementedError


class _Placing(Action, kw_only=True):
    """Place a half, by preference of the given pair."""

    pair: Index | None = None


class PlaceUv(_Placing):
    """Place a photo half."""

    uv: Point2

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        document, pair = state.document.place_uv(_inside(self.uv, state), self.pair)
        state.history.record(document)
        return Outcome(pair)


class PlaceKeypoint(_Placing):
    """Place a model half: a keypoint of the registry."""

    keypoint: Index

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        session.registry[self.keypoint]  # refuses an unknown one
        return _place(self.keypoint, self.pair, state)


class Pick(_Placing):
    """Place a model half by a ray, or the keypoint ``near`` the click if it is visible."""

    origin: Point3
    direction: Point3
    near: Index | None = None

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        model, registry = session.model, session.registry
        origin = model.from_display(self.origin)
        if self.near is not None and model.is_seen(origin, registry[self.near].xyz):
            return _place(self.near, self.pair, state)
        point = model.pick(origin, self.direction)
        if point is None:
            return Outcome(message="That click missed the model.")
        return _place(registry.add(point), self.pair, state)


class PlaceSuggested(_Placing):
    """Place the suggested keypoint."""

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        _, suggestion = session.live(state)
        if suggestion is None:
            raise InputError(
                "there is no suggested keypoint yet", where="suggestion", fix="place more pairs"
            )
        keypoint = suggestion.point.semantic_id
        if keypoint is None:
            keypoint = session.registry.add(suggestion.point)
        return _place(keypoint, self.pair, state)


class Move(Action):
    """Move a photo half; moves of one gesture are undone together."""

    pair: Index
    uv: Point2
    gesture: Index | None = None

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        moved = state.document.move(self.pair, _inside(self.uv, state))
        step = None if self.gesture is None else (self.pair, self.gesture)
        state.history.record(moved, step=step)
        return Outcome(self.pair)


class Release(Action):
    """Remove the model half of a pair."""

    pair: Index

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        state.history.record(state.document.release_keypoint(self.pair))
        return Outcome(self.pair)


class Delete(Action):
    """Delete a pair."""

    pair: Index

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        state.history.record(state.document.delete(self.pair))
        return Outcome()


class Rename(Action):
    """Rename the keypoint of a pair."""

    pair: Index
    name: Text

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        keypoint = state.document.pair(self.pair).keypoint
        if keypoint is None:
            raise InputError(
                "this pair has no model point yet", where="pair", fix="click on the model first"
            )
        session.registry.rename(keypoint, self.name)
        return Outcome(self.pair)


class Identify(Action):
    """Say which keypoint of the category's shape the model point of a pair is."""

    pair: Index
    label: Index | Text

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        keypoint = state.document.pair(self.pair).keypoint
        shape = session.shape
        if keypoint is None or shape is None or self.label not in shape.ids:
            raise InputError(
                f"{quote(self.label)} is no keypoint of the shape", where="label", fix="choose one"
            )
        registry = session.registry
        if shape.is_named:
            registry.rename(keypoint, str(self.label))
            return Outcome(self.pair)
        point = registry[keypoint]
        own = point.name if point.name != f"point {keypoint}" else f"keypoint {self.label}"
        known = registry.add_as(int(self.label), replace(point, name=own))
        state.history.record(state.document.exchange_keypoint(self.pair, known))
        return Outcome(self.pair)


class Focal(Action):
    """Choose a known or an estimated focal length."""

    known: bool
    pixels: Finite | None = None

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        if self.pixels is not None:
            low, high = (bound * state.photo.width for bound in _FOCAL_RANGE)
            if not low <= self.pixels <= high:
                raise InputError(
                    f"{self.pixels:g} px is no focal length of this photo",
                    where="pixels",
                    fix=f"give {low:.0f} to {high:.0f} px",
                )
        focal = FocalChoice(self.known, self.pixels)
        state.history.record(replace(state.document, focal=focal))
        return Outcome()


class Undo(Action):
    """Undo the last change."""

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        return Outcome(message="" if state.history.undo() else "There is nothing to undo.")


class Redo(Action):
    """Redo the last undone change."""

    def apply(self, session: Session, state: PhotoState) -> Outcome:
        return Outcome(message="" if state.history.redo() else "There is nothing to redo.")


ACTIONS: dict[str, type[Action]] = {
    "place_uv": PlaceUv,
    "place_keypoint": PlaceKeypoint,
    "pick": Pick,
    "suggested": PlaceSuggested,
    "move": Move,
    "release": Release,
    "delete": Delete,
    "rename": Rename,
    "identify": Identify,
    "focal": Focal,
    "undo": Undo,
    "redo": Redo,
}
"""Actions by the name that the page sends as ``do``."""

RENAMING = ("rename", "identify")
"""Those that may change the names of keypoints instead of the document."""


def _place(keypoint: int, pair: int | None, state: PhotoState) -> Outcome:
    document, number = state.document.place_keypoint(keypoint, pair)
    state.history.record(document)
    return Outcome(number)


def _inside(uv: Pixel, state: PhotoState) -> Pixel:
    """Refuse a place outside the photo."""
    if not state.intrinsics.camera.contains(np.array([uv]))[0]:
        raise InputError(
            f"({uv[0]:.1f}, {uv[1]:.1f}) is outside the photo", where="uv", fix="place it inside"
        )
    return uv
