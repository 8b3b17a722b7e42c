"""State of one photo as the page shows it, as plain data for JSON."""

from __future__ import annotations

import os
from dataclasses import asdict
from typing import Any

import numpy as np

from cadalign.annotate.actions import Outcome
from cadalign.annotate.advice import Marked, present, rank
from cadalign.annotate.alignment import LiveAlignment
from cadalign.annotate.drawing import drawing_of_fit, drawing_of_shape
from cadalign.annotate.files import filled
from cadalign.annotate.result_text import (
    evidence_text,
    facts_of,
    left_text,
    next_best_text,
    notes_of,
)
from cadalign.annotate.session import Live, PhotoState, Session
from cadalign.annotate.shape_alignment import LiveShape
from cadalign.annotate.shape_text import facts_of_shape, notes_of_shape
from cadalign.annotate.suggestion import Suggestion

_FOCAL = "With a known focal length, a mask, another photo and lengths are ranked here too."


def page_state(session: Session, number: int, outcome: Outcome | None = None) -> dict[str, Any]:
    """Collect everything that the page shows of a photo, after an action of that outcome."""
    outcome = outcome or Outcome()
    with session.lock:
        state = session.photo_state(number)
        live, suggestion = session.live(state)
        focal = state.document.focal
        return {
            "revision": state.history.revision,
            "image": {
                "number": number,
                "count": len(session.photos),
                "name": state.photo.path.name,
                "width": state.photo.width,
                "height": state.photo.height,
                "model": state.files.model.name,
            },
            "saved": {
                "path": state.files.observation.name,
                "at": state.saved_at,
                "trouble": state.save_error,
            },
            "selected": outcome.selected,
            "message": outcome.message or _moved(state),
            "can_undo": state.history.can_undo,
            "can_redo": state.history.can_redo,
            "focal": {
                "known": focal.known,
                "pixels": round(state.intrinsics.with_focal(focal).fx, 2),
                "typed": focal.pixels,
                "note": state.intrinsics.note,
            },
            "pairs": _pairs(session, state, live),
            "keypoints": _keypoints(session, state),
            "shape": _shape(session),
            "alignment": _alignment(session, state, live),
            "suggestion": _suggestion(session, suggestion),
        }


def advice_state(session: Session, number: int) -> dict[str, Any]:
    """Rank what could be added to a photo's pairs, of the annotation of that ``revision``.

    Nothing is ranked without an alignment by the pairs alone, for an object's own shape, and where
    the focal length is estimated.
    """
    with session.lock:
        state = session.photo_state(number)
        live, suggestion = session.live(state)
        document, revision = state.document, state.history.revision
        pairs = document.complete_pairs
        points_3d = session.registry.xyz(
            pair.keypoint for pair in pairs if pair.keypoint is not None
        )
    answer: dict[str, Any] = {"revision": revision, "note": "", "now": "", "pieces": []}
    if not isinstance(live, LiveAlignment) or live.cautious is None or live.provisional:
        return answer
    if not document.focal.known:
        return answer | {"note": _FOCAL}
    given = filled(pair.sigma for pair in pairs)
    sigma = live.sigma * (np.ones(len(pairs)) if given is None else given)
    points_2d = np.array([pair.uv for pair in pairs], dtype=float)
    # Without the lock, for which the next click would wait.
    ranked = rank(session.model, Marked(points_3d, points_2d, sigma), live.cautious, suggestion)
    name = "" if suggestion is None else _name_of(suggestion)
    pieces = [
        {
            "kind": each.kind,
            "what": evidence_text(each, name),
            "left": left_text(each),
            "worst": each.worst,
        }
        for each in ranked
    ]
    now = present(live.cautious)
    return answer | {"now": "" if now is None else left_text(now), "pieces": pieces}


def _moved(state: PhotoState) -> str:
    """Say that the photo or the model is no longer where it was; empty while both are."""
    files = state.files
    gone = [path.name for path in (files.image, files.model) if not os.path.exists(path)]
    if not gone:
        return ""
    return (
        f"{' and '.join(gone)}: moved, renamed or deleted. Go on here, or start anew with the new "
        f"name and --observation {files.observation.name}."
    )


def _pairs(session: Session, state: PhotoState, live: Live) -> list[dict[str, Any]]:
    pairs, row = [], 0
    for position, pair in enumerate(state.document.pairs, start=1):
        point = None if pair.keypoint is None else session.registry[pair.keypoint]
        entry: dict[str, Any] = {
            "pair": pair.number,
            "position": position,
            "uv": pair.uv,
            "keypoint": pair.keypoint,
            "name": "" if point is None else point.name,
            "xyz": None if point is None else session.model.to_display(point.xyz).tolist(),
            "residual": None,
            "off": None,
            "counts": point is None or session.shape is None or session.shape.knows(point),
        }
        if pair.complete:
            if live.shown is not None:
                residual = live.residuals[row]
                entry["residual"] = residual.tolist() if np.isfinite(residual).all() else None
                entry["off"] = live.outliers.get(row)
            row += 1
        pairs.append(entry)
    return pairs


def _keypoints(session: Session, state: PhotoState) -> list[dict[str, Any]]:
    used = state.document.keypoints
    return [
        {
            "keypoint": number,
            "name": point.name,
            "xyz": session.model.to_display(point.xyz).tolist(),
            "used": number in used,
        }
        for number, point in session.registry
    ]


def _shape(session: Session) -> dict[str, Any] | None:
    """The object's shape, and its keypoints that the model lacks."""
    shape = session.shape
    if shape is None:
        return None
    known = {shape.id_of(point) for _, point in session.registry}
    return {
        "category": None if shape.learned is None else shape.learned.category,
        "missing": [label for label in shape.ids if label not in known],
    }


def _alignment(session: Session, state: PhotoState, live: Live) -> dict[str, Any]:
    result = live.shown
    if result is None:
        return {"status": "none" if session.ready else "preparing", "message": live.message}
    if isinstance(live, LiveShape):
        assert session.shape is not None
        assert live.camera is not None
        camera = live.camera
        facts, notes = facts_of_shape(live, session.shape), notes_of_shape(live, session.shape)
        used = state.document.keypoints
        drawing = drawing_of_shape(live, session.shape, session.registry, used)
    else:
        assert live.cautious is not None
        camera = live.cautious.camera
        facts, notes = facts_of(live), notes_of(live)
        drawing = drawing_of_fit(live.cautious, session.wireframe)
    return {
        "status": "done",
        "message": "",
        "facts": [asdict(fact) for fact in facts],
        "notes": notes,
        "alignment": result.alignment.to_dict(),
        "eye": session.model.to_display(result.alignment.inverse(np.zeros((1, 3)))[0]).tolist(),
        "focal": camera.fx,
        "rms": result.rms,
        **drawing,
    }


def _suggestion(session: Session, suggestion: Suggestion | None) -> dict[str, Any] | None:
    if suggestion is None:
        return None
    point = suggestion.point
    return {
        "keypoint": point.semantic_id,
        "xyz": session.model.to_display(point.xyz).tolist(),
        "uv": suggestion.uv,
        "text": next_best_text(suggestion.next_best, _name_of(suggestion)),
    }


def _name_of(suggestion: Suggestion) -> str:
    return suggestion.point.name or "The marked corner"
