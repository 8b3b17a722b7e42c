"""Annotation session: the photos, their annotations, and the actions on them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.annotate.alignment import LiveAlignment, align
from cadalign.annotate.document import Document, FocalChoice, Pixel
from cadalign.annotate.files import AnnotationFiles, sigmas_of, write_keypoints
from cadalign.annotate.history import History
from cadalign.annotate.intrinsics import Intrinsics
from cadalign.annotate.keypoint_registry import KeypointRegistry
from cadalign.annotate.model import CadModel
from cadalign.annotate.photos import Photo
from cadalign.annotate.suggestion import Suggestion, suggest
from cadalign.annotate.wireframe import Wireframe
from cadalign.errors import CadalignError, InputError
from cadalign.evaluation.simulation.problems import simulate_problem
from cadalign.io.json_file import as_index, as_numbers, as_text

_FOCAL_RANGE = (0.05, 200.0)  # of a focal length, in image widths


@dataclass
class PhotoState:
    """One photo, its annotation, and the outcome of the last save."""

    photo: Photo
    files: AnnotationFiles
    intrinsics: Intrinsics
    history: History
    saved_at: float | None = None
    save_error: str = ""
    fit_pending: bool = False
    """True if the alignment's file is still to be written, since the solvers were not ready."""
    _live: tuple[Document, LiveAlignment, Suggestion | None] | None = field(
        default=None, repr=False
    )

    @property
    def document(self) -> Document:
        """The current annotation."""
        return self.history.document


@dataclass(frozen=True)
class Outcome:
    """Outcome of an action beside the changed document.

    Parameters
    ----------
    selected : int, optional
        Number of the pair that was placed or changed.
    message : str
        Message for the user, such as that the click missed the model.
    """

    selected: int | None = None
    message: str = ""


class Session:
    """All state of an annotator; safe to use from several threads.

    Parameters
    ----------
    model : CadModel
    registry : KeypointRegistry
    photos : list of PhotoState
    keypoints_path : Path
        File to which the model's keypoints are written.
    """

    def __init__(
        self,
        model: CadModel,
        registry: KeypointRegistry,
        photos: list[PhotoState],
        keypoints_path: Path,
    ) -> None:
        self.model = model
        self.registry = registry
        self.photos = photos
        self.keypoints_path = keypoints_path
        self.wireframe = Wireframe(model)
        self.lock = threading.RLock()
        self._ready = threading.Event()
        self._actions: dict[str, Callable[[PhotoState, Mapping[str, Any]], Outcome]] = {
            "place_uv": self._place_uv,
            "place_keypoint": self._place_keypoint,
            "pick": self._pick,
            "suggested": self._place_suggested,
            "move": self._move,
            "release": self._release,
            "delete": self._delete,
            "rename": self._rename,
            "focal": self._focal,
            "undo": self._undo,
            "redo": self._redo,
        }

    @property
    def ready(self) -> bool:
        """True once the solvers are compiled and loaded, so that a fit is instant."""
        return self._ready.is_set()

    def warm_up(self) -> None:
        """Compile or load the solvers by aligning a synthetic problem, and prepare the model."""
        try:
            problem = simulate_problem(np.random.default_rng(0), points=8, noise_px=1.0)
            intrinsics = Intrinsics(problem.camera, calibrated=True)
            for known in (True, False):
                align(
                    problem.points_3d, problem.points_2d, None, intrinsics, FocalChoice(known=known)
                )
            # Takes seconds on a model of millions of faces, which the first click would wait for.
            _ = self.model.scene.caster, self.model.samples
        finally:  # an error here occurs again, and is reported, when the user aligns
            self._ready.set()
            with self.lock:
                for state in self.photos:
                    if state.fit_pending:
                        self.save(state)

    def photo_state(self, number: int) -> PhotoState:
        """The photo of a number, counted from 0; raises InputError if there is none."""
        if not 0 <= number < len(self.photos):
            raise InputError(f"there is no photo {number + 1}", where="image")
        return self.photos[number]

    def live(self, state: PhotoState) -> tuple[LiveAlignment, Suggestion | None]:
        """Compute the alignment and the next-best keypoint of the current annotation."""
        document = state.document
        if state._live is not None and state._live[0] is document:
            return state._live[1:]
        if not self.ready:
            return LiveAlignment(message="Solvers and model are being prepared."), None
        pairs = document.complete_pairs
        live = align(
            self.registry.xyz(pair.keypoint for pair in pairs if pair.keypoint is not None),
            np.array([pair.uv for pair in pairs], dtype=float).reshape(-1, 2),
            sigmas_of(pairs),
            state.intrinsics,
            document.focal,
        )
        suggestion = suggest(self.model, self.registry, document.keypoints, live)
        state._live = (document, live, suggestion)
        return live, suggestion

    def act(self, number: int, action: Mapping[str, Any]) -> Outcome:
        """Do an action on a photo and save its changes.

        Parameters
        ----------
        number : int
            Number of the photo, counted from 0.
        action : mapping
            ``do``, the name of the action, and its arguments.

        Raises
        ------
        CadalignError
            If the action is unknown or invalid.
        """
        with self.lock:
            state = self.photo_state(number)
            name = action.get("do")
            act = self._actions.get(name) if isinstance(name, str) else None
            if act is None:
                raise InputError(
                    f"{name!r} is not an action",
                    where="do",
                    fix=f"known are {', '.join(self._actions)}",
                )
            before = state.document
            outcome = act(state, action)
            if state.document is not before or name == "rename":
                self.save(state)
            return outcome

    def save(self, state: PhotoState) -> None:
        """Write the files of a photo and of the model; an error is kept for the page."""
        document = state.document
        ready = self.ready  # asked first: it may become so at any time
        state.fit_pending = not ready
        live, _ = self.live(state)
        # An alignment by assumptions is shown but not written: `cadalign fit` would refuse it.
        result = None if live.provisional else live.result
        used = frozenset[int]().union(*(other.document.keypoints for other in self.photos))
        try:
            # First the keypoints, which the observation names.
            write_keypoints(self.keypoints_path, self.registry, used, state.files.model)
            state.files.write(document, self.registry, state.intrinsics.to_write(document.focal))
            if ready:
                state.files.write_fit(result)
        except CadalignError as error:
            state.save_error = str(error)
        else:
            state.save_error = ""
            state.saved_at = time.time()

    def _place_uv(self, state: PhotoState, action: Mapping[str, Any]) -> Outcome:
        uv = self._uv(state, action)
        document, pair = state.document.place_uv(uv, _optional(action, "pair"))
        state.history.record(document)
        return Outcome(pair)

    def _place_keypoint(self, state: PhotoState, action: Mapping[str, Any]) -> Outcome:
        keypoint = _index(action, "keypoint")
        self.registry[keypoint]
        return self._place(state, keypoint, action)

    def _pick(self, state: PhotoState, action: Mapping[str, Any]) -> Outcome:
        """Place a model point by a ray, or the keypoint ``near`` the click if it is visible."""
        origin = self.model.from_display(as_numbers(action.get("origin"), 3, where="origin"))
        direction = as_numbers(action.get("direction"), 3, where="direction")
        near = _optional(action, "near")
        if near is not None and self.model.is_seen(origin, self.registry[near].xyz):
            return self._place(state, near, action)
        point = self.model.pick(origin, direction)
        if point is None:
            return Outcome(message="That click missed the model.")
        return self._place(state, self.registry.add(point), action)

    def _place_suggested(self, state: PhotoState, action: Mapping[str, Any]) -> Outcome:
        _, suggestion = self.live(state)
        if suggestion is None:
            raise InputError(
                "there is no suggested keypoint yet", where="suggestion", fix="place more pairs"
            )
        keypoint = suggestion.point.semantic_id
        return self._place(
            state,
            self.registry.add(suggestion.point) if keypoint is None else keypoint,
            action,
        )

    def _place(self, state: PhotoState, keypoint: int, action: Mapping[str, Any]) -> Outcome:
        document, pair = state.document.place_keypoint(keypoint, _optional(action, "pair"))
        state.history.record(document)
        return Outcome(pair)

    def _move(self, state: PhotoState, action: Mapping[str, Any]) -> Outcome:
        pair = _index(action, "pair")
        gesture = _optional(action, "gesture")
        state.history.record(
            state.document.move(pair, self._uv(state, action)),
            step=None if gesture is None else (pair, gesture),
        )
        return Outcome(pair)

    def _release(self, state: PhotoState, action: Mapping[str, Any]) -> Outcome:
        pair = _index(action, "pair")
        state.history.record(state.document.release_keypoint(pair))
        return Outcome(pair)

    def _delete(self, state: PhotoState, action: Mapping[str, Any]) -> Outcome:
        state.history.record(state.document.delete(_index(action, "pair")))
        return Outcome()

    def _rename(self, state: PhotoState, action: Mapping[str, Any]) -> Outcome:
        pair = state.document.pair(_index(action, "pair"))
        if pair.keypoint is None:
            raise InputError(
                "this pair has no model point yet", where="pair", fix="click on the model first"
            )
        self.registry.rename(pair.keypoint, as_text(action.get("name"), where="name"))
        return Outcome(pair.number)

    def _focal(self, state: PhotoState, action: Mapping[str, Any]) -> Outcome:
        known, pixels = action.get("known"), action.get("pixels")
        if not isinstance(known, bool):
            raise InputError(f"{known!r} is neither true nor false", where="known")
        if pixels is not None:
            (pixels,) = as_numbers([pixels], 1, where="pixels")
            low, high = (bound * state.photo.width for bound in _FOCAL_RANGE)
            if not low <= pixels <= high:
                raise InputError(
                    f"{pixels:g} px is no focal length of this photo",
                    where="pixels",
                    fix=f"give {low:.0f} to {high:.0f} px",
                )
        state.history.record(state.document.choose_focal(FocalChoice(known, pixels)))
        return Outcome()

    def _undo(self, state: PhotoState, action: Mapping[str, Any]) -> Outcome:
        return Outcome(message="" if state.history.undo() else "There is nothing to undo.")

    def _redo(self, state: PhotoState, action: Mapping[str, Any]) -> Outcome:
        return Outcome(message="" if state.history.redo() else "There is nothing to redo.")

    @staticmethod
    def _uv(state: PhotoState, action: Mapping[str, Any]) -> Pixel:
        u, v = as_numbers(action.get("uv"), 2, where="uv")
        if not state.intrinsics.camera.contains(np.array([[u, v]]))[0]:
            raise InputError(f"({u:.1f}, {v:.1f}) is outside the photo", where="uv")
        return u, v


def _index(action: Mapping[str, Any], name: str) -> int:
    return as_index(action.get(name), where=name)


def _optional(action: Mapping[str, Any], name: str) -> int | None:
    return None if action.get(name) is None else _index(action, name)
