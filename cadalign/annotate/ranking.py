"""Models of a library: their ranking by an object's pairs, and going on with another one."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cadalign.annotate.document import AnnotationDocument, FurtherView, Pair
from cadalign.annotate.keypoints import KeypointRegistry
from cadalign.annotate.library import ModelChoice
from cadalign.annotate.objects import PhotoState
from cadalign.annotate.observing import filled
from cadalign.annotate.session import Session
from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, InputError
from cadalign.geometry.camera import Camera
from cadalign.retrieval.match import Match
from cadalign.retrieval.models import ModelKey
from cadalign.retrieval.page import score_text

_LEAST_PAIRS = 4


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
        missing = _LEAST_PAIRS - len(marked.semantic_ids)
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
        return state.camera
    live, _ = session.live(state)
    return state.camera if live.result is None else live.camera


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


def switch_model(session: Session, state: PhotoState, key: ModelKey) -> None:
    """Exchange an object's model, and the pairs' halves on it."""
    choice = session.choice
    if choice is None:
        raise InputError("the session has no library", where="model", fix="start with --library")
    mesh = choice.model(key).mesh_path
    assert mesh is not None
    session.before_saving()  # where nothing may be written, nothing is changed either
    owner = state.owner
    old, new = owner.model, session.models.of(mesh)
    if new is old:
        return
    if session.ready:
        new.prepare(has_shape=session.shape is not None)
    carried = carry_keypoints(old.registry, new.registry, choice.ids_on(old.path))
    history = owner.history.changed(lambda document: _carried(document, carried))
    for each in (owner, *owner.views):
        each.model = new
        each.files = replace(each.files, model=new.path)
        each.history = history
        each.live = each.estimate = None
        each.proposals = tuple(
            replace(proposal, keypoint=carried[proposal.keypoint])
            for proposal in each.proposals
            if proposal.keypoint in carried
        )


def carry_keypoints(
    old: KeypointRegistry, new: KeypointRegistry, known: Collection[int]
) -> dict[int, int]:
    """Ids of the old model's keypoints on the new one: of the same semantic id, else name.

    Semantic ids tell of those that are ``known``. A keypoint that was renamed keeps its name.
    """
    carried = {number: number for number, _ in old if number in known and number in new}
    for number in carried:
        if old[number].name != new[number].name:
            new.rename(number, old[number].name)
    free = {point.name: number for number, point in new if number not in carried}
    return carried | {
        number: free[point.name]
        for number, point in old
        if number not in carried and point.name in free
    }


def _carried(document: AnnotationDocument, carried: Mapping[int, int]) -> AnnotationDocument:
    """The document with its pairs' keypoints on the new model; halves without any are left out."""
    moved: list[Pair] = []
    for pair in document.pairs:
        keypoint = None if pair.keypoint is None else carried.get(pair.keypoint)
        if keypoint is not None or pair.uv is not None:
            moved.append(replace(pair, keypoint=keypoint))
    views = tuple(
        FurtherView(view.photo, _carried(view.document, carried)) for view in document.further_views
    )
    return replace(document, pairs=tuple(moved), further_views=views)
