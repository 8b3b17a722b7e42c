"""Ranking of a library's models by a photo's pairs, as plain data for the page; thumbnails."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

from cadalign.annotate.choosing.choice import ModelChoice
from cadalign.annotate.files import filled
from cadalign.annotate.session import PhotoState, Session
from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError
from cadalign.geometry.camera import Camera
from cadalign.render import RaycastRenderer, Scene
from cadalign.render.views.viewpoints import frame_object, look_at
from cadalign.retrieval.match import Match
from cadalign.retrieval.page import score_text

LEAST_PAIRS = 4
_THUMBNAIL = (180, 135)  # [px]
_GREY = (185, 189, 196)
_FILL = 0.92
# ShapeNet's models face -z, with y up: seen from the front, the left and above.
_AZIMUTH, _ELEVATION = 150.0, 20.0


@dataclass(frozen=True, eq=False)
class _Marked:
    """The pairs that the library knows: (n, 2) [px], n semantic ids, (n,) [px]."""

    points_2d: FloatArray
    semantic_ids: list[int]
    sigma: FloatArray | float


def ranking_state(session: Session, number: int, *, slot: int | None = None) -> dict[str, Any]:
    """Rank the models by the pairs of an object, as `cadalign retrieve` ranks them by its file.

    Pairs of points that no model of the library has don't count. Without a known focal length that
    of the alignment, else a likely one, is taken.
    """
    with session.lock:
        state = session.photo_state(number, slot)
        choice = session.choice
        revision = state.history.revision
        answer: dict[str, Any] = {"revision": revision, "note": "", "none": None, "models": []}
        if choice is None:
            return answer | {"note": "The session has no library: start it with --library."}
        marked = _marked(state, choice)
        others = len(state.document.complete_pairs) - len(marked.semantic_ids)
        missing = LEAST_PAIRS - len(marked.semantic_ids)
        if missing > 0:
            return answer | {"note": _too_few(missing, others)}
        camera = _camera(session, state)
        current = choice.key_of(state.files.model)
        known = state.document.focal.known
    # Without the lock, for which the next click would wait.
    try:
        matches = choice.library.retrieve(
            marked.points_2d,
            marked.semantic_ids,
            camera,
            sigma=marked.sigma,
            category=choice.category,
        )
    except CadalignError as error:
        return answer | {"note": str(error)}
    note = f"Ranked by {len(marked.semantic_ids)} pairs of named keypoints."
    if others:
        note += f" {others} of other points don't count."
    if not known:
        note += f" The focal length is taken as {camera.fx:.0f} px."
    absent = matches[0].none_probability if matches else None
    return answer | {
        "note": note,
        "none": None if absent is None else score_text(absent),
        "models": [_entry(match, choice, current) for match in matches],
    }


def thumbnail_of(choice: ModelChoice, number: int) -> bytes:
    """Draw the model of a number among `ModelChoice.keys`, as a small JPEG."""
    if not 0 <= number < len(choice.keys):
        number = 0
    scene = Scene(choice.model(choice.keys[number]).load_mesh())
    camera = Camera.from_fov(*_THUMBNAIL, fov_x=30.0)
    turned = look_at(azimuth=_AZIMUTH, elevation=_ELEVATION, distance=1.0)
    pose = frame_object(scene.bounds, camera, rotation=turned.rotation, fill=_FILL)
    frame = RaycastRenderer().render(scene, camera, pose)
    background = np.full((camera.height, camera.width, 3), _GREY, dtype=np.uint8)
    data = io.BytesIO()
    Image.fromarray(frame.composite(background)).save(data, "JPEG", quality=85)
    return data.getvalue()


def _marked(state: PhotoState, choice: ModelChoice) -> _Marked:
    known = choice.ids_on(state.files.model)
    pairs = [pair for pair in state.document.complete_pairs if pair.keypoint in known]
    sigma = filled(pair.sigma for pair in pairs)
    return _Marked(
        np.array([pair.uv for pair in pairs], dtype=float).reshape(-1, 2),
        [pair.keypoint for pair in pairs if pair.keypoint is not None],
        1.0 if sigma is None else sigma,
    )


def _camera(session: Session, state: PhotoState) -> Camera:
    """The calibrated camera, else that of the alignment, else a likely one."""
    if state.document.focal.known:
        return state.intrinsics.with_focal(state.document.focal)
    live, _ = session.live(state)
    found = None if live.shown is None else getattr(live.shown, "camera", None)
    return found or state.intrinsics.with_focal(state.document.focal)


def _too_few(missing: int, others: int) -> str:
    text = (
        f"Mark {missing} more of the named keypoints, which all models of the library share: the "
        "rings on the model, also listed under Next keypoint."
    )
    return text + (f" {others} pairs of other points don't count." if others else "")


def _entry(match: Match, choice: ModelChoice, current: tuple[str, str] | None) -> dict[str, Any]:
    key = (match.category, match.model_id)
    return {
        "number": choice.keys.index(key),
        "category": match.category,
        "model": match.model_id,
        "probability": score_text(match.score),
        "score": match.score,
        "rms": match.rms,
        "shared": match.shared,
        "marked": match.shared + len(match.missing_ids),
        "stretch": match.alignment.scale.tolist(),
        "has_mesh": match.mesh_path is not None,
        "current": key == current,
    }
