"""State of the page as plain data for JSON: the annotation of a photo, and the photos."""

from __future__ import annotations

from typing import Any

import numpy as np

from cadalign.annotate.actions import ActionOutcome
from cadalign.annotate.keypoints import ObjectShape
from cadalign.annotate.model import box_lines
from cadalign.annotate.session import Annotation, LiveAlignment, Session
from cadalign.arrays import FloatArray
from cadalign.estimation.result import Result
from cadalign.geometry.alignment import (
    NOT_DETERMINED,
    NOT_DETERMINED_ROTATION_DEG,
    distance_deviation,
)
from cadalign.io.evidence import LENGTHS
from cadalign.io.observation import Observation
from cadalign.io.pretrained import CATEGORIES
from cadalign.render.layers import confidence_regions

_LABELS = {"up": "gravity", "camera_height": "camera height", "cam_from_rig": "camera pose"}
_LEFT_OPEN = 0.8  # of a prior's standard deviation; beyond it, the pairs add no information
_UNDETERMINED = "not determined", "these pairs leave it open"


def page_state(
    session: Session, number: int, outcome: ActionOutcome | None = None
) -> dict[str, Any]:
    """Collect all that the page shows of a photo, with the outcome of an action."""
    outcome = outcome or ActionOutcome()
    with session.lock:
        state = session.annotation(number)
        live, marks, photo = session.live(state), state.marks, state.photo
        registry, cad = state.model.registry, state.model.cad
        likely, focal = photo.likely_focal, marks.camera.fx
        return {
            "image": {
                "number": number,
                "count": len(session.photos),
                "name": photo.path.name,
                "width": photo.width,
                "height": photo.height,
                "up_axis": state.file.stored.up_axis or "y",
            },
            "saved": {"path": state.file.path.name, "trouble": state.save_error},
            "selected": outcome.selected,
            "message": outcome.message,
            "can_undo": bool(state.history.before),
            "can_redo": bool(state.history.after),
            "focal": {
                "known": marks.camera.focal_known,
                "pixels": round(focal if marks.camera.focal_known else likely.focal, 2),
                "prior": f"about {likely.focal:.0f} px ± {100 * likely.relative_sigma:.0f} %",
            },
            "evidence": {
                "mask": None if marks.mask is None else f"{hash(marks.mask) & 0xFFFFFFFF:x}",
                "photo": marks.photo,
                "outline": state.model.shape.has_outline,
            },
            "pairs": _pairs(state, live),
            "keypoints": [
                {
                    "keypoint": keypoint,
                    "name": point.name,
                    "xyz": cad.to_display(point.xyz).tolist(),
                    "used": keypoint in marks.keypoints,
                }
                for keypoint, point in registry
            ],
            "shape": _shape(state),
            "model": {
                "key": state.model.shape.category or "",
                "is_skeleton": state.model.is_skeleton,
                "proposed": state.next_keypoint(live),
                "categories": CATEGORIES if state.model.can_exchange else (),
            },
            "alignment": _alignment(state, live, is_ready=session.ready),
        }


def photos_state(session: Session) -> list[dict[str, Any]]:
    """All photos with their numbers of pairs."""
    with session.lock:
        return [
            {"name": each.photo.path.name, "pairs": len(each.marks.complete_pairs)}
            for each in session.photos
        ]


def _shape(state: Annotation) -> dict[str, Any] | None:
    """Return the shape's category, and its keypoints that the model lacks."""
    shape = state.model.shape
    if shape.learned is None:
        return None
    known = state.model.numbers
    return {
        "category": shape.learned.category,
        "missing": [label for label in shape.ids if label not in known],
    }


def _pairs(state: Annotation, live: LiveAlignment) -> list[dict[str, Any]]:
    """Return the pairs with their residuals; outliers are ``off`` by a distance [px]."""
    counting, row = iter(live.counts), 0
    pairs = []
    for pair in state.marks.pairs:
        entry: dict[str, Any] = {
            "pair": pair.number,
            "uv": pair.uv,
            "keypoint": pair.keypoint,
            "name": "",
            **dict.fromkeys(("xyz", "residual", "off")),
            "counts": True,
        }
        if pair.keypoint is not None:
            point = state.model.registry[pair.keypoint]
            entry["name"], entry["xyz"] = point.name, state.model.cad.to_display(point.xyz).tolist()
            entry["counts"] = state.model.shape.id_of(point) is not None
        if pair.complete and live.estimate is not None and next(counting):
            residual = live.estimate.result.residuals[row]
            entry["residual"] = residual.tolist() if np.isfinite(residual).all() else None
            entry["off"] = live.estimate.outliers.get(row)
            row += 1
        pairs.append(entry)
    return pairs


def _alignment(state: Annotation, live: LiveAlignment, *, is_ready: bool) -> dict[str, Any]:
    if live.estimate is None:
        status, name = "none" if is_ready else "preparing", state.photo.path.name
        return {"status": status, "message": live.message.replace("views[0]", name)}
    alignment = live.estimate.result.alignment
    return {
        "status": "done",
        "message": "",
        "facts": facts_of(live, state.model.shape, prior=state.file.stretch_sigma),
        "notes": [
            note.replace("views[0]", state.photo.path.name) for note in notes_of(state, live)
        ],
        "also_used": ", ".join(evidence_labels(state.file.observation_of(state.marks))),
        "eye": state.model.cad.to_display(alignment.inverse(np.zeros((1, 3)))[0]).tolist(),
        **_drawing(state, live),
    }


def _drawing(state: Annotation, live: LiveAlignment) -> dict[str, Any]:
    """Return box and edges of the model, and unmarked keypoints of a learned shape."""
    assert live.estimate is not None
    result = live.estimate.result
    camera, alignment = result.camera, result.alignment
    lines = live.lines, box_lines(result.bounds, camera, alignment)
    edges, box = (_round(each[(np.abs(each) < 1e6).all(axis=(1, 2))]) for each in lines)
    unmarked, regions = [], []
    if state.model.shape.learned is not None:
        numbers, used = state.model.numbers, state.marks.keypoints
        free = {label for label, number in numbers.items() if number not in used}
        in_camera = alignment.apply(result.points_3d)
        known = np.array([label in free for label in result.ids], dtype=bool)
        rows = np.flatnonzero(known & camera.sees(in_camera))
        pixels, covariances = camera.project(in_camera[rows]), result.points_cam_covariance
        unmarked = [
            {"keypoint": numbers[result.ids[row]], "uv": uv}
            for row, uv in zip(rows, np.round(pixels, 1).tolist(), strict=True)
        ]
        if covariances is not None:
            places = camera.projected_covariances(in_camera[rows], covariances[rows])
            curves = confidence_regions(pixels, places)
            regions = _round(np.concatenate([curves, curves[:, :1]], axis=1))
    return {"lines": edges, "box": box, "unmarked": unmarked, "regions": regions}


def _round(paths: FloatArray) -> list[list[float]]:
    """Round paths (k, n, 2) to 0.1 px, and flatten each to u1, v1, u2, v2, ..."""
    rounded: list[list[float]] = np.round(paths, 1).reshape(len(paths), -1).tolist()
    return rounded


def evidence_labels(observation: Observation) -> list[str]:
    """Name the evidence of an observation besides keypoints, for the page."""
    names = dict.fromkeys(observation.evidence.sources)
    if observation.depths is not None:
        names["depth"] = None
    if observation.fit_options.get("image") and not observation.evidence.mask:
        names["photo"] = None
    known = [name for name in LENGTHS if getattr(observation.size, name, None) is not None]
    if known:
        names[f"known {' and '.join(known)}"] = None
    return [_LABELS.get(name, name) for name in names]


def facts_of(
    live: LiveAlignment, shape: ObjectShape, *, prior: float | None = None
) -> list[dict[str, str]]:
    """List stretch or lengths, pose and residuals: label, value with standard deviation, note.

    ``prior`` is the standard deviation of the prior on the stretch.
    """
    assert live.estimate is not None
    result = live.estimate.result
    in_lengths = shape.learned is not None or "x" in result.stretched_axes
    axes = "xyz" if in_lengths else result.stretched_axes
    facts = {}
    for axis in axes:
        label = f"{'Length' if in_lengths else 'Stretch'} {axis}"
        facts[label] = _extent(result, axis, shape, prior=None if in_lengths else prior)
    if result.std is not None:
        sigma = result.std.rotation_deg
        is_open = sigma > NOT_DETERMINED_ROTATION_DEG
        facts["Rotation"] = _UNDETERMINED if is_open else (f"± {short(sigma)}°", "")
    facts["Distance"] = _distance(result, shape)
    facts["Focal length"] = _focal(result, is_assumed="focal length" in live.estimate.message)
    if 2 * live.counts.sum() > 6 + len(result.stretched_axes):
        note = f"rms, at ± {short(live.estimate.sigma)} px a point"
        facts["Residuals"] = f"{short(result.rms)} px", note
    return [{"label": k, "value": value, "note": note} for k, (value, note) in facts.items()]


def notes_of(state: Annotation, live: LiveAlignment) -> list[str]:
    """List assumptions, pairs that do not count, alternative alignments and warnings."""
    assert live.estimate is not None
    result, shape = live.estimate.result, state.model.shape
    notes = [live.estimate.message] if live.estimate.message else []
    idle = int((~live.counts).sum())
    if idle:
        subject = f"{idle} pair{'s do' if idle > 1 else ' does'} not count"
        known = shape.knows(state.marks.points_of(state.marks.complete_pairs))
        reason = "the mask alone aligns until there are 3"
        if shape.learned is not None and not known.all():
            reason = f"the shape of {shape.learned.category} has no such keypoint"
        notes.append(f"{subject}: {reason}.")
    others = len(result.alternatives)
    if others and live.counts.any():
        how = "as well" if shape.learned is None else "nearly as well"
        notes.append(
            f"{others} other alignment{'s explain' if others > 1 else ' explains'} these pairs "
            f"{how}: one more pair tells them apart."
        )
    shown = {"outlier"} if live.estimate.outliers else set()  # at the pairs
    warnings = (each.text for each in result.warnings if each.kind not in shown)
    return notes + [text.replace("+-", "± ") for text in warnings]


def _extent(
    result: Result, axis: str, shape: ObjectShape, *, prior: float | None
) -> tuple[str, str]:
    """Return the length of the object along an axis, or its stretch if that has a prior."""
    row, average = "xyz".index(axis), "the model" if shape.learned is None else "the average"
    value = stretch = float(result.stretch[row])
    relative = 0.0 if result.std is None else float(result.std.scale[row])
    if prior is None:
        value = float(np.ptp(result.bounds, axis=0)[row] * result.alignment.scale[row])
    if not value > 0 or relative > NOT_DETERMINED:
        return _UNDETERMINED
    if relative == 0:
        return f"{value:.3g}", "taken as known"
    if prior is not None and relative > _LEFT_OPEN * prior:
        return "not determined", f"these pairs leave it open: 1 ± {100 * prior:.0f} % is assumed"
    percent = 100 * (stretch - 1)
    note = f"{abs(percent):.0f} % {'longer' if percent > 0 else 'shorter'} than {average}"
    if abs(percent) < max(100 * relative, 0.5):
        note = f"like {average}"
    return f"{value:.3g} ± {short(value * relative)}", note


def _distance(result: Result, shape: ObjectShape) -> tuple[str, str]:
    covariance, distance = result.covariance, float(np.linalg.norm(result.alignment.translation))
    unit = "model units" if shape.learned is None else shape.learned.unit
    if covariance is None or not distance > 0:
        return f"{distance:.3g}", unit
    relative = distance_deviation(result.alignment, covariance)
    if relative > NOT_DETERMINED:
        return _UNDETERMINED
    return f"{distance:.3g} ± {short(relative * distance)}", unit


def _focal(result: Result, *, is_assumed: bool) -> tuple[str, str]:
    focal = result.camera.fx
    if result.std is None or result.focal == "known":
        return f"{focal:.0f} px", "assumed" if is_assumed else "taken as known"
    relative = result.std.focal
    if relative > NOT_DETERMINED:
        return _UNDETERMINED
    return f"{focal:.0f} ± {short(focal * relative)} px", "estimated"


def short(value: float) -> str:
    """Format a number with two digits, without an exponent."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"
