"""Errors of methods on photos of real objects.

Columns of the result table, one row per object and method: what names the row (``category``,
``model_id``, the photo's name and the object's, ``view``, ``method``), ``status`` (``left out``
where the object, or the method on it, lacks what is asked for) and ``reason``, and then

keypoints, source
    Number of the given keypoints, and where they come from: annotated, detected or simulated.
rms_px
    Root mean square residual of the given keypoints [px].
rotation_error_deg, translation_cm
    Symmetry-aware, and of the model's origin.
box_iou, box_iou_up_to_scale
    Of the boxes, the first symmetry-aware, the second after the estimate was scaled about the
    camera centre.
scan2cad_translation_m, scan2cad_scale, scan2cad_aligned, scan2cad_aligned_axes
    Scan2CAD's errors, 1 where all are within their thresholds, and 1 where the scale of each axis
    is too; see `cadalign.evaluation.photos.metrics.scan2cad`.
yaw_error_deg, depth_error, depth_error_relative, iou_3d, iou_bev
    KITTI's; see `cadalign.evaluation.photos.metrics.kitti`.
mssd, mspd_px, mssd_recall, mspd_recall, vsd_recall
    BOP's: the first in diameters, the last three averaged over the thresholds; see
    `cadalign.evaluation.photos.metrics.bop`.

Metrics of other data sets are empty, as are those of rows that are not ok, and of objects whose
truth is not known.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cadalign.datasets.photos.photo import Photo
from cadalign.errors import CadalignError, DataError, DegenerateError
from cadalign.estimation.align import align
from cadalign.estimation.model import Model
from cadalign.estimation.view import View
from cadalign.evaluation.instances.record import RECORD_COLUMNS
from cadalign.evaluation.outcome import LEFT_OUT, Outcome, reason_of
from cadalign.evaluation.photos.methods import PhotoEstimate, estimate_object
from cadalign.evaluation.photos.names import TRUTH
from cadalign.evaluation.photos.options import PhotosOptions
from cadalign.evaluation.photos.protocols import Protocol, protocol_of
from cadalign.evaluation.photos.records import sighting_record
from cadalign.evaluation.photos.scores import SCORE_COLUMNS, score_alignment
from cadalign.evaluation.photos.sighting import LeftOutError, PhotoTarget, Sighting, sight
from cadalign.evaluation.photos.tasks import PhotoTask, opened
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Columns, Row
from cadalign.evaluation.runs.work import AbortError, Rows
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.shapes.model import ShapeModel

_NAMES: Columns = (("category", str), ("model_id", str), ("view", int), ("method", str))
COLUMNS: Columns = (
    *(*_NAMES, ("status", str), ("reason", str), ("keypoints", int), ("source", str)),
    *(("rms_px", float), *SCORE_COLUMNS),
)


@dataclass(frozen=True)
class PhotosExperiment:
    """Evaluates methods on the objects of photos.

    Parameters
    ----------
    options : PhotosOptions
        With the methods.
    shapes : tuple of ShapeModel
    drawn_in : RunFolder
        The folder that pictures go to.
    """

    columns = COLUMNS
    timing_columns = (*_NAMES, ("seconds", float))
    record_columns = RECORD_COLUMNS

    options: PhotosOptions
    shapes: tuple[ShapeModel, ...]
    drawn_in: RunFolder

    def warm_up(self) -> None:
        """Compile the kernels."""
        points = np.random.default_rng(0).uniform(-0.3, 0.3, (9, 3))
        pose = Alignment(np.eye(3), np.array([0.0, 0.0, 2.0]), np.ones(3))
        camera = Camera(640, 480, 500, 500, 319.5, 239.5)
        pixels = camera.project(pose.apply(points))
        for model in (Model(points_3d=points), Model(points_3d=points, shape_sigma=0.01)):
            align(model, View(camera, pixels))

    def evaluate(self, tasks: Sequence[PhotoTask]) -> Rows:
        """Rows and a record for every object of every photo."""
        return Rows.joined([self._rows(task) for task in tasks])

    def failure(self, task: PhotoTask, reason: str) -> Rows:
        """A failed row for every method."""
        methods = self.options.methods
        return Rows.of(Outcome.failure(reason, task.names(name), source="") for name in methods)

    def _rows(self, task: PhotoTask) -> Rows:
        if task.problem:
            return self.failure(task, task.problem)
        dataset = opened(self.options.root)
        try:
            photo = dataset[task.index]
        except DataError as error:
            return self.failure(task, str(error))
        parts = [self._bad_object(photo, number) for number in range(len(photo.problems))]
        shown = task.index < self.options.pictures
        root, protocol = str(dataset.root), protocol_of(dataset.kind)
        wanted = self.options.categories
        for found in photo.objects:
            if wanted is None or found.category in wanted:
                parts.append(self._object(PhotoTarget(photo, found, root), protocol, shown=shown))
        return Rows.joined(parts)

    def _bad_object(self, photo: Photo, number: int) -> Rows:
        """Failed rows of an object whose record could not be read."""
        task = PhotoTask(-1, f"{photo.name}, problem {number + 1}")
        return self.failure(task, str(photo.problems[number]))

    def _object(self, target: PhotoTarget, protocol: Protocol, *, shown: bool) -> Rows:
        try:
            sighting = sight(target, protocol, self.options)
        except Exception as error:
            return Rows.of(_without(error, target.names(name)) for name in self.options.methods)
        answers = [self._answer(name, sighting, protocol) for name in self.options.methods]
        outcomes = [outcome for outcome, _ in answers]
        estimates = [estimate for _, estimate in answers]
        if not any(outcome.is_ok for outcome in outcomes):
            return Rows.of(outcomes)
        if shown:
            self._draw(sighting, protocol, estimates)
        return Rows.of(outcomes, [sighting_record(sighting, outcomes, estimates)])

    def _answer(
        self, method: str, sighting: Sighting, protocol: Protocol
    ) -> tuple[Outcome, PhotoEstimate | CadalignError]:
        names = sighting.target.names(method)
        facts: Row = {"keypoints": len(sighting.names), "source": sighting.source}
        how = {"similar_sigma": self.options.similar_sigma}
        start = time.perf_counter()
        try:
            found = estimate_object(method, sighting, self.shapes, **how)
            seconds = time.perf_counter() - start
            scores = score_alignment(sighting.target, protocol, found.alignment, found.box)
            values = facts | {"rms_px": _rms(found, sighting)} | scores
        except Exception as error:
            return _without(error, names, **facts), DegenerateError(reason_of(error))
        return Outcome(names, values, seconds=seconds), found

    def _draw(
        self,
        sighting: Sighting,
        protocol: Protocol,
        estimates: Sequence[PhotoEstimate | CadalignError],
    ) -> None:
        from cadalign.evaluation.photos.drawing import draw_sighting

        pairs = dict(zip(self.options.methods, estimates, strict=True))
        order = (protocol.best, *self.options.methods, TRUTH)
        found = (pairs.get(name) for name in order)
        best = next((each for each in found if isinstance(each, PhotoEstimate)), None)
        try:
            draw_sighting(self.drawn_in, sighting, best)
        except OSError as error:
            raise AbortError(
                f"a picture cannot be written: {error}",
                fix="free some space, and start the same command again: the run goes on",
            ) from None


def _without(error: Exception, names: Row, **facts: object) -> Outcome:
    """The outcome of an object without an estimate."""
    values = {"source": "", **facts}
    if isinstance(error, LeftOutError):
        return Outcome(names, values, LEFT_OUT, reason_of(error))
    return Outcome.failure(reason_of(error), names, **values)


def _rms(found: PhotoEstimate, sighting: Sighting) -> float | None:
    """Root mean square residual of the given keypoints [px]; None behind the camera."""
    if found.result is not None:
        residuals = found.result.residuals
    else:
        points = found.alignment.apply(sighting.points_3d)
        residuals = sighting.camera.project_where_ahead(points) - sighting.points_2d
    rms = float(np.sqrt((residuals**2).sum(axis=1).mean())) if len(residuals) else np.nan
    return rms if np.isfinite(rms) else None
