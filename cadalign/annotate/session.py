"""Annotation session: its annotations, their live alignments, and their files."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cadalign.annotate.annotation import Annotation
from cadalign.annotate.files import AnnotationFiles
from cadalign.annotate.live import LiveAlignment, live_alignment, missing_text
from cadalign.annotate.models import ObjectShape, OpenedModel
from cadalign.annotate.problem import Known, warm_up
from cadalign.annotate.suggestion import Suggestion, suggest
from cadalign.errors import CadalignError, DegenerateError, InputError
from cadalign.evaluation.simulation import simulate_problem
from cadalign.io.images import read_photo


@dataclass(eq=False)
class Session:
    """All state of an annotator; safe to use from several threads."""

    model: OpenedModel
    shape: ObjectShape = field(default_factory=ObjectShape)
    photos: list[Annotation] = field(default_factory=list)
    ready: bool = False  # True once the solvers are compiled and loaded, so that a fit is instant

    def __post_init__(self) -> None:
        self.lock = threading.RLock()
        self.ended = threading.Event()
        self._pixels: tuple[Path, npt.NDArray[np.uint8]] | None = None

    def warm_up(self) -> None:
        """Compile or load the solvers, and prepare the model, until the session has ``ended``."""
        try:
            marked = (each for each in self.photos if each.document.complete_pairs)
            joint = self.shape.is_estimated or not all(
                each.observation().is_plain for each in marked
            )
            for step in (partial(_load_solvers, joint=joint), self.model.prepare):
                if self.ended.is_set():
                    return
                step()
        finally:  # an error here occurs again, and is reported, when the user aligns
            self.ready = True
            with self.lock:
                for each in self.photos:
                    if each.fit_pending and not self.ended.is_set():
                        self.save(each)

    def annotation(self, number: int) -> Annotation:
        """The annotation of a number, counted from 0."""
        if not 0 <= number < len(self.photos):
            raise InputError(f"there is no photo {number + 1}", where="image")
        return self.photos[number]

    def pixels(self, annotation: Annotation) -> npt.NDArray[np.uint8]:
        """The upright photo (h, w, 3); the last one asked for is kept."""
        path = annotation.photo.path
        if self._pixels is None or self._pixels[0] != path:
            self._pixels = (path, read_photo(path))
        return self._pixels[1]

    def live(self, annotation: Annotation) -> tuple[LiveAlignment, Suggestion | None]:
        """Compute the alignment and the next keypoint of the current annotation."""
        if not self.ready:
            return LiveAlignment(message="Solvers and model are being prepared."), None
        document, model = annotation.document, self.model
        if annotation.live is not None and annotation.live[0] is document:
            return annotation.live[1:]
        suggestion = None
        try:
            live = self._align(annotation)
            suggestion = suggest(live, model.registry, document.keypoints, self.shape)
        except DegenerateError as error:
            live = LiveAlignment(message=f"No alignment yet: {error.what}.")
        except CadalignError as error:  # also of a mask that cannot be written or read
            live = LiveAlignment(message=f"No alignment: {error}.")
        annotation.live = (document, live, suggestion)
        return live, suggestion

    def _align(self, annotation: Annotation) -> LiveAlignment:
        observation, shape = annotation.observation(), self.shape
        pairs, model = annotation.document.complete_pairs, self.model
        points = model.points_of(pairs)
        by_mask = observation.evidence.mask is not None and not shape.is_estimated
        by_photo = observation.init is not None and "image" in observation.fit_options
        if not (by_mask or (by_photo and shape.has_mesh)):
            is_plain = observation.is_plain and not shape.is_estimated
            missing = missing_text(shape.known(points), shape, is_plain=is_plain)
            if missing:
                return LiveAlignment(message=missing)
        own = {shape.id_of(point): point for _, point in model.registry}
        known = Known(
            shape,
            model.cad.scene.mesh,
            anchors={label: point for label, point in own.items() if label is not None},
            estimates_focal=not annotation.document.focal.known,
            focal_prior=annotation.document.priors.focal,
            by_mask=annotation.estimates_by_mask,
        )
        estimate = LiveAlignment.of(known, observation)
        uv = np.array([pair.uv for pair in pairs], dtype=float).reshape(-1, 2)
        return live_alignment(estimate, known, model.wireframe, observation, points, uv)

    def save(self, annotation: Annotation) -> None:
        """Write the files of an annotation and of the model; an error is kept for the page.

        Those that could not be written before are written too.
        """
        self._write(annotation)
        if not annotation.save_error:
            for other in self.unsaved:
                self._write(other)

    @property
    def unsaved(self) -> list[Annotation]:
        """Annotations whose last change could not be written."""
        return [each for each in self.photos if each.save_error]

    def save_unsaved(self, folder: Path | None = None) -> None:
        """Write what could not be written, if given into another folder from now on."""
        with self.lock:
            unsaved = self.unsaved
            if folder is not None:
                self.model.keypoints_path = folder / self.model.keypoints_path.name
                for each in unsaved:
                    each.files = AnnotationFiles(folder / each.files.observation.name)
            for each in unsaved:
                self._write(each)

    def _write(self, annotation: Annotation) -> None:
        ready = self.ready  # asked first: it may become so at any time
        annotation.fit_pending = not ready
        live, _ = self.live(annotation)
        used = (each.document.keypoints for each in self.photos)
        try:
            # First the keypoints, which the observation names.
            self.model.write_keypoints(frozenset[int]().union(*used))
            written = annotation.observation(fit_options=live.fit_options, to_write=True)
            annotation.files.write(written)
            if ready:
                # An alignment by assumptions is shown but not written: `cadalign fit` would
                # refuse it.
                annotation.files.write_fit(None if live.provisional else live.result)
        except CadalignError as error:
            annotation.save_error = str(error)
        else:
            annotation.save_error = ""
            annotation.saved_at = time.time()


@cache
def _load_solvers(*, joint: bool) -> None:
    """Compile or load the solvers, once in a process, by aligning a synthetic problem."""
    problem = simulate_problem(np.random.default_rng(0), points=8, noise_px=1.0)
    warm_up(problem.points_3d, problem.points_2d, problem.camera, joint=joint)
