"""State of one photo as the page shows it, as plain data for JSON."""

from __future__ import annotations

import os
from dataclasses import asdict
from typing import Any

import numpy as np

from cadalign.annotate.action import ActionOutcome
from cadalign.annotate.actions import MIRRORED
from cadalign.annotate.advice import Marked, present, rank
from cadalign.annotate.alignment import LIKELY_STRETCH, LiveAlignment
from cadalign.annotate.drawing import drawing_of_fit, drawing_of_shape
from cadalign.annotate.evidence import MarkedLengths, MaskDrawing, find_up
from cadalign.annotate.files import filled
from cadalign.annotate.masks import draw_mask
from cadalign.annotate.objects.page import objects_state, with_photo_names
from cadalign.annotate.result_text import (
    evidence_text,
    facts_of,
    facts_of_shape,
    how_text,
    left_text,
    next_best_text,
    notes_of,
)
from cadalign.annotate.session import Live, PhotoState, Session
from cadalign.annotate.shape_alignment import LiveShape
from cadalign.annotate.suggestion import Suggestion
from cadalign.arrays import BoolArray, FloatArray
from cadalign.geometry.alignment import Alignment
from cadalign.io.documents import Point3
from cadalign.io.evidence import LENGTHS

_FOCAL = "With a known focal length, a mask, another photo and lengths are ranked here too."


def page_state(
    session: Session, number: int, outcome: ActionOutcome | None = None, *, slot: int | None = None
) -> dict[str, Any]:
    """Collect everything that the page shows of an object, after an action of that outcome.

    It is an object of the photo of a number, or the one that the outcome goes on with.
    """
    outcome = outcome or ActionOutcome()
    with session.lock:
        state = outcome.shown or session.photo_state(number, slot)
        number, slot = session.place_of(state)
        live, suggestion = session.live(state)
        focal = state.document.focal
        return {
            "revision": state.history.revision,
            "image": {
                "number": number,
                "object": slot,
                "count": len(session.objects),
                "name": state.photo.path.name,
                "width": state.photo.width,
                "height": state.photo.height,
                "model": state.files.model.name,
                "model_number": session.models.number_of(state.model.path),
                "has_library": session.choice is not None,
                "state": session.work_state(state),
            },
            "saved": {
                "path": state.files.observation.name,
                "at": state.owner.saved_at,
                "trouble": state.owner.save_error,
            },
            "selected": outcome.selected,
            "message": outcome.message or _moved(state),
            "can_undo": state.history.can_undo
            or session.deletions.last(number, at_once=True) is not None,
            "can_redo": state.history.can_redo,
            "focal": {
                "known": focal.known,
                "pixels": round(state.intrinsics.with_focal(focal).fx, 2),
                "typed": focal.pixels,
                "note": state.intrinsics.note,
            },
            "evidence": _evidence(session, state),
            "priors": _priors(session, state),
            "pairs": _pairs(session, state, live),
            "keypoints": _keypoints(state),
            "proposals": _proposals(state),
            "shape": _shape(session, state),
            "alignment": _alignment(session, state, live),
            "suggestion": _suggestion(state, suggestion),
            **objects_state(session, state),
        }


def advice_state(session: Session, number: int, *, slot: int | None = None) -> dict[str, Any]:
    """Rank what could be added to an object's pairs, of the annotation of that ``revision``.

    Nothing is ranked without an alignment by the pairs alone, for an object's own shape, and where
    the focal length is estimated.
    """
    with session.lock:
        state = session.photo_state(number, slot)
        live, suggestion = session.live(state)
        document, revision = state.document, state.history.revision
        pairs = document.complete_pairs
        points_3d = state.model.registry.xyz(
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
    ranked = rank(state.model.cad, Marked(points_3d, points_2d, sigma), live.cautious, suggestion)
    name = "" if suggestion is None else _name_of(suggestion)
    pieces = [
        {
            "kind": each.kind,
            "what": evidence_text(each, name),
            "left": left_text(each),
            "how": how_text(each, state.files.observation.name),
            "worst": each.worst,
        }
        for each in ranked
    ]
    now = present(live.cautious)
    return answer | {"now": "" if now is None else left_text(now), "pieces": pieces}


def _evidence(session: Session, state: PhotoState) -> dict[str, Any]:
    """Marks beside the pairs; ``mask`` changes with the mask, None without one."""
    evidence = state.document.evidence
    camera = state.intrinsics.with_focal(state.document.focal)
    found = find_up(evidence.verticals, camera)
    sigma = evidence.up_sigma_deg if found is None else found[1]
    lengths = evidence.lengths or MarkedLengths()
    return {
        "mask": None if evidence.mask is None else f"{hash(evidence.mask) & 0xFFFFFFFF:x}",
        "verticals": evidence.verticals,
        "gravity": found is not None or evidence.up is not None,
        "gravity_sigma": None if sigma is None else round(sigma, 1),
        "lengths": {name: getattr(lengths, name) for name in LENGTHS},
        "length_sigma": lengths.sigmas[0] if lengths.sigmas else None,
    }


def mask_pixels(session: Session, number: int, *, slot: int | None = None) -> BoolArray:
    """The mask of an object in a photo, (h, w); empty without one."""
    with session.lock:
        state = session.photo_state(number, slot)
        drawing = state.document.evidence.mask or MaskDrawing()
    return draw_mask(drawing, state.photo.width, state.photo.height)


def _priors(session: Session, state: PhotoState) -> dict[str, Any]:
    """The priors, and those that can be chosen: on the stretch [%], on the focal length."""
    priors = state.document.priors
    likely = priors.focal or state.intrinsics.likely_focal
    source = "EXIF" if likely == state.intrinsics.prior else "usual lenses"
    is_estimated = state.lead is None and session.estimates_focal(state)
    return {
        "stretch": None if priors.stretch is None else round(100 * priors.stretch, 4),
        "likely": 100 * LIKELY_STRETCH,
        "focal": priors.focal is not None,
        "about": f"{likely.focal:.0f} px ± {100 * likely.relative_sigma:.0f} % ({source})",
        "has_stretch": session.shape is None,
        "has_focal": is_estimated,
    }


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
    document = state.document
    used = state.model.registry.xyz(document.keypoints)
    for pair in document.pairs:
        point = None if pair.keypoint is None else state.model.registry[pair.keypoint]
        entry: dict[str, Any] = {
            "pair": pair.number,
            "position": pair.number,
            "uv": pair.uv,
            "keypoint": pair.keypoint,
            "name": "" if point is None else point.name,
            "xyz": None if point is None else state.model.cad.to_display(point.xyz).tolist(),
            "mirrored": None
            if pair.keypoint is None
            else _mirrored(session, state, pair.keypoint, used),
            "expected": None if point is None or pair.uv else _expected(session, live, point.xyz),
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


def _mirrored(
    session: Session, state: PhotoState, keypoint: int, used: FloatArray
) -> list[float] | None:
    """The mirror image of a model point, unless there is a pair already."""
    point = state.model.mirrored(keypoint) if session.ready else None
    if point is None:
        return None
    gaps = np.linalg.norm(used - point.xyz, axis=1)
    if gaps.min() <= MIRRORED * state.model.cad.diagonal:
        return None
    return [float(value) for value in state.model.cad.to_display(point.xyz)]


def _expected(session: Session, live: Live, xyz: Point3) -> list[float] | None:
    """Pixel at which the alignment of the stretched model puts a point in the photo."""
    if session.shape is not None or live.shown is None:
        return None
    if isinstance(live, LiveShape):
        camera, alignment = live.camera, live.alignment
    else:
        camera, alignment = live.shown.camera, live.shown.alignment
    in_camera = alignment.apply(np.array([xyz]))
    if camera is None or not in_camera[0, 2] > 0:
        return None
    ((u, v),) = camera.project(in_camera).tolist()
    return [u, v]


def _keypoints(state: PhotoState) -> list[dict[str, Any]]:
    used = state.document.keypoints
    return [
        {
            "keypoint": number,
            "name": point.name,
            "xyz": state.model.cad.to_display(point.xyz).tolist(),
            "used": number in used,
        }
        for number, point in state.model.registry
    ]


def _proposals(state: PhotoState) -> list[dict[str, Any]]:
    """Those of a detector whose keypoints are not used yet."""
    used = state.document.keypoints
    return [
        {**asdict(proposal), "name": state.model.registry[proposal.keypoint].name}
        for proposal in state.proposals
        if proposal.keypoint not in used
    ]


def _shape(session: Session, state: PhotoState) -> dict[str, Any] | None:
    """The object's shape, and its keypoints that the model lacks."""
    shape = session.shape
    if shape is None:
        return None
    known = {shape.id_of(point) for _, point in state.model.registry}
    return {
        "category": None if shape.learned is None else shape.learned.category,
        "missing": [label for label in shape.ids if label not in known],
    }


def _alignment(session: Session, state: PhotoState, live: Live) -> dict[str, Any]:
    result = live.shown
    if result is None:
        message = with_photo_names(session, state, live.message)
        return {"status": "none" if session.ready else "preparing", "message": message}
    if isinstance(live, LiveShape):
        assert live.camera is not None
        camera, alignment = live.camera, live.alignment
        facts = facts_of_shape(live, session.shape)
        texts = notes_of(live, session.shape)
        notes = [with_photo_names(session, state, text) for text in texts]
        used = state.document.keypoints
        drawing = drawing_of_shape(live, session.shape, state.model.registry, used)
    else:
        assert live.cautious is not None
        camera, alignment = live.cautious.camera, live.cautious.alignment
        facts, notes = facts_of(live), list(notes_of(live))
        drawing = drawing_of_fit(live.cautious, state.model.wireframe)
    return {
        "status": "done",
        "message": "",
        "facts": [asdict(fact) for fact in facts],
        "notes": notes,
        "also_used": ", ".join(live.also_used),
        "alignment": alignment.to_dict(),
        "eye": state.model.cad.to_display(alignment.inverse(np.zeros((1, 3)))[0]).tolist(),
        "focal": camera.fx,
        "intrinsics": {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy},
        "camera_from_page": _camera_from_page(session, state, alignment),
        "rms": result.rms,
        **drawing,
    }


def _camera_from_page(
    session: Session, state: PhotoState, alignment: Alignment
) -> list[float] | None:
    """The rows of the matrix (4, 4) that places the displayed model; None for a warped one."""
    if session.shape is not None:
        return None
    model = state.model.cad
    matrix = np.eye(4)
    linear = alignment.rotation * alignment.scale
    matrix[:3, :3] = linear * model.diagonal
    matrix[:3, 3] = linear @ model.center + alignment.translation
    return [float(value) for value in matrix.ravel()]


def _suggestion(state: PhotoState, suggestion: Suggestion | None) -> dict[str, Any] | None:
    if suggestion is None:
        return None
    point = suggestion.point
    return {
        "keypoint": point.semantic_id,
        "xyz": state.model.cad.to_display(point.xyz).tolist(),
        "uv": suggestion.uv,
        "text": next_best_text(suggestion.next_best, _name_of(suggestion)),
    }


def _name_of(suggestion: Suggestion) -> str:
    return suggestion.point.name or "The marked corner"
