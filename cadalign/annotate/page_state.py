"""State of the page as plain data for JSON: a photo's annotation, and the list of photos."""

from __future__ import annotations

import os
from dataclasses import asdict
from typing import Any

import numpy as np

from cadalign.annotate.annotation import Annotation
from cadalign.annotate.evidence_actions import ActionOutcome
from cadalign.annotate.live import LiveAlignment, drawing_of, facts_of, notes_of
from cadalign.annotate.problem import LIKELY_STRETCH
from cadalign.annotate.session import Session
from cadalign.errors import CadalignError
from cadalign.io.documents import read_json


def page_state(
    session: Session, number: int, outcome: ActionOutcome | None = None
) -> dict[str, Any]:
    """Collect everything that the page shows of an annotation, after an action of that outcome.

    It is the one of a number.
    """
    outcome = outcome or ActionOutcome()
    with session.lock:
        state = session.annotation(number)
        live, suggestion = session.live(state)
        document, registry, cad = state.document, state.model.registry, state.model.cad
        history, used = state.history, document.keypoints
        return {
            "image": {
                "number": state.number,
                "count": len(session.photos),
                "name": state.name,
                "width": state.photo.width,
                "height": state.photo.height,
                "up_axis": state.stored.up_axis or "y",
            },
            "saved": {
                "path": state.files.observation.name,
                "at": state.saved_at,
                "trouble": state.save_error,
            },
            "selected": outcome.selected,
            "message": outcome.message or _moved(state),
            "can_undo": bool(history.before),
            "can_redo": bool(history.after),
            "focal": {
                "known": document.focal.known,
                "pixels": round(state.camera.fx, 2),
                "typed": document.focal.pixels,
                "note": state.intrinsics.note,
            },
            "evidence": _evidence(state),
            "priors": _priors(state),
            "pairs": _pairs(state, live),
            "keypoints": [
                {
                    "keypoint": keypoint,
                    "name": point.name,
                    "xyz": cad.to_display(point.xyz).tolist(),
                    "used": keypoint in used,
                }
                for keypoint, point in registry
            ],
            "shape": _shape(state),
            "alignment": _alignment(state, live),
            "suggestion": None
            if suggestion is None
            else {
                "keypoint": suggestion.point.semantic_id,
                "xyz": cad.to_display(suggestion.point.xyz).tolist(),
                "uv": suggestion.uv,
                "text": suggestion.text,
            },
        }


def worklist_state(session: Session) -> list[dict[str, Any]]:
    """All annotations with their numbers of pairs and residuals [px]."""
    with session.lock:
        return [
            {
                "number": number,
                "name": each.name,
                "pairs": len(each.document.complete_pairs),
                "rms": _rms(each),
            }
            for number, each in enumerate(session.photos)
        ]


def _evidence(state: Annotation) -> dict[str, Any]:
    """Marks beside the pairs; ``mask`` changes with the mask, None without one."""
    mask, photo = state.document.evidence.mask, state.document.evidence.photo
    return {"mask": None if mask is None else f"{hash(mask) & 0xFFFFFFFF:x}", "photo": photo}


def _priors(state: Annotation) -> dict[str, Any]:
    """Priors on the stretch [%] and on the focal length: chosen ones and likely ones."""
    priors = state.document.priors
    likely = priors.focal or state.intrinsics.likely_focal
    source = "EXIF" if likely == state.intrinsics.prior else "usual lenses"
    return {
        "stretch": None if priors.stretch is None else round(100 * priors.stretch, 4),
        "likely": 100 * LIKELY_STRETCH,
        "focal": priors.focal is not None,
        "about": f"{likely.focal:.0f} px ± {100 * likely.relative_sigma:.0f} % ({source})",
        "has_stretch": not state.session.shape.is_estimated,
        "has_focal": not state.document.focal.known,
    }


def _shape(state: Annotation) -> dict[str, Any] | None:
    shape = state.session.shape
    if not shape.is_estimated:
        return None
    known = {shape.id_of(point) for _, point in state.model.registry}
    return {
        "category": None if shape.learned is None else shape.learned.category,
        "missing": [label for label in shape.ids if label not in known],
    }


def _moved(state: Annotation) -> str:
    """Say that the photo or the model is no longer where it was; empty while both are."""
    needed = state.photo.path, state.model.path
    gone = [path.name for path in needed if not os.path.exists(path)]
    if not gone:
        return ""
    return (
        f"{' and '.join(gone)}: moved, renamed or deleted. Go on here, or start anew with the new "
        f"name and --observation {state.files.observation.name}."
    )


def _pairs(state: Annotation, live: LiveAlignment) -> list[dict[str, Any]]:
    """The pairs with their residuals and, of pairs with one half, the other one's likely place."""
    session, opened, document = state.session, state.model, state.document
    cad, pairs, row = opened.cad, [], 0
    for pair in document.pairs:
        entry: dict[str, Any] = {
            "pair": pair.number,
            "uv": pair.uv,
            "keypoint": pair.keypoint,
            "name": "",
            **dict.fromkeys(("xyz", "expected", "residual", "off")),
            "counts": True,
        }
        if pair.keypoint is not None:
            point = opened.registry[pair.keypoint]
            in_camera = np.array([point.xyz])
            if not pair.uv and not session.shape.is_estimated and live.result is not None:
                in_camera = live.alignment.apply(in_camera)
                if in_camera[0, 2] > 0:
                    entry["expected"] = live.camera.project(in_camera)[0].tolist()
            entry["name"], entry["xyz"] = point.name, cad.to_display(point.xyz).tolist()
            entry["counts"] = session.shape.id_of(point) is not None
        if pair.complete:
            if live.result is not None:
                residual = live.residuals[row]
                entry["residual"] = residual.tolist() if np.isfinite(residual).all() else None
                entry["off"] = live.outliers.get(row)
            row += 1
        pairs.append(entry)
    return pairs


def _alignment(state: Annotation, live: LiveAlignment) -> dict[str, Any]:
    result, cad, session = live.result, state.model.cad, state.session
    if result is None:
        status = "none" if session.ready else "preparing"
        return {"status": status, "message": _named(state, live.message)}
    camera, alignment = live.camera, live.alignment
    # The rows of the matrix (4, 4) that places the displayed model; a warped one has none.
    matrix = np.eye(4)
    linear = alignment.rotation * alignment.scale
    matrix[:3, :3] = linear * cad.diagonal
    matrix[:3, 3] = linear @ cad.center + alignment.translation
    return {
        "status": "done",
        "message": "",
        "facts": [asdict(fact) for fact in facts_of(live, session.shape)],
        "notes": [_named(state, note) for note in notes_of(live, session.shape)],
        "also_used": ", ".join(live.also_used),
        "alignment": alignment.to_dict(),
        "eye": cad.to_display(alignment.inverse(np.zeros((1, 3)))[0]).tolist(),
        "intrinsics": {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy},
        "camera_from_page": None if session.shape.is_estimated else matrix.ravel().tolist(),
        **drawing_of(live, session.shape, state.model.registry, state.document.keypoints),
    }


def _named(state: Annotation, text: str) -> str:
    """A text of the estimate with the photo's name."""
    return text.replace("views[0]", state.photo.path.name)


def _rms(state: Annotation) -> float | None:
    """Residual of the saved alignment, which is not computed anew for a list of many photos."""
    if not state.document.complete_pairs or not state.files.fit.exists():
        return None
    try:
        rms = read_json(state.files.fit).get("rms")
    except CadalignError:
        return None
    return rms if isinstance(rms, float) else None
