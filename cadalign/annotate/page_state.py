"""State of the page as plain data for JSON: one object of a photo, and the list of photos."""

from __future__ import annotations

import os
import re
from dataclasses import asdict
from typing import Any

import numpy as np

from cadalign.annotate.actions import MIRRORED
from cadalign.annotate.estimate import LIKELY_STRETCH
from cadalign.annotate.evidence import MarkedLengths, MaskDrawing, find_up
from cadalign.annotate.live import LiveAlignment, box_of, candidates_of, drawing_of, flat
from cadalign.annotate.masks import draw_mask
from cadalign.annotate.objects import PhotoState, label_of, shown_objects
from cadalign.annotate.result_text import facts_of, name_of, next_best_text, notes_of
from cadalign.annotate.session import ActionOutcome, Session
from cadalign.annotate.suggestion import Suggestion
from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import CadalignError
from cadalign.io.documents import Point3, read_json
from cadalign.io.evidence import LENGTHS

_VIEW = re.compile(r"views\[(\d+)\]")


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
                "up_axis": state.owner.further.up_axis or "y",
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
            "can_undo": bool(state.history.before)
            or session.deletions.last(number, at_once=True) is not None,
            "can_redo": bool(state.history.after),
            "focal": {
                "known": focal.known,
                "pixels": round(state.camera.fx, 2),
                "typed": focal.pixels,
                "note": state.intrinsics.note,
            },
            "evidence": _evidence(session, state),
            "priors": _priors(session, state),
            "pairs": _pairs(session, state, live),
            "keypoints": _keypoints(state),
            "proposals": _proposals(session, state),
            "shape": _shape(session, state),
            "alignment": _alignment(session, state, live),
            "by_mask": _candidates(session, state, live),
            "suggestion": _suggestion(state, suggestion),
            **_objects(session, state),
        }


def _evidence(session: Session, state: PhotoState) -> dict[str, Any]:
    """Marks beside the pairs; ``mask`` changes with the mask, None without one."""
    evidence = state.document.evidence
    found = find_up(evidence.verticals, state.camera)
    sigma = evidence.up_sigma_deg if found is None else found[1]
    lengths = evidence.lengths or MarkedLengths()
    return {
        "mask": None if evidence.mask is None else f"{hash(evidence.mask) & 0xFFFFFFFF:x}",
        "verticals": evidence.verticals,
        "gravity": found is not None or evidence.up is not None,
        "gravity_sigma": None if sigma is None else round(sigma, 1),
        "lengths": {name: getattr(lengths, name) for name in LENGTHS},
        "length_sigma": lengths.sigmas[0] if lengths.sigmas else None,
        "photo": state.owner.document.evidence.photo,
    }


def _candidates(session: Session, state: PhotoState, live: LiveAlignment) -> dict[str, Any]:
    """Alignments that a mask alone allows, as lines x1, y1, x2, y2, ... [px], while no pair tells.

    ``chosen`` says that the user has decided for one.
    """
    result, lines = live.result, live.wireframe
    chosen = session.observer.begins(state) if state.lead is None else False
    if result is None or lines is None or chosen or state.document.complete_pairs:
        return {"chosen": chosen, "candidates": []}
    found = candidates_of(result)
    return {
        "chosen": chosen,
        "candidates": [
            {
                "lines": flat(lines.seen_in(live.camera, each.alignment)),
                "likelihood": each.likelihood,
            }
            for each in (found if len(found) > 1 else [])
        ],
    }


def mask_pixels(session: Session, number: int, *, slot: int | None = None) -> BoolArray:
    """The mask of an object in a photo, (h, w); empty without one."""
    with session.lock:
        state = session.photo_state(number, slot)
        drawing = state.document.evidence.mask or MaskDrawing()
    return draw_mask(drawing, state.photo.width, state.photo.height)


def _priors(session: Session, state: PhotoState) -> dict[str, Any]:
    """Priors on the stretch [%] and on the focal length: chosen ones and likely ones."""
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


def _pairs(session: Session, state: PhotoState, live: LiveAlignment) -> list[dict[str, Any]]:
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
            if live.result is not None:
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


def _expected(session: Session, live: LiveAlignment, xyz: Point3) -> list[float] | None:
    """Pixel at which the alignment of the stretched model puts a point in the photo."""
    if session.shape is not None or live.result is None:
        return None
    in_camera = live.alignment.apply(np.array([xyz]))
    if not in_camera[0, 2] > 0:
        return None
    ((u, v),) = live.camera.project(in_camera).tolist()
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


def _proposals(session: Session, state: PhotoState) -> list[dict[str, Any]]:
    """Proposals of a detector or of other frames for keypoints that are not used yet."""
    used = state.document.keypoints
    return [
        {**asdict(proposal), "name": state.model.registry[proposal.keypoint].name}
        for proposal in session.proposals(state)
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


def _alignment(session: Session, state: PhotoState, live: LiveAlignment) -> dict[str, Any]:
    result, cad = live.result, state.model.cad
    if result is None:
        message = _with_photo_names(session, state, live.message)
        return {"status": "none" if session.ready else "preparing", "message": message}
    camera, alignment = live.camera, live.alignment
    notes = notes_of(live, session.shape)
    # The rows of the matrix (4, 4) that places the displayed model; a warped one has none.
    matrix = np.eye(4)
    linear = alignment.rotation * alignment.scale
    matrix[:3, :3] = linear * cad.diagonal
    matrix[:3, 3] = linear @ cad.center + alignment.translation
    return {
        "status": "done",
        "message": "",
        "facts": [asdict(fact) for fact in facts_of(live, session.shape)],
        "notes": [_with_photo_names(session, state, note) for note in notes],
        "also_used": ", ".join(live.also_used),
        "alignment": alignment.to_dict(),
        "eye": cad.to_display(alignment.inverse(np.zeros((1, 3)))[0]).tolist(),
        "focal": camera.fx,
        "intrinsics": {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy},
        "camera_from_page": matrix.ravel().tolist() if session.shape is None else None,
        "rms": result.rms,
        **drawing_of(live, session.shape, state.model.registry, state.document.keypoints),
    }


def _suggestion(state: PhotoState, suggestion: Suggestion | None) -> dict[str, Any] | None:
    if suggestion is None:
        return None
    point = suggestion.point
    return {
        "keypoint": point.semantic_id,
        "xyz": state.model.cad.to_display(point.xyz).tolist(),
        "uv": suggestion.uv,
        "text": next_best_text(suggestion.next_best, name_of(suggestion)),
    }


def _objects(session: Session, state: PhotoState) -> dict[str, Any]:
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


def _with_photo_names(session: Session, state: PhotoState, text: str) -> str:
    """A text of the estimate with the photos' names for the views' numbers."""
    if not _VIEW.search(text):
        return text
    images = [view.image for view in session.observed(state)[0].views]

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
        "box": box_of(live),
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


def worklist_state(session: Session) -> list[dict[str, Any]]:
    """All photos with their state, objects, number of pairs, and residual.

    The residual is the root mean square of the object whose pairs agree worst [px].
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
    """Residual of the saved alignment, which is not computed anew for a list of many photos."""
    if not state.document.complete_pairs or not state.files.fit.exists():
        return None
    try:
        rms = read_json(state.files.fit).get("rms")
    except CadalignError:
        return None
    return rms if isinstance(rms, float) else None
