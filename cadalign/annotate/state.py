"""What the page shows, as plain data."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from cadalign.annotate.alignment import LiveAlignment
from cadalign.annotate.session import Outcome, Session, Slide
from cadalign.annotate.suggestion import Suggestion
from cadalign.annotate.wireframe import box_lines
from cadalign.annotate.words import advice_text, facts_of, notes_of
from cadalign.arrays import FloatArray


def state_of(session: Session, number: int, outcome: Outcome | None = None) -> dict[str, Any]:
    """Everything that the page shows of a photo.

    Parameters
    ----------
    session : Session
    number : int
        The photo, counted from 0.
    outcome : Outcome, optional
        Of the action that led to it.

    Raises
    ------
    InputError
        If there is no such photo.
    """
    outcome = outcome or Outcome()
    with session.lock:
        slide = session.slide(number)
        live, suggestion = session.live(slide)
        return {
            "image": _image(session, number, slide),
            "saved": {
                "path": slide.sheet.observation.name,
                "at": slide.saved_at,
                "trouble": slide.trouble,
            },
            "selected": outcome.selected,
            "message": outcome.message,
            "can_undo": slide.history.can_undo,
            "can_redo": slide.history.can_redo,
            "focal": _focal(slide),
            "pairs": _pairs(session, slide, live),
            "keypoints": _keypoints(session, slide),
            "alignment": _alignment(session, live),
            "suggestion": _suggestion(session, suggestion),
        }


def _image(session: Session, number: int, slide: Slide) -> dict[str, Any]:
    photo = slide.photo
    return {
        "number": number,
        "count": len(session.slides),
        "name": photo.path.name,
        "width": photo.width,
        "height": photo.height,
        "model": slide.sheet.model.name,
    }


def _focal(slide: Slide) -> dict[str, Any]:
    choice = slide.document.focal
    return {
        "known": choice.known,
        "pixels": round(slide.lens.with_focal(choice).fx, 2),
        "typed": choice.pixels,
        "note": slide.lens.note,
    }


def _pairs(session: Session, slide: Slide, live: LiveAlignment) -> list[dict[str, Any]]:
    pairs, row = [], 0
    for position, pair in enumerate(slide.document.pairs, start=1):
        entry: dict[str, Any] = {
            "pair": pair.number,
            "position": position,
            "uv": pair.uv,
            "keypoint": pair.keypoint,
            "name": "" if pair.keypoint is None else session.book[pair.keypoint].name,
            "xyz": None,
            "residual": None,
            "off": None,
        }
        if pair.keypoint is not None:
            entry["xyz"] = session.model.to_display(session.book[pair.keypoint].xyz).tolist()
        if pair.complete:
            if live.result is not None:
                entry["residual"] = _finite(live.result.residuals[row])
                entry["off"] = live.contradictions.get(row)
            row += 1
        pairs.append(entry)
    return pairs


def _keypoints(session: Session, slide: Slide) -> list[dict[str, Any]]:
    used = slide.document.keypoints
    return [
        {
            "keypoint": number,
            "name": point.name,
            "xyz": session.model.to_display(point.xyz).tolist(),
            "used": number in used,
        }
        for number, point in session.book
    ]


def _alignment(session: Session, live: LiveAlignment) -> dict[str, Any]:
    result, camera = live.result, live.camera
    if result is None or camera is None:
        return {
            "status": "none" if session.ready else "preparing",
            "message": live.message,
        }
    return {
        "status": "done",
        "message": "",
        "facts": [asdict(fact) for fact in facts_of(live)],
        "notes": notes_of(live),
        "alignment": result.alignment.to_dict(),
        "eye": session.model.to_display(result.alignment.inverse(np.zeros((1, 3)))[0]).tolist(),
        "focal": camera.fx,
        "rms": result.rms,
        "box": _flat(box_lines(session.model.scene.bounds, camera, result.alignment)),
        "lines": _flat(session.wireframe.seen_in(camera, result.alignment)),
    }


def _suggestion(session: Session, suggestion: Suggestion | None) -> dict[str, Any] | None:
    if suggestion is None:
        return None
    point = suggestion.point
    name = point.name or "The marked corner"
    return {
        "keypoint": point.semantic_id,
        "xyz": session.model.to_display(point.xyz).tolist(),
        "uv": suggestion.uv,
        "text": advice_text(suggestion.advice, name),
    }


def _finite(residual: FloatArray) -> list[float] | None:
    return residual.tolist() if np.isfinite(residual).all() else None


def _flat(lines: FloatArray) -> list[float]:
    """Lines (k, 2, 2) as x1, y1, x2, y2, ... to a tenth of a pixel."""
    inside = lines[(np.abs(lines) < 1e6).all(axis=(1, 2))]
    return np.round(inside, 1).ravel().tolist()
