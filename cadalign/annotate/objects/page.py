"""The objects of a photo, and the photos of an object, as plain data for the page."""

from __future__ import annotations

import re
from typing import Any

from cadalign.annotate.drawing import box_of
from cadalign.annotate.objects.listing import label_of, shown_objects
from cadalign.annotate.objects.state import PhotoState
from cadalign.annotate.session import Session

_VIEW = re.compile(r"views\[(\d+)\]")


def objects_state(session: Session, state: PhotoState) -> dict[str, Any]:
    """The photo's objects with their boxes, this object's photos, and what could be added."""
    number, _ = session.place_of(state)
    deleted = session.deletions.last(number)
    photos = [_view(session, view) | {"is_current": view is state} for view in state.all_views]
    used = {photo["number"] for photo in photos}
    return {
        "objects": [
            _object(session, each) | {"is_current": each is state}
            for each in shown_objects(session.objects[number])
        ],
        "views": photos,
        "further_photos": [
            {"number": other, "name": states[0].photo.path.name}
            for other, states in enumerate(session.objects)
            if other not in used
        ],
        "models": list(session.models.labels),
        "deleted": None if deleted is None else label_of(deleted),
    }


def with_photo_names(session: Session, state: PhotoState, text: str) -> str:
    """A text of the joint estimate with the photos' names for the views' numbers."""
    observation = session.observed(state) if _VIEW.search(text) else None
    if observation is None:
        return text
    images = [view.image for view in observation.views]

    def name(found: re.Match[str]) -> str:
        image = images[int(found[1])]
        return f"view {int(found[1]) + 1}" if image is None else image.name

    return _VIEW.sub(name, text)


def _object(session: Session, state: PhotoState) -> dict[str, Any]:
    """One object of the photo; its box as x1, y1, x2, y2, ... [px]."""
    live, _ = session.live(state)
    _, slot = session.place_of(state)
    return {
        "object": slot,
        "label": label_of(state),
        "name": state.document.name,
        "model": session.models.labels[session.models.number_of(state.model.path)],
        "pairs": len(state.document.complete_pairs),
        "box": box_of(live, state.model.wireframe),
    }


def _view(session: Session, state: PhotoState) -> dict[str, Any]:
    """One photo of the object."""
    number, slot = session.place_of(state)
    return {
        "number": number,
        "object": slot,
        "name": state.photo.path.name,
        "pairs": len(state.document.complete_pairs),
        "is_first": state.lead is None,
    }
