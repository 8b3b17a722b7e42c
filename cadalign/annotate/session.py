"""Annotation session: the photos, their annotations, and the files of these."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cadalign.annotate.estimate import Known, LiveEstimate, warm_up
from cadalign.annotate.history import history_path, write_history
from cadalign.annotate.library import ModelChoice
from cadalign.annotate.live import LiveAlignment, known_points, live_alignment, missing_text
from cadalign.annotate.model import ClickableModel
from cadalign.annotate.models import KeypointRegistry, Models, Proposal
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.objects import Deletions, Observer, PhotoState, label_of, shown_objects
from cadalign.annotate.photos import State, WorkList
from cadalign.annotate.suggestion import Suggestion, suggest, warm_up_advice
from cadalign.annotate.track import FrameTrack
from cadalign.errors import CadalignError, DegenerateError, InputError
from cadalign.estimation.view import View
from cadalign.evaluation.simulation.problems import simulate_problem
from cadalign.io.evidence import ObservedImage
from cadalign.io.observation import Observation


@dataclass(frozen=True)
class ActionOutcome:
    """Outcome of an action beside the changed document, for the user."""

    selected: int | None = None  # number of the pair that was placed or changed
    message: str = ""  # such as that the click missed the model
    shown: PhotoState | None = None  # the object and photo to go on with, if not the same


@dataclass(eq=False)
class Session:
    """All state of an annotator; safe to use from several threads."""

    models: Models
    objects: list[list[PhotoState]]  # the objects of each photo, its own observation's first
    before_saving: Callable[[], None]  # raises a CadalignError where nothing may be written
    worklist: WorkList
    shape: ObjectShape | None = None  # the objects', if it is estimated
    choice: ModelChoice | None = None  # the library that objects' models are chosen from
    ready: bool = False  # True once the solvers are compiled and loaded, so that a fit is instant
    reserve: Callable[[Sequence[Path]], None] = lambda paths: None
    """Keeps other annotators off an object's files; raises a CadalignError if one has them."""
    track: FrameTrack | None = None  # where the photos are frames of one video

    def __post_init__(self) -> None:
        self.lock = threading.RLock()
        self.deletions = Deletions()
        self.observer = Observer(self.shape, lambda: self.before_saving())
        self._pixels: tuple[Path, npt.NDArray[np.uint8]] | None = None

    @property
    def model(self) -> ClickableModel:
        """The first model."""
        return self.models[0].cad

    @property
    def registry(self) -> KeypointRegistry:
        """The keypoints of the first model."""
        return self.models[0].registry

    @property
    def keypoints_path(self) -> Path:
        """The file to which the first model's keypoints are written."""
        return self.models[0].keypoints_path

    @property
    def photos(self) -> list[PhotoState]:
        """The first object of each photo."""
        return [states[0] for states in self.objects]

    @property
    def states(self) -> list[PhotoState]:
        """All objects in all photos."""
        return [state for states in self.objects for state in states]

    def warm_up(self) -> None:
        """Compile or load the solvers by aligning a synthetic problem, and prepare the model."""
        try:
            problem = simulate_problem(np.random.default_rng(0), points=8, noise_px=1.0)
            points, pixels, camera = problem.points_3d, problem.points_2d, problem.camera
            marked = (state for state in self.states if state.document.complete_pairs)
            joint = self.shape is not None or not all(
                self.observed(state)[0].is_plain for state in marked
            )
            warm_up(points, pixels, camera, joint=joint)
            if not joint:
                warm_up_advice(points, View(camera, pixels), problem.alignment)
            for model in self.models.opened:
                model.prepare(has_shape=self.shape is not None)
        finally:  # an error here occurs again, and is reported, when the user aligns
            self.ready = True
            with self.lock:
                for state in self.states:
                    if state.fit_pending:
                        self.save(state)

    def photo_state(self, number: int, slot: int | None = None) -> PhotoState:
        """An object of the photo of a number, both counted from 0; by default the first shown."""
        if not 0 <= number < len(self.objects):
            raise InputError(f"there is no photo {number + 1}", where="image")
        states = self.objects[number]
        if slot is not None and not 0 <= slot < len(states):
            raise InputError(
                f"there is no object {slot + 1} in this photo",
                where="object",
                fix="reload the page",
            )
        shown = shown_objects(states)
        return states[slot] if slot is not None and states[slot] in shown else shown[0]

    def place_of(self, state: PhotoState) -> tuple[int, int]:
        """The number of a state's photo, and its own among the objects of the photo."""
        for number, states in enumerate(self.objects):
            if state in states:
                return number, states.index(state)
        raise LookupError(state.key)

    def proposals(self, state: PhotoState) -> tuple[Proposal, ...]:
        """Keypoints of a detector, and of the other frames, that could be taken."""
        number, slot = self.place_of(state)
        if self.track is None or slot:
            return state.proposals
        return (*state.proposals, *self.track.proposals(self, number))

    def work_state(self, state: PhotoState) -> State:
        """State of the annotation of a photo."""
        number, _ = self.place_of(state)
        pairs = sum(len(each.document.pairs) for each in shown_objects(self.objects[number]))
        return self.worklist.state(state.photo.path.name, pairs=pairs)

    def pixels(self, state: PhotoState) -> npt.NDArray[np.uint8]:
        """The upright photo (h, w, 3); the last one asked for is kept."""
        path = state.photo.path
        if self._pixels is None or self._pixels[0] != path:
            self._pixels = (path, state.photo.pixels())
        return self._pixels[1]

    def live(self, state: PhotoState) -> tuple[LiveAlignment, Suggestion | None]:
        """Compute the alignment and the next-best keypoint of the current annotation."""
        if not self.ready:
            return LiveAlignment(message="Solvers and model are being prepared."), None
        others = self._others_focal(state)
        key = (state.history.document, others)
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

    def _align(self, state: PhotoState, others: Mapping[str, LiveEstimate]) -> LiveAlignment:
        """The alignment with all photos of the object, as this one shows it."""
        missing = self._missing(state)
        if missing:
            return LiveAlignment(message=missing)
        estimate = self._alone(state).beside(label_of(state), others)
        pairs = state.document.complete_pairs
        points = [state.model.registry[pair.keypoint or 0] for pair in pairs]
        uv = np.array([pair.uv for pair in pairs], dtype=float).reshape(-1, 2)
        known, lines = self._known(state), state.model.wireframe
        return live_alignment(estimate, known, lines, *self.observed(state), points, uv)

    def _missing(self, state: PhotoState) -> str:
        """Say what the first alignment needs; empty if nothing."""
        observation, _ = self.observed(state)
        pairs = state.document.complete_pairs
        views = observation.views
        is_enough = observation.evidence.mask is not None or (
            observation.init is not None and "image" in observation.fit_options
        )
        if self.shape is None and len(views) == 1 and is_enough:
            return ""
        return missing_text(
            known_points(self.shape, [state.model.registry[pair.keypoint or 0] for pair in pairs]),
            self.shape,
            is_plain=observation.is_plain and self.shape is None,
            has_others=len(views) > 1,
        )

    def _alone(self, state: PhotoState) -> LiveEstimate:
        """The estimate from all photos of the object, apart from others; raises a CadalignError."""
        owner, document = state.owner, state.history.document
        if owner.estimate is None or owner.estimate[0] is not document:
            try:
                estimate = LiveEstimate.of(self._known(state), self.observed(state)[0])
            except CadalignError as error:
                owner.estimate = document, error
            else:
                owner.estimate = document, estimate
        found = owner.estimate[1]
        if isinstance(found, CadalignError):
            raise found
        return found

    def _others_focal(self, state: PhotoState) -> dict[str, LiveEstimate]:
        """Estimates of the photo's other objects that tell of its focal length, by their labels.

        Each is of the object alone, so that they depend neither on each other nor on the order.
        """
        others = self._beside(state.owner)
        if not (others and self.estimates_focal(state)):
            return {}
        found = {}
        for each in others:
            with suppress(CadalignError):
                if self.estimates_focal(each) and not self._missing(each):
                    found[label_of(each)] = self._alone(each)
        return {label: estimate for label, estimate in found.items() if estimate.tells_focal}

    def _beside(self, state: PhotoState) -> list[PhotoState]:
        """The other objects of a photo of the object."""
        number, _ = self.place_of(state)
        shown = shown_objects(self.objects[number])
        return [each for each in shown if each.owner is not state.owner]

    def observed(self, state: PhotoState) -> tuple[Observation, int]:
        """The pairs that count with the evidence beside them, and the photo's number in it."""
        observation = self.observer.observation(state)
        images = [view.image for view in observation.views]
        return observation, images.index(state.files.image)

    def _known(self, state: PhotoState) -> Known:
        """Knowledge of the object beside its observation."""
        shape, owner = self.shape, state.owner
        points = [point for _, point in state.model.registry]
        own = {} if shape is None else {shape.id_of(point): point for point in points}
        used = self._used_views(state)
        unknown = [view for view in used if not view.document.focal.known]
        is_estimated = bool(unknown) and self.estimates_focal(state)
        names = ("" if view is state else view.photo.path.name for view in unknown)
        return Known(
            shape,
            state.model.cad.scene.mesh,
            stretch=state.document.priors.stretch,
            sigma=owner.further.sigma,
            anchors={label: point for label, point in own.items() if label is not None},
            assumed_focal=() if is_estimated else tuple(names),
            estimates_focal=is_estimated,
            focal_prior=owner.document.priors.focal,
            uses_photos=owner.document.evidence.photo,
        )

    def _used_views(self, state: PhotoState) -> list[PhotoState]:
        """The object's photos that count, this one among them."""
        return [view for view in state.all_views if view is state or self.observer.counts(view)]

    def estimates_focal(self, state: PhotoState) -> bool:
        """True if the focal lengths of an object's photos are estimated.

        Not where that of some photo is known, or the photos' EXIF data differ: `cadalign.align`
        estimates those of all views, with one prior.
        """
        used, stored = self._used_views(state), self.observer.views_in_order(state.owner)
        if state.document.focal.known or any(view.document.focal.known for view in used):
            return False
        if any(isinstance(view, ObservedImage) and view.camera.focal_known for view in stored):
            return False
        priors = [view.intrinsics.prior for view in used]
        known = [prior for prior in priors if prior is not None]
        return all(prior.is_like(known[0]) for prior in known)

    def save(self, state: PhotoState) -> None:
        """Write the files of an object and of its model; an error is kept for the page.

        Objects that could not be written before are written too.
        """
        self._write(state.owner)
        self._write_others(state.owner)
        if not state.owner.save_error:
            for other in self.unsaved:
                self._write(other)

    @property
    def unsaved(self) -> list[PhotoState]:
        """Objects whose last change could not be written."""
        return [state for state in self.states if state.save_error]

    def save_unsaved(self, folder: Path | None = None) -> None:
        """Write the objects that could not be written, if given into another folder from now on."""
        with self.lock:
            unsaved = self.unsaved
            if folder is not None:
                self.before_saving = lambda: None
                self.reserve = lambda paths: None
                for model in self.models.opened:
                    model.keypoints_path = folder / model.keypoints_path.name
                for state in unsaved:
                    path = folder / state.files.observation.name
                    for each in (state, *state.views):
                        each.files = replace(each.files, observation=path)
            for state in unsaved:
                self._write(state)

    def _write(self, state: PhotoState) -> None:
        """Write the files of an object, of which this is the state in its first photo."""
        ready = self.ready  # asked first: it may become so at any time
        state.fit_pending = not ready
        try:
            self.before_saving()
            self.reserve((state.files.observation, state.model.keypoints_path))
            # First what a restart finds the observation's content in, if the process is killed.
            path = history_path(state.files.observation)
            write_history(path, state.history, state.model.registry)
            if state.document.is_gone:
                state.files.remove()
            else:
                self._write_object(state, with_fit=ready)
        except CadalignError as error:
            state.save_error = str(error)
        else:
            state.save_error = ""
            state.saved_at = time.time()

    def _write_others(self, owner: PhotoState) -> None:
        """Write the alignments of saved objects that share the focal length of a changed one."""
        for view in (owner, *owner.views):
            for other in (each.owner for each in self._beside(view)):
                before = other.live
                if not self.ready or other.saved_at is None or other.save_error:
                    continue
                self.live(other)
                if other.live is not before:
                    try:
                        self._write_fit(other)
                    except CadalignError as error:
                        other.save_error = str(error)

    def _write_object(self, state: PhotoState, *, with_fit: bool) -> None:
        """Write keypoints, observation and alignment of an object; raises DataError on failure."""
        live, _ = self.live(state)
        used = frozenset[int]().union(
            *(other.document.keypoints for other in self.states if other.model is state.model)
        )
        # First the keypoints, which the observation names.
        state.model.write_keypoints(used)
        stored = {} if state.further.sigma is None else {"sigma": state.further.sigma}
        priors = state.document.priors.fit_options(state.intrinsics.likely_focal)
        options = {**stored, **priors, **live.fit_options}
        state.files.write(self.observer.observation(state, fit_options=options, to_write=True))
        if with_fit:
            self._write_fit(state)

    def _write_fit(self, state: PhotoState) -> None:
        """Write the alignment of an object; raises DataError on failure.

        An alignment by assumptions is shown but not written: `cadalign fit` would refuse it.
        """
        live, _ = self.live(state)
        state.files.write_fit(None if live.provisional else live.result)
