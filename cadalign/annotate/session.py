"""Annotation session: the photos, their annotations, and the files of these."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.annotate.advice import warm_up_advice
from cadalign.annotate.alignment import LIKELY_STRETCH, LiveAlignment, align
from cadalign.annotate.choosing.choice import ModelChoice
from cadalign.annotate.document import FocalChoice, History, Pair, Priors
from cadalign.annotate.files import filled, known_pairs, write_keypoints
from cadalign.annotate.further import FurtherEvidence
from cadalign.annotate.history_file import history_path, write_history
from cadalign.annotate.keypoint_registry import KeypointRegistry
from cadalign.annotate.masks import draw_mask
from cadalign.annotate.model import ClickableModel
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.objects.deletions import Deletions
from cadalign.annotate.objects.joint import tells_something, views_in_order, with_other_views
from cadalign.annotate.objects.listing import shown_objects
from cadalign.annotate.objects.models import Models
from cadalign.annotate.objects.state import Live, PhotoState
from cadalign.annotate.photos import Intrinsics
from cadalign.annotate.shape_alignment import (
    JointEstimate,
    Known,
    LiveShape,
    align_shape,
    warm_up_joint,
)
from cadalign.annotate.suggestion import Suggestion, UncertainPose, suggest, suggest_of_shape
from cadalign.annotate.worklist import State, WorkList
from cadalign.errors import CadalignError, InputError
from cadalign.evaluation.simulation.problems import simulate_problem
from cadalign.io.images import write_image
from cadalign.io.observation import Observation
from cadalign.io.observed_image import ObservedImage

__all__ = ["Live", "PhotoState", "Session"]


@dataclass(eq=False)
class Session:
    """All state of an annotator; safe to use from several threads.

    Parameters
    ----------
    models : Models
    objects : list of lists of PhotoState
        The objects of each photo, those of its own observation first.
    before_saving : callable
        Raises a CadalignError where nothing may be written.
    worklist : WorkList
    shape : ObjectShape, optional
        The objects', if it is estimated.
    choice : ModelChoice, optional
        The library that objects' models are chosen from.
    ready : bool
        True once the solvers are compiled and loaded, so that a fit is instant.
    reserve : callable
        Keeps other annotators off an object's files; raises a CadalignError if one has them.
    """

    models: Models
    objects: list[list[PhotoState]]
    before_saving: Callable[[], None]
    worklist: WorkList
    shape: ObjectShape | None = None
    choice: ModelChoice | None = None
    ready: bool = False
    reserve: Callable[[Sequence[Path]], None] = lambda paths: None

    def __post_init__(self) -> None:
        self.lock = threading.RLock()
        self.deletions = Deletions()
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
            intrinsics = Intrinsics(problem.camera, calibrated=True)
            for known in (True, False):
                given = problem.points_3d, problem.points_2d, None, intrinsics
                for priors in (Priors(), Priors(LIKELY_STRETCH, intrinsics.likely_focal)):
                    align(*given, FocalChoice(known=known), priors)
            if self.shape is not None or any(self.is_joint(state) for state in self.states):
                warm_up_joint(problem.points_3d, problem.points_2d, problem.camera)
            else:
                warm_up_advice(problem)
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
        if slot is None:
            return next(iter(shown_objects(states)))
        if not 0 <= slot < len(states):
            raise InputError(
                f"there is no object {slot + 1} in this photo",
                where="object",
                fix="reload the page",
            )
        state = states[slot]
        return state if state in shown_objects(states) else next(iter(shown_objects(states)))

    def place_of(self, state: PhotoState) -> tuple[int, int]:
        """The number of a state's photo, and its own among the objects of the photo."""
        for number, states in enumerate(self.objects):
            if state in states:
                return number, states.index(state)
        raise LookupError(state.key)

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

    def live(self, state: PhotoState) -> tuple[Live, Suggestion | None]:
        """Compute the alignment and the next-best keypoint of the current annotation."""
        document = state.object_document
        if state.live is not None and state.live[0] is document:
            return state.live[1:]
        if not self.ready:
            return LiveAlignment.missing("Solvers and model are being prepared."), None
        try:
            live, suggestion = self._align(state)
        except CadalignError as error:  # of a mask that cannot be written or read
            live, suggestion = LiveAlignment.missing(f"No alignment: {error}."), None
        state.live = (document, live, suggestion)
        return live, suggestion

    def _align(self, state: PhotoState) -> tuple[Live, Suggestion | None]:
        document, registry = state.document, state.model.registry
        pairs = document.complete_pairs
        keypoints = [pair.keypoint for pair in pairs if pair.keypoint is not None]
        uv = np.array([pair.uv for pair in pairs], dtype=float).reshape(-1, 2)
        if self.is_joint(state):
            points = [registry[keypoint] for keypoint in keypoints]
            known, observation = self._known(state), self.observed(state)

            def estimated(observation: Observation) -> JointEstimate:
                owner = state.owner
                if owner.joint is None or owner.joint[0] is not owner.document:
                    mesh = state.model.cad.scene.mesh
                    owner.joint = owner.document, JointEstimate.of(known, mesh, observation)
                return owner.joint[1]

            wireframe = state.model.wireframe
            live = align_shape(known, wireframe, observation, points, uv, estimated=estimated)
            return live, self._suggest(state, live)
        sigma = filled(pair.sigma for pair in pairs)
        plain = align(
            registry.xyz(keypoints),
            uv,
            sigma,
            state.intrinsics,
            document.focal,
            document.priors,
        )
        estimate = UncertainPose.of(plain)
        if estimate is None:
            return plain, None
        return plain, suggest(state.model.cad, registry, document.keypoints, estimate)

    def is_joint(self, state: PhotoState) -> bool:
        """True if more than the stretched model and keypoints is estimated from or for a photo."""
        if self.shape is not None or state.lead is not None:
            return True
        pairs = state.document.complete_pairs
        return bool(pairs) and not self._observation(state, pairs).is_plain

    def _known(self, state: PhotoState) -> Known:
        """Prior knowledge of the object, before any pair."""
        shape, prior = self.shape, state.document.priors.stretch
        points = [point for _, point in state.model.registry]
        own = {} if shape is None else {shape.id_of(point): point for point in points}
        return Known(
            shape=shape,
            further=self.further(state),
            scale_prior_sigma=prior,
            anchors={label: point for label, point in own.items() if label is not None},
            **self._focal_of(state),
        )

    def _focal_of(self, state: PhotoState) -> dict[str, Any]:
        """The fields of `Known` about the focal lengths of an object's photos."""
        used = [view for view in state.all_views if view is state or self.tells(view)]
        unknown = [view for view in used if not view.document.focal.known]
        if unknown and self.estimates_focal(state):
            prior = state.owner.document.priors.focal
            return {"estimates_focal": True, "focal_prior": prior}
        names = ("" if view is state else view.photo.path.name for view in unknown)
        return {"assumed_focal": tuple(names)}

    def estimates_focal(self, state: PhotoState) -> bool:
        """True if the focal lengths of an object's photos are estimated.

        Not where that of some photo is known, or the photos' EXIF data differ: `cadalign.align`
        estimates those of all views, with one prior.
        """
        if state.document.focal.known:
            return False
        used = [view for view in state.all_views if view is state or self.tells(view)]
        stored = views_in_order(state.owner)
        cameras = [view.camera for view in stored if isinstance(view, ObservedImage)]
        if any(view.document.focal.known for view in used) or any(
            camera.focal_known for camera in cameras
        ):
            return False
        priors = [view.intrinsics.prior for view in used]
        known = [prior for prior in priors if prior is not None]
        return all(prior.is_like(known[0]) for prior in known)

    def observed(self, state: PhotoState) -> Observation | None:
        """The pairs that count, with the evidence beside them."""
        known = known_pairs(state.document, state.model.registry, self.shape)
        return self._observation(state, known) if known else None

    def _observation(self, state: PhotoState, pairs: Sequence[Pair]) -> Observation:
        registry, further = state.model.registry, self.further(state)
        return state.files.observation_of(pairs, registry, state.camera, {}, further)

    def _suggest(self, state: PhotoState, live: LiveShape) -> Suggestion | None:
        used, registry = state.document.keypoints, state.model.registry
        if self.shape is not None:
            return suggest_of_shape(live, self.shape, registry, used)
        result, camera = live.shown, live.camera
        if result is None or camera is None or live.place or result.covariance is None:
            return None
        if "x" in result.stretched_axes:
            return None  # of a size that is estimated, too, nothing is predicted
        estimate = UncertainPose(camera, live.alignment, result.covariance, live.sigma)
        return suggest(state.model.cad, registry, used, estimate)

    def further(self, state: PhotoState, *, to_write: bool = False) -> FurtherEvidence:
        """The evidence beside the pairs; a painted mask is written to its file.

        ``to_write`` leaves out focal lengths that are not known.
        """
        own = self._own_evidence(state)
        if state.lead is None and not state.views:
            return own

        def observed(view: PhotoState) -> ObservedImage:
            return self._observed_image(view, to_write=to_write)

        return with_other_views(state, own, observed)

    def _observed_image(self, state: PhotoState, *, to_write: bool = False) -> ObservedImage:
        registry, document = state.model.registry, state.document
        pairs = known_pairs(document, registry, self.shape)
        camera = state.intrinsics.to_write(document.focal) if to_write else state.camera
        image = state.files.image_of(pairs, registry, camera)
        return self._own_evidence(state).added_to_image(image)

    def tells(self, state: PhotoState) -> bool:
        """True if anything of a photo counts."""
        return tells_something(self._observed_image(state))

    def _own_evidence(self, state: PhotoState) -> FurtherEvidence:
        """The evidence of a photo beside its pairs; a painted mask is written to its file."""
        evidence = state.document.evidence
        drawing, drawn = evidence.mask, None
        if drawing is not None and drawing.strokes:
            drawn = state.mask_file(drawing.base)
            if state.drawn is None or state.drawn[:2] != (drawing, drawn):
                mask = draw_mask(drawing, state.photo.width, state.photo.height)
                if mask.any():
                    self.before_saving()
                    write_image(drawn, np.where(mask, 255, 0).astype(np.uint8))
                state.drawn = (drawing, drawn, bool(mask.any()))
            drawn = drawn if state.drawn[2] else None
        return evidence.added_to(state.further, state.camera, drawn)

    def save(self, state: PhotoState) -> None:
        """Write the files of an object and of its model; an error is kept for the page.

        Objects that could not be written before are written too.
        """
        self._write(state.owner)
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
            self.reserve((*state.files.written, state.model.keypoints_path))
            # First what a restart finds the other files' content in, if the process is killed.
            assert isinstance(state.history, History)
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

    def _write_object(self, state: PhotoState, *, with_fit: bool) -> None:
        """Write keypoints, observation and alignment of an object; raises DataError on failure.

        ``state`` is that in its first photo.
        """
        document, model = state.document, state.model
        live, _ = self.live(state)
        # An alignment by assumptions is shown but not written: `cadalign fit` would refuse it.
        result = None if live.provisional else live.shown
        used = frozenset[int]().union(
            *(other.document.keypoints for other in self.states if other.model is model)
        )
        # First the keypoints, which the observation names.
        write_keypoints(model.keypoints_path, model.registry, used, model.path)
        camera = state.intrinsics.to_write(document.focal)
        priors = document.priors.fit_options(state.intrinsics.prior)
        state.unfinished = state.files.write(
            document,
            model.registry,
            camera,
            {**priors, **live.fit_options},
            self.further(state, to_write=True),
            self.shape,
            self._unfinished_views(state),
            unfinished=state.unfinished,
        )
        if with_fit:
            state.files.write_fit(result)

    def _unfinished_views(self, owner: PhotoState) -> list[dict[str, Any]]:
        """The object's further photos as far as the observation lacks them or their pairs."""
        unfinished = []
        for view in owner.all_views[1:]:
            camera = view.intrinsics.to_write(view.document.focal)
            written = view.files.unfinished_view(
                view.document, view.model.registry, camera, self.shape
            )
            if written["pairs"] or not self.tells(view):
                unfinished.append(written)
        return unfinished
