"""Work list as the page shows it, as plain data for JSON."""

from __future__ import annotations

from typing import Any

from cadalign.annotate.objects.listing import label_of, shown_objects
from cadalign.annotate.session import PhotoState, Session
from cadalign.errors import CadalignError
from cadalign.io.documents import read_json


def worklist_state(session: Session) -> list[dict[str, Any]]:
    """All photos with their state, objects, number of pairs, and residual.

    That is the root mean square of the object whose pairs agree worst [px].
    """
    with session.lock:
        return [_photo(session, number) for number in range(len(session.objects))]


def _photo(session: Session, number: int) -> dict[str, Any]:
    objects = shown_objects(session.objects[number])
    found = [rms for rms in map(_rms, objects) if rms is not None]
    return {
        "number": number,
        "name": objects[0].photo.path.name,
        "state": session.work_state(objects[0]),
        "pairs": sum(len(each.document.complete_pairs) for each in objects),
        "rms": max(found, default=None),
        "objects": [
            {"label": label_of(each), "pairs": len(each.document.complete_pairs), "rms": _rms(each)}
            for each in objects
        ],
    }


def _rms(state: PhotoState) -> float | None:
    """That of the saved alignment, which is not computed anew for a list of many photos."""
    if not state.document.complete_pairs or not state.files.fit.exists():
        return None
    try:
        rms = read_json(state.files.fit).get("rms")
    except CadalignError:
        return None
    return rms if isinstance(rms, float) else None
