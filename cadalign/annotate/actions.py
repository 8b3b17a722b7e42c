"""Actions of the page: one function each, whose keyword arguments are the fields of the JSON."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, get_type_hints

import msgspec
import numpy as np

from cadalign.annotate.keypoints import ObjectShape
from cadalign.annotate.marks import Pair
from cadalign.annotate.photos import ObjectMask, segment_box
from cadalign.annotate.session import Annotation, Session
from cadalign.errors import InputError, quote
from cadalign.io.documents import Finite, ForeignDocument, Index, Point2, Point3, Text, convert
from cadalign.io.images import read_photo
from cadalign.io.pretrained import pretrained_path

_FOCAL_RANGE = (0.05, 200.0)  # of a focal length [image widths]


@dataclass(frozen=True)
class ActionOutcome:
    """Outcome of an action, besides the changed marks."""

    selected: int | None = None  # number of the pair that was placed or changed
    message: str = ""  # for the user, such as that the click missed the model


def perform(session: Session, number: int, action: Mapping[str, Any]) -> ActionOutcome:
    """Do an action on a photo and save it; ``action`` has the name ``do`` and the arguments."""
    with session.lock:
        state = session.annotation(number)
        name = action.get("do")
        function = ACTIONS.get(name) if isinstance(name, str) else None
        if function is None:
            fix = f"known are {', '.join(ACTIONS)}"
            raise InputError(f"{quote(name)} is not an action", where="do", fix=fix)
        before = state.marks
        arguments = msgspec.structs.asdict(convert(action, _arguments_of(function)))
        outcome = function(state, **arguments) or ActionOutcome()
        if state.marks is not before:
            session.save(state)
        elif name in _RENAMING:
            # The observation of every photo with the keypoint stores the name.
            keypoint = state.marks.pair(arguments["pair"]).keypoint
            for each in session.photos:
                if keypoint in each.marks.keypoints:
                    each.live = None
                    session.save(each)
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
    """Place a photo half, preferably of the given pair."""
    state.require_inside(uv)
    marks, number = state.marks.place_uv(uv, pair)
    state.record(marks)
    return ActionOutcome(number)


def place_keypoint(
    state: Annotation, *, keypoint: Index, pair: Index | None = None
) -> ActionOutcome:
    """Place a model half at a keypoint of the registry, preferably of the given pair."""
    state.model.registry[keypoint]  # raises InputError for an unknown keypoint
    pending = [each.number for each in state.marks.pairs if each.uv is None]
    lacks = any(each.keypoint is None for each in state.marks.pairs)
    if state.model.is_skeleton and pending and not lacks:  # another keypoint is chosen instead
        state.record(state.marks.exchange_keypoint(pending[0], keypoint))
        return ActionOutcome(pending[0])
    marks, number = state.marks.place_keypoint(keypoint, pair)
    state.record(marks)
    return ActionOutcome(number)


def take(state: Annotation, *, keypoint: Index, uv: Point2) -> ActionOutcome:
    """Place a new pair: a keypoint that is proposed or estimated, and its place in the photo."""
    state.model.registry[keypoint]  # raises InputError for an unknown keypoint
    state.require_inside(uv)
    number = state.marks.next_number
    state.record(state.marks.append(Pair(number, uv)).exchange_keypoint(number, keypoint))
    return ActionOutcome(number)


def skip(state: Annotation) -> ActionOutcome | None:
    """Propose another keypoint; if all were skipped, propose them anew."""
    proposed = state.next_keypoint(state.alignment())
    if proposed is None:
        state.skipped.clear()
    else:
        state.skipped.add(state.model.registry[proposed].name)
    return None


def category(state: Annotation, *, name: Text) -> ActionOutcome:
    """Exchange the category of the object in this photo; pairs of equal names stay."""
    if not state.model.can_exchange:
        raise InputError("only categories that come with cadalign can be exchanged", where="name")
    before = len(state.marks.complete_pairs)
    state.exchange_shape(ObjectShape.open(pretrained_path(name)))
    kept = len(state.marks.complete_pairs)
    text = f"The object in this photo is a {name} now. {kept} of {before} pairs stay."
    if kept < before:
        text += " Choose keypoints for the others on the right."
    return ActionOutcome(message=text)


def pick(
    state: Annotation,
    *,
    origin: Point3,
    direction: Point3,
    near: Index | None = None,
    pair: Index | None = None,
) -> ActionOutcome:
    """Place a model half at the keypoint ``near`` a ray, or where the ray hits the surface."""
    model, registry = state.model.cad, state.model.registry
    if near is None:
        point = model.pick(model.from_display(origin), direction)
        if point is None:
            return ActionOutcome(message=model.miss_message)
        near = registry.find(point.xyz)
        near = registry.add(point) if near is None else near
    return place_keypoint(state, keypoint=near, pair=pair)


def move(state: Annotation, *, pair: Index, uv: Point2) -> ActionOutcome:
    """Move a photo half."""
    state.require_inside(uv)
    state.record(state.marks.move(pair, uv))
    return ActionOutcome(pair)


def release(state: Annotation, *, pair: Index) -> ActionOutcome:
    """Remove the model half of a pair."""
    state.record(state.marks.release_keypoint(pair))
    return ActionOutcome(pair)


def delete(state: Annotation, *, pair: Index) -> None:
    """Delete a pair."""
    state.record(state.marks.delete(pair))


def rename(state: Annotation, *, pair: Index, name: Text) -> ActionOutcome:
    """Rename the keypoint of a pair."""
    keypoint = state.marks.pair(pair).keypoint
    if keypoint is None:
        what = "this pair has no model point yet"
        raise InputError(what, where="pair", fix="click on the model first")
    state.model.registry.rename(keypoint, name)
    return ActionOutcome(pair)


def identify(state: Annotation, *, pair: Index, label: Index | Text) -> ActionOutcome:
    """Identify the model point of a pair as a keypoint of the shape."""
    keypoint, registry = state.marks.pair(pair).keypoint, state.model.registry
    if keypoint is None or label not in state.model.shape.ids:
        raise InputError(f"{quote(label)} is not a keypoint of the shape", where="label")
    if isinstance(label, str):
        registry.rename(keypoint, label)
        return ActionOutcome(pair)
    if label in registry:
        what = f"the model already has a keypoint {label}"
        raise InputError(what, where="label", fix="click on that keypoint")
    point = registry[keypoint]
    own = point.name if point.name != f"point {keypoint}" else f"keypoint {label}"
    known = registry.add(replace(point, name=own, semantic_id=label))
    state.record(state.marks.exchange_keypoint(pair, known))
    return ActionOutcome(pair)


def focal(state: Annotation, *, pixels: Finite | None = None) -> None:
    """Set a known focal length; without ``pixels``, it is estimated."""
    camera = state.marks.camera
    low, high = (bound * camera.width for bound in _FOCAL_RANGE)
    if pixels is None:
        side = float(max(camera.width, camera.height))
        camera = replace(camera, fx=side, fy=side, focal_known=False)
    elif low <= pixels <= high:
        camera = camera.replace_focal(pixels)
    else:
        what = f"{pixels:g} px is not a focal length of this photo"
        raise InputError(what, where="pixels", fix=f"give {low:.0f} to {high:.0f} px")
    state.record(replace(state.marks, camera=camera))


def mask_cut(state: Annotation, *, corners: tuple[Point2, Point2]) -> None:
    """Segment the object in a box by GrabCut, and add it to the mask."""
    found = segment_box(read_photo(state.photo.path), np.array(corners, dtype=float))
    state.record(replace(state.marks, mask=ObjectMask.from_pixels(found | state.mask)))


def mask_clear(state: Annotation) -> None:
    """Remove the mask."""
    state.record(replace(state.marks, mask=None))


def use_photo(state: Annotation, *, on: bool) -> ActionOutcome | None:
    """Choose whether the photo itself is evidence, which replaces the mask.

    The alignment with the mask is the start of the search in the photo.
    """
    marks = replace(state.marks, photo=on)
    if not on or marks.mask is None:
        state.record(marks)
        return None
    live = state.alignment()
    start = marks.start if live.result is None else live.result.alignment
    state.record(replace(marks, mask=None, start=start))
    return ActionOutcome(message="The photo replaces the mask. Undo restores the mask.")


def undo(state: Annotation) -> ActionOutcome | None:
    """Undo the last change."""
    return None if state.history.undo() else ActionOutcome(message="There is nothing to undo.")


def redo(state: Annotation) -> ActionOutcome | None:
    """Redo the last undone change."""
    return None if state.history.redo() else ActionOutcome(message="There is nothing to redo.")


ACTIONS: dict[str, Callable[..., ActionOutcome | None]] = {
    function.__name__: function
    for function in (
        *(place_uv, place_keypoint, pick, move, release, delete, rename, identify),
        *(take, skip, category, focal, mask_cut, mask_clear, use_photo, undo, redo),
    )
}
"""Actions by the name that the page sends as ``do``."""
_RENAMING = ("rename", "identify")
"""Actions that may change names of keypoints instead of marks."""
