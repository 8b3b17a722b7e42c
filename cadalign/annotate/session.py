"""Annotation session: the photos, their annotations, and the actions on them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.annotate.actions import ACTIONS, RENAMING, Outcome
from cadalign.annotate.advice import warm_up_advice
from cadalign.annotate.alignment import LiveAlignment, align
from cadalign.annotate.document import Document, FocalChoice, History
from cadalign.annotate.files import AnnotationFiles, filled, known_pairs, write_keypoints
from cadalign.annotate.keypoint_registry import KeypointRegistry
from cadalign.annotate.model import CadModel
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.photos import Intrinsics, Photo
from cadalign.annotate.shape_alignment import LiveShape, align_shape, warm_up_joint
from cadalign.annotate.suggestion import Suggestion, suggest, suggest_of_shape
from cadalign.annotate.wireframe import Wireframe
from cadalign.errors import CadalignError, InputError, quote
from cadalign.evaluation.simulation.problems import simulate_problem
from cadalign.io.documents import convert

Live = LiveAlignment | LiveShape
"""Alignment of the pairs placed so far, of the stretched model or of the object's own shape."""


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
    _live: tuple[Document, Live, Suggestion | None] | None = field(default=None, repr=False)

    @property
    def document(self) -> Document:
        """The current annotation."""
        return self.history.document


@dataclass(eq=False)
class Session:
    """All state of an annotator; safe to use from several threads."""

    model: CadModel
    registry: KeypointRegistry
    photos: list[PhotoState]
    keypoints_path: Path  # file to which the model's keypoints are written
    before_saving: Callable[[], None]  # raises a CadalignError where nothing may be written
    shape: ObjectShape | None = None  # the object's, if it is estimated
    ready: bool = False  # True once the solvers are compiled and loaded, so that a fit is instant

    def __post_init__(self) -> None:
        self.wireframe = Wireframe.of_model(self.model)
        self.lock = threading.RLock()

    def warm_up(self) -> None:
        """Compile or load the solvers by aligning a synthetic problem, and prepare the model."""
        try:
            problem = simulate_problem(np.random.default_rng(0), points=8, noise_px=1.0)
            intrinsics = Intrinsics(problem.camera, calibrated=True)
            for known in (True, False):
                align(
                    problem.points_3d, problem.points_2d, None, intrinsics, FocalChoice(known=known)
                )
            if self.shape is not None:
                warm_up_joint(problem.points_3d, problem.points_2d, problem.camera)
            else:
                warm_up_advice(problem)
            # Takes seconds on a model of millions of faces, which the first click would wait for.
            _ = self.model.scene.caster, self.model.samples
            if self.shape is None:
                _ = self.model.light_scene.caster
        finally:  # an error here occurs again, and is reported, when the user aligns
            self.ready = True
            with self.lock:
                for state in self.photos:
                    if state.fit_pending:
                        self.save(state)

    def photo_state(self, number: int) -> PhotoState:
        """The photo of a number, counted from 0."""
        if not 0 <= number < len(self.photos):
            raise InputError(f"there is no photo {number + 1}", where="image")
        return self.photos[number]

    def live(self, state: PhotoState) -> tuple[Live, Suggestion | None]:
        """Compute the alignment and the next-best keypoint of the current annotation."""
        document = state.document
        if state._live is not None and state._live[0] is document:
            return state._live[1:]
        if not self.ready:
            return LiveAlignment.missing("Solvers and model are being prepared."), None
        live, suggestion = self._align(state)
        state._live = (document, live, suggestion)
        return live, suggestion

    def _align(self, state: PhotoState) -> tuple[Live, Suggestion | None]:
        document, registry = state.document, self.registry
        pairs = document.complete_pairs
        keypoints = [pair.keypoint for pair in pairs if pair.keypoint is not None]
        uv = np.array([pair.uv for pair in pairs], dtype=float).reshape(-1, 2)
        if self.shape is not None:
            known = known_pairs(document, registry, self.shape)
            camera = state.intrinsics.with_focal(document.focal)
            own = {self.shape.id_of(point): point for _, point in registry}
            live = align_shape(
                self.shape,
                self.wireframe,
                state.files.observation_of(known, registry, camera, {}) if known else None,
                [registry[keypoint] for keypoint in keypoints],
                uv,
                anchors={label: point for label, point in own.items() if label is not None},
                assumed_focal=not document.focal.known,
            )
            return live, suggest_of_shape(live, self.shape, registry, document.keypoints)
        sigma = filled(pair.sigma for pair in pairs)
        plain = align(registry.xyz(keypoints), uv, sigma, state.intrinsics, document.focal)
        return plain, suggest(self.model, registry, document.keypoints, plain)

    def act(self, number: int, action: Mapping[str, Any]) -> Outcome:
        """Do an action, its name ``do`` and its arguments, on a photo and save its changes."""
        with self.lock:
            state = self.photo_state(number)
            name = action.get("do")
            kind = ACTIONS.get(name) if isinstance(name, str) else None
            if kind is None:
                raise InputError(
                    f"{quote(name)} is not an action",
                    where="do",
                    fix=f"known are {', '.join(ACTIONS)}",
                )
            before = state.document
            outcome: Outcome = convert(action, kind).apply(self, state)
            if state.document is not before or name in RENAMING:
                self.save(state)
            return outcome

    def save(self, state: PhotoState) -> None:
        """Write the files of a photo and of the model; an error is kept for the page.

        Photos that could not be written before are written too.
        """
        self._write(state)
        if not state.save_error:
            for other in self.unsaved:
                self._write(other)

    @property
    def unsaved(self) -> list[PhotoState]:
        """Photos whose last change could not be written."""
        return [state for state in self.photos if state.save_error]

    def save_unsaved(self, folder: Path | None = None) -> None:
        """Write the photos that could not be written, if given into another folder from now on."""
        with self.lock:
            unsaved = self.unsaved
            if folder is not None:
                self.before_saving = lambda: None
                self.keypoints_path = folder / self.keypoints_path.name
                for state in unsaved:
                    path = folder / state.files.observation.name
                    state.files = replace(state.files, observation=path)
            for state in unsaved:
                self._write(state)

    def _write(self, state: PhotoState) -> None:
        document = state.document
        ready = self.ready  # asked first: it may become so at any time
        state.fit_pending = not ready
        live, _ = self.live(state)
        # An alignment by assumptions is shown but not written: `cadalign fit` would refuse it.
        result = None if live.provisional else live.shown
        used = frozenset[int]().union(*(other.document.keypoints for other in self.photos))
        try:
            self.before_saving()
            # First the keypoints, which the observation names.
            write_keypoints(self.keypoints_path, self.registry, used, state.files.model)
            camera = state.intrinsics.to_write(document.focal)
            state.files.write(document, self.registry, camera, live.fit_options, self.shape)
            if ready:
                state.files.write_fit(result)
        except CadalignError as error:
            state.save_error = str(error)
        else:
            state.save_error = ""
            state.saved_at = time.time()
