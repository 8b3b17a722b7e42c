"""Actions of the page: a function each, of which the keyword arguments are the JSON document."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from typing import Any, get_type_hints

import msgspec

from cadalign.annotate.annotation import Annotation
from cadalign.annotate.evidence_actions import EVIDENCE_ACTIONS, ActionOutcome
from cadalign.annotate.session import Session
from cadalign.errors import InputError, quote
from cadalign.io.documents import ForeignDocument, Index, NotNegative, Point2, Point3, Text, convert

_MISSED = "That click missed the model."


def perform(session: Session, number: int, action: Mapping[str, Any]) -> ActionOutcome:
    """Do an action of the page, its name ``do`` and its arguments, and save its changes.

    It is done on the annotation of a number.
    """
    with session.lock:
        state = session.annotation(number)
        name = action.get("do")
        function = ACTIONS.get(name) if isinstance(name, str) else None
        if function is None:
            fix = f"known are {', '.join(ACTIONS)}"
            raise InputError(f"{quote(name)} is not an action", where="do", fix=fix)
        before = state.document
        arguments = msgspec.structs.asdict(convert(action, _arguments_of(function)))
        outcome = function(state, **arguments) or ActionOutcome()
        if state.document is not before or name in _RENAMING:
            session.save(state)
        return outcome


@cache
def _arguments_of(function: Callable[..., ActionOutcome | None]) -> type[msgspec.Struct]:
    hints = get_type_hints(function, include_extras=True)
    fields = [
        (name, hints[name], msgspec.NODEFAULT if each.default is each.empty else each.default)
        for name, each in inspect.signature(function).parameters.items()
        if each.kind is each.KEYWORD_ONLY
    ]
    return msgspec.defstruct(function.__name__, fields, bases=(ForeignDocument,), kw_only=True)


def place_uv(state: Annotation, *, uv: Point2, pair: Index | None = None) -> ActionOutcome:
    """Place a photo half, by preference of the given pair."""
    state.require_inside(uv)
    document, number = state.document.place_uv(uv, pair)
    state.record(document)
    return ActionOutcome(number)


def place_keypoint(
    state: Annotation, *, keypoint: Index, pair: Index | None = None
) -> ActionOutcome:
    """Place a model half, a keypoint of the registry, by preference of the given pair."""
    state.model.registry[keypoint]  # refuses an unknown one
    document, number = state.document.place_keypoint(keypoint, pair)
    state.record(document)
    return ActionOutcome(number)


def pick(
    state: Annotation,
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
    return place_keypoint(state, keypoint=keypoint, pair=pair)


def repick(
    state: Annotation,
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


def suggested(state: Annotation, *, pair: Index | None = None) -> ActionOutcome:
    """Place the model half at the suggested keypoint, by preference of the given pair."""
    _, suggestion = state.session.live(state)
    if suggestion is None:
        what = "there is no suggested keypoint yet"
        raise InputError(what, where="suggestion", fix="place more pairs")
    keypoint = suggestion.point.semantic_id
    assert keypoint is not None  # of the registry
    return place_keypoint(state, keypoint=keypoint, pair=pair)


def move(
    state: Annotation, *, pair: Index, uv: Point2, gesture: Index | None = None
) -> ActionOutcome:
    """Move a photo half; moves of one gesture are undone together."""
    state.require_inside(uv)
    step = None if gesture is None else (pair, gesture)
    state.record(state.document.move(pair, uv), step=step)
    return ActionOutcome(pair)


def release(state: Annotation, *, pair: Index) -> ActionOutcome:
    """Remove the model half of a pair."""
    state.record(state.document.release_keypoint(pair))
    return ActionOutcome(pair)


def delete(state: Annotation, *, pair: Index) -> None:
    """Delete a pair."""
    state.record(state.document.delete(pair))


def rename(state: Annotation, *, pair: Index, name: Text) -> ActionOutcome:
    """Rename the keypoint of a pair."""
    keypoint = state.document.pair(pair).keypoint
    if keypoint is None:
        what = "this pair has no model point yet"
        raise InputError(what, where="pair", fix="click on the model first")
    state.model.registry.rename(keypoint, name)
    return ActionOutcome(pair)


def identify(state: Annotation, *, pair: Index, label: Index | Text) -> ActionOutcome:
    """Say which keypoint of the category's shape the model point of a pair is."""
    keypoint, shape = state.document.pair(pair).keypoint, state.session.shape
    if keypoint is None or label not in shape.ids:
        what = f"{quote(label)} is no keypoint of the shape"
        raise InputError(what, where="label", fix="choose one")
    registry = state.model.registry
    if shape.is_named:
        registry.rename(keypoint, str(label))
        return ActionOutcome(pair)
    point = registry[keypoint]
    own = point.name if point.name != f"point {keypoint}" else f"keypoint {label}"
    known = registry.add_as(int(label), replace(point, name=own))
    state.record(state.document.exchange_keypoint(pair, known))
    return ActionOutcome(pair)


def undo(state: Annotation) -> ActionOutcome | None:
    """Undo the last change."""
    return None if state.history.undo() else ActionOutcome(message="There is nothing to undo.")


def redo(state: Annotation) -> ActionOutcome | None:
    """Redo the last undone change."""
    return None if state.history.redo() else ActionOutcome(message="There is nothing to redo.")


ACTIONS: dict[str, Callable[..., ActionOutcome | None]] = {
    function.__name__: function
    for function in (
        *(place_uv, place_keypoint, pick, repick, suggested, move, release, delete),
        *(rename, identify, *EVIDENCE_ACTIONS, undo, redo),
    )
}
"""Actions by the name that the page sends as ``do``."""
_RENAMING = ("rename", "identify")
"""Actions that may change the names of keypoints in place of the document."""


def _aimed_at(
    state: Annotation, origin: Point3, direction: Point3, near: int | None, snap: float
) -> int | None:
    """The keypoint that a ray points at, registered; None if it misses the model.

    It is the keypoint ``near`` it if that is visible. For ``snap`` see `ClickableModel.pick`.
    """
    model = state.model.cad
    start = model.from_display(origin)
    if near is not None and model.is_seen(start, state.model.registry[near].xyz):
        return near
    point = model.pick(start, direction, snap=snap)
    return None if point is None else state.model.registry.placed(point)
