"""Ranking of a library's models by the pairs of an object, for the page."""

from __future__ import annotations

from typing import Any

import numpy as np

from cadalign.annotate.annotation import filled
from cadalign.annotate.problem import LEAST_PAIRS
from cadalign.annotate.session import Session
from cadalign.errors import CadalignError
from cadalign.retrieval.page import score_text


def ranking_state(session: Session, number: int) -> dict[str, Any]:
    """Rank the models by the pairs of an object, as `cadalign retrieve` ranks them by its file.

    Pairs of points that no model of the library has don't count. Without a known focal length the
    alignment's, else a likely one, is taken.
    """
    with session.lock:
        state, choice = session.annotation(number), session.choice
        answer: dict[str, Any] = {"note": "", "none": None, "models": []}
        if choice is None:
            return answer | {"note": "The session has no library: start it with --library."}
        known, complete = choice.ids_on(state.model.path), state.document.complete_pairs
        pairs = [pair for pair in complete if pair.keypoint in known]
        others = len(complete) - len(pairs)
        if len(pairs) < LEAST_PAIRS:
            note = (
                f"Mark {LEAST_PAIRS - len(pairs)} more of the named keypoints, which all models "
                "of the library share: the rings on the model, also listed under Next keypoint."
            )
            counted = f" {others} pairs of other points don't count." if others else ""
            return answer | {"note": note + counted}
        camera, is_known = state.camera, state.document.focal.known
        live, _ = session.live(state)
        if not is_known and live.result is not None:
            camera = live.camera
        current = choice.key_of(state.model.path)
    sigma = filled(pair.sigma for pair in pairs)
    # Without the lock, for which the next click would wait.
    try:
        matches = choice.library.retrieve(
            np.array([pair.uv for pair in pairs], dtype=float),
            [pair.keypoint for pair in pairs if pair.keypoint is not None],
            camera,
            sigma=1.0 if sigma is None else sigma,
            category=choice.category,
        )
    except CadalignError as error:
        return answer | {"note": str(error)}
    note = f"Ranked by {len(pairs)} pairs of named keypoints."
    if others:
        note += f" {others} of other points don't count."
    if not is_known:
        note += f" The focal length is taken as {camera.fx:.0f} px."
    absent = matches[0].none_probability if matches else None
    models = [
        {
            "number": choice.keys.index((match.category, match.model_id)),
            "category": match.category,
            "model": match.model_id,
            "probability": score_text(match.score),
            "score": match.score,
            "rms": match.rms,
            "shared": match.shared,
            "marked": match.shared + len(match.missing_ids),
            "stretch": match.alignment.scale.tolist(),
            "has_mesh": match.mesh_path is not None,
            "current": (match.category, match.model_id) == current,
        }
        for match in matches
    ]
    none = None if absent is None else score_text(absent)
    return answer | {"note": note, "none": none, "models": models}
