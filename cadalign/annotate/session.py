"""Annotation session: the objects of its photos, their live alignments, and their files."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cadalign.annotate.document import history_path, write_history
from cadalign.annotate.estimate import LiveAlignment, warm_up
from cadalign.annotate.files import AnnotationFiles
from cadalign.annotate.library import ModelChoice
from cadalign.annotate.live import live_alignment, missing_text
from cadalign.annotate.models import Models, ObjectShape
from cadalign.annotate.objects import AnnotatedObject, PhotoState, shown_objects
from cadalign.annotate.photos import State, WorkList
from cadalign.annotate.problem import Known
from cadalign.annotate.suggestion import Suggestion, suggest
from cadalign.errors import CadalignError, DegenerateError, InputError
from cadalign.evaluation.simulation import simulate_problem
from cadalign.io.images import read_photo


@dataclass(eq=False)
class Session:
    """All state of an annotator; safe to use from several threads."""

    models: Models
    worklist: WorkList
    shape: ObjectShape = field(default_factory=ObjectShape)
    choice: ModelChoice | None = None  # the library that objects' models are chosen from
    before_saving: Callable[[], None] = lambda: None
    """Raises a CadalignError where nothing may be written."""
    reserve: Callable[[Sequence[Path]], None] = lambda paths: None
    """Keeps other annotators off an object's files; raises a CadalignError if one has them."""
    objects: list[list[PhotoState]] = field(default_factory=list)
    """The objects of each photo, its own observation's first."""
    ready: bool = False  # True once the solvers are compiled and loaded, so that a fit is instant
    deleted: list[AnnotatedObject] = field(default_factory=list)  # in that order
    just_deleted: set[int] = field(default_factory=set)  # photos where this was the last change

    def __post_init__(self) -> None:
        self.lock = threading.RLock()
        self.ended = threading.Event()
        self._pixels: tuple[Path, npt.NDArray[np.uint8]] | None = None

    @property
    def photos(self) -> list[PhotoState]:
        """The first object of each photo."""
        return [states[0] for states in self.objects]

    @property
    def states(self) -> list[PhotoState]:
        """All objects in all photos."""
        return [state for states in self.objects for state in states]

    @property
    def owners(self) -> list[AnnotatedObject]:
        """The objects, each once."""
        return [state.owner for state in self.states if state.is_first]

    def warm_up(self) -> None:
        """Compile or load the solvers, and prepare the models, until the session has ``ended``."""
        try:
            marked = (state for state in self.states if state.document.complete_pairs)
            joint = self.shape.is_estimated or not all(
                state.observation().is_plain for state in marked
            )
            steps = [partial(_load_solvers, joint=joint)]
            steps += [partial(model.prepare) for model in self.models.opened]
            for step in steps:
                if self.ended.is_set():
                    return
                step()
        finally:  # an error here occurs again, and is reported, when the user aligns
            self.ready = True
            with self.lock:
                for owner in self.owners:
                    if owner.fit_pending and not self.ended.is_set():
                        self.save(owner)

    def photo_state(self, number: int, slot: int | None = None) -> PhotoState:
        """An object of the photo of a number, both counted from 0; by default the first shown."""
        if not 0 <= number < len(self.objects):
            raise InputError(f"there is no photo {number + 1}", where="image")
        states = self.objects[number]
        if slot is not None and not 0 <= slot < len(states):
            what = f"there is no object {slot + 1} in this photo"
            raise InputError(what, where="object", fix="reload the page")
        shown = shown_objects(states)
        return states[slot] if slot is not None and states[slot] in shown else shown[0]

    def last_deleted(self, photo: int, *, at_once: bool = False) -> PhotoState | None:
        """The object of a photo that was deleted last and still is, while the program runs.

        ``at_once`` if nothing in the photo was changed after it.
        """
        if at_once and photo not in self.just_deleted:
            return None
        gone = (each.first for each in reversed(self.deleted) if each.document.is_gone)
        return next((o for o in gone if photo in (v.place[0] for v in o.owner.states)), None)

    def note_deletion(self, owner: AnnotatedObject) -> None:
        """Remember an object that was deleted."""
        self.deleted.append(owner)
        self.just_deleted |= {view.place[0] for view in owner.states}

    def work_state(self, state: PhotoState) -> State:
        """State of the annotation of a photo."""
        shown = shown_objects(self.objects[state.place[0]])
        pairs = sum(len(each.document.pairs) for each in shown)
        return self.worklist.state(state.photo.path, pairs=pairs)

    def pixels(self, state: PhotoState) -> npt.NDArray[np.uint8]:
        """The upright photo (h, w, 3); the last one asked for is kept."""
        path = state.photo.path
        if self._pixels is None or self._pixels[0] != path:
            self._pixels = (path, read_photo(path))
        return self._pixels[1]

    def live(self, state: PhotoState) -> tuple[LiveAlignment, Suggestion | None]:
        """Compute the alignment and the next keypoint of the current annotation."""
        if not self.ready:
            return LiveAlignment(message="Solvers and model are being prepared."), None
        others = self._others_focal(state)
        key = (state.owner.document, others)
        if state.live is not None and state.live[0] == key:
            return state.live[1:]
        suggestion = None
        try:
            live = self._align(state, others)
            used = state.document.keypoints
            suggestion = suggest(live, state.model.cad, state.model.registry, used, self.shape)
        except DegenerateError as error:
            live = LiveAlignment(message=f"No alignment yet: {error.what}.")
        except CadalignError as error:  # also of a mask that cannot be written or read
            live = LiveAlignment(message=f"No alignment: {error}.")
        state.live = (key, live, suggestion)
        return live, suggestion

    def _align(self, state: PhotoState, others: Mapping[str, LiveAlignment]) -> LiveAlignment:
        missing = self._missing(state)
        if missing:
            return LiveAlignment(message=missing)
        estimate = self._alone(state).beside(state.label, others)
        pairs = state.document.complete_pairs
        points = state.model.points_of(pairs)
        uv = np.array([pair.uv for pair in pairs], dtype=float).reshape(-1, 2)
        known, lines = self._known(state), state.model.wireframe
        return live_alignment(estimate, known, lines, *state.observed(), points, uv)

    def _missing(self, state: PhotoState) -> str:
        """Say what the first alignment needs; empty if nothing."""
        observation, pairs = state.observation(), state.document.complete_pairs
        is_single = len(observation.views) == 1
        by_mask = observation.evidence.mask is not None and not self.shape.is_estimated
        by_photo = observation.init is not None and "image" in observation.fit_options
        if is_single and (by_mask or (by_photo and self.shape.has_mesh)):
            return ""
        return missing_text(
            self.shape.known(state.model.points_of(pairs)),
            self.shape,
            is_plain=observation.is_plain and not self.shape.is_estimated,
            has_others=not is_single,
        )

    def _alone(self, state: PhotoState) -> LiveAlignment:
        """The estimate from all photos of the object, apart from others; raises a CadalignError."""
        owner, document = state.owner, state.owner.document
        if owner.alone is None or owner.alone[0] is not document:
            try:
                found = LiveAlignment.of(self._known(state), state.observation())
                owner.alone = document, found
            except CadalignError as error:
                owner.alone = document, error
        kept = owner.alone[1]
        if isinstance(kept, CadalignError):
            raise kept
        return kept

    def _others_focal(self, state: PhotoState) -> dict[str, LiveAlignment]:
        """Estimates of the photo's other objects that bear on its focal length, by their labels.

        Each is of the object alone, so that they depend neither on each other nor on the order.
        """
        others = state.owner.first.beside
        if not (others and state.estimates_focal):
            return {}
        found = {}
        for each in others:
            with suppress(CadalignError):
                if each.estimates_focal and not self._missing(each):
                    found[each.label] = self._alone(each)
        return {label: estimate for label, estimate in found.items() if estimate.tells_focal}

    def _known(self, state: PhotoState) -> Known:
        shape, owner = self.shape, state.owner
        points = [point for _, point in state.model.registry]
        own = {shape.id_of(point): point for point in points}
        unknown = [view for view in state.used_views if not view.document.focal.known]
        is_estimated = bool(unknown) and state.estimates_focal
        names = ("" if view is state else view.photo.path.name for view in unknown)
        return Known(
            shape,
            state.model.cad.scene.mesh,
            anchors={label: point for label, point in own.items() if label is not None},
            assumed_focal=() if is_estimated else tuple(names),
            estimates_focal=is_estimated,
            focal_prior=owner.document.priors.focal,
            by_mask=owner.estimates_by_mask,
        )

    def save(self, owner: AnnotatedObject) -> None:
        """Write the files of an object and of its model; an error is kept for the page.

        Objects that could not be written before are written too.
        """
        self._write(owner)
        self._write_others(owner)
        if not owner.save_error:
            for other in self.unsaved:
                self._write(other)

    @property
    def unsaved(self) -> list[AnnotatedObject]:
        """Objects whose last change could not be written."""
        return [owner for owner in self.owners if owner.save_error]

    def save_unsaved(self, folder: Path | None = None) -> None:
        """Write the objects that could not be written, if given into another folder from now on."""
        with self.lock:
            unsaved = self.unsaved
            if folder is not None:
                self.before_saving = lambda: None
                self.reserve = lambda paths: None
                for model in self.models.opened:
                    model.keypoints_path = folder / model.keypoints_path.name
                for owner in unsaved:
                    owner.files = AnnotationFiles(folder / owner.files.observation.name)
            for owner in unsaved:
                self._write(owner)

    def _write(self, owner: AnnotatedObject) -> None:
        """Write the files of an object."""
        ready = self.ready  # asked first: it may become so at any time
        owner.fit_pending = not ready
        try:
            self.before_saving()
            self.reserve((owner.files.observation, owner.model.keypoints_path))
            # First what a restart finds the observation's content in, if the process is killed.
            path = history_path(owner.files.observation)
            write_history(path, owner.history, owner.model.registry)
            if owner.document.is_gone:
                owner.files.remove()
            else:
                self._write_object(owner)
                if ready:
                    self._write_fit(owner)
        except CadalignError as error:
            owner.save_error = str(error)
        else:
            owner.save_error = ""
            owner.saved_at = time.time()

    def _write_others(self, owner: AnnotatedObject) -> None:
        """Write the alignments of saved objects that share the focal length of a changed one."""
        for other in (each.owner for view in owner.states for each in view.beside):
            before = other.first.live
            if not self.ready or other.saved_at is None or other.save_error:
                continue
            self.live(other.first)
            if other.first.live is not before:
                try:
                    self._write_fit(other)
                except CadalignError as error:
                    other.save_error = str(error)

    def _write_object(self, owner: AnnotatedObject) -> None:
        state = owner.first
        live, _ = self.live(state)
        used = frozenset[int]().union(
            *(other.document.keypoints for other in self.states if other.model is owner.model)
        )
        # First the keypoints, which the observation names.
        owner.model.write_keypoints(used)
        owner.files.write(state.observation(fit_options=live.fit_options, to_write=True))

    def _write_fit(self, owner: AnnotatedObject) -> None:
        """Write the alignment of an object; raises DataError on failure.

        An alignment by assumptions is shown but not written: `cadalign fit` would refuse it.
        """
        live, _ = self.live(owner.first)
        owner.files.write_fit(None if live.provisional else live.result)


@cache
def _load_solvers(*, joint: bool) -> None:
    """Compile or load the solvers, once in a process, by aligning a synthetic problem."""
    problem = simulate_problem(np.random.default_rng(0), points=8, noise_px=1.0)
    points, pixels, camera = problem.points_3d, problem.points_2d, problem.camera
    warm_up(points, pixels, camera, joint=joint)
