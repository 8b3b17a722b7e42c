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
    is too; see `cadalign.evaluation.metrics.scan2cad`.
yaw_error_deg, depth_error, depth_error_relative, iou_3d, iou_bev
    KITTI's; see `cadalign.evaluation.metrics.kitti`.
mssd, mspd_px, mssd_recall, mspd_recall, vsd_recall
    BOP's: the first in diameters, the last three averaged over the thresholds; see
    `cadalign.evaluation.metrics.bop`.

Metrics of other data sets are empty, as are those of rows that are not ok, and of objects whose
truth is not known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.errors import DataError
from cadalign.estimation.align import align
from cadalign.estimation.model import Model
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.evaluation.benchmark import VIEW_NAMES, Benchmark, Case, Pair, Setting, attempt
from cadalign.evaluation.instances.record import RECORD_COLUMNS
from cadalign.evaluation.methods.method import Method, MethodInput
from cadalign.evaluation.methods.registry import choose_methods
from cadalign.evaluation.metrics.registry import Compared, choose_metrics
from cadalign.evaluation.metrics.sets import score_alignment, score_columns
from cadalign.evaluation.outcome import Outcome
from cadalign.evaluation.photos.methods import (
    PhotoEstimate,
    PhotoInstance,
    estimate_of_answer,
    given_of,
    photo_method,
)
from cadalign.evaluation.photos.options import TRUTH, PhotosOptions, is_own
from cadalign.evaluation.photos.protocols import SETS, protocol_of
from cadalign.evaluation.photos.records import sighting_record
from cadalign.evaluation.photos.sighting import Sighting, sight
from cadalign.evaluation.photos.target import PhotoTarget
from cadalign.evaluation.photos.tasks import PhotoTask, opened
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Columns, Row
from cadalign.evaluation.runs.work import AbortError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.shapes.model import ShapeModel

COLUMNS: Columns = (
    *(*VIEW_NAMES, ("status", str), ("reason", str), ("keypoints", int), ("source", str)),
    *(("rms_px", float), *score_columns(SETS)),
)


@dataclass(frozen=True)
class PhotoObjects(Setting):
    """Objects in photos: the setting of the experiment.

    Parameters
    ----------
    options : PhotosOptions
    shapes : tuple of ShapeModel
    drawn_in : RunFolder
        The folder that pictures go to.
    """

    names = VIEW_NAMES
    columns = COLUMNS
    record_columns = RECORD_COLUMNS

    options: PhotosOptions
    shapes: tuple[ShapeModel, ...]
    drawn_in: RunFolder

    def warm_up(self) -> Sequence[PhotoTask]:
        """Compile the kernels."""
        points = np.random.default_rng(0).uniform(-0.3, 0.3, (9, 3))
        pose = Alignment(np.eye(3), np.array([0.0, 0.0, 2.0]), np.ones(3))
        camera = Camera(640, 480, 500, 500, 319.5, 239.5)
        pixels = camera.project(pose.apply(points))
        for model in (Model(points_3d=points), Model(points_3d=points, shape_sigma=0.01)):
            align(model, View(camera, pixels))
        return ()

    def cases(self, tasks: Sequence[PhotoTask]) -> list[Case]:
        """The objects of every photo, with what methods are given of them."""
        return [case for task in tasks for case in self._cases(task)]

    def failed(self, task: PhotoTask) -> list[Case]:
        """The case of a photo that could not be evaluated."""
        return [Case(task.names, {"source": ""})]

    def _cases(self, task: PhotoTask) -> list[Case]:
        wanted = self.options.categories
        found = []
        for each in targets_of(task, self.options.root):
            if isinstance(each, Case):
                found.append(replace(each, facts={"source": ""}))
            elif wanted is None or each.found.category in wanted:
                found.append(self._case(each, shown=task.index < self.options.pictures))
        return found

    def _case(self, target: PhotoTarget, *, shown: bool) -> Case:
        protocol = protocol_of(opened(self.options.root).kind)
        sighting = attempt(sight, target, protocol, self.options)
        if isinstance(sighting, Exception):
            return Case(target.names, {"source": ""}, error=sighting)
        facts = {"keypoints": len(sighting.names), "source": sighting.source}
        similar_sigma = self.options.similar_sigma
        instance = PhotoInstance(sighting, protocol, self.shapes, similar_sigma, shown)
        return Case(target.names, facts, instance)

    def given(self, instance: PhotoInstance) -> MethodInput:
        """The keypoints; for functions of views, the model to be stretched and all evidence."""
        return given_of(instance)

    def answered(
        self, method: Method, instance: PhotoInstance, answer: Alignment | Result
    ) -> PhotoEstimate:
        """The estimate of the data set's model."""
        return estimate_of_answer(answer, instance.sighting)

    def compared(self, instance: PhotoInstance, estimate: PhotoEstimate) -> Compared:
        """The estimated and the true alignment of the data set's model."""
        return Compared(estimate.alignment, instance.sighting.target.gt, estimate.result)

    def measure(self, method: Method, pairs: Sequence[Pair]) -> list[Row | Exception]:
        """Errors by the metrics of the data set."""
        return [attempt(_row, instance, estimate) for instance, estimate in pairs]

    def finish(
        self, case: Case, outcomes: list[Outcome], estimates: list[Any]
    ) -> tuple[list[Outcome], Row | None]:
        """The record and the pictures of an object, where a method has an estimate of it."""
        if not any(outcome.is_ok for outcome in outcomes):
            return outcomes, None
        instance: PhotoInstance = case.instance
        if instance.is_shown:
            methods = [outcome.names["method"] for outcome in outcomes]
            pairs = dict(zip(methods, estimates, strict=True))
            found = (pairs.get(name) for name in (instance.protocol.best, *methods, TRUTH))
            best = next((each for each in found if isinstance(each, PhotoEstimate)), None)
            draw(self.drawn_in, instance.sighting, best)
        return outcomes, sighting_record(instance.sighting, outcomes, estimates)


def photos_benchmark(
    options: PhotosOptions, shapes: tuple[ShapeModel, ...], drawn_in: RunFolder
) -> Benchmark:
    """The methods of the options on objects in photos."""
    own = {name: photo_method(name) for name in options.methods if is_own(name)}
    methods = choose_methods(options.methods, own)
    metrics = choose_metrics(options.metrics, COLUMNS)
    return Benchmark(PhotoObjects(options, shapes, drawn_in), methods, metrics=metrics)


def targets_of(task: PhotoTask, root: Path) -> list[PhotoTarget | Case]:
    """The objects of a photo; cases without an instance for what cannot be read."""
    if task.problem:
        return [Case(task.names, error=DataError(task.problem))]
    dataset = opened(root)
    try:
        photo = dataset[task.index]
    except DataError as error:
        return [Case(task.names, error=error)]
    bad = [
        Case(PhotoTask(-1, f"{photo.name}, problem {number + 1}").names, error=problem)
        for number, problem in enumerate(photo.problems)
    ]
    return [*bad, *(PhotoTarget(photo, found, str(dataset.root)) for found in photo.objects)]


def draw(folder: RunFolder, sighting: Sighting, estimate: PhotoEstimate | None) -> None:
    """Write the pictures of an object."""
    from cadalign.evaluation.photos.records import draw_sighting

    try:
        draw_sighting(folder, sighting, estimate)
    except OSError as error:
        raise AbortError(
            f"a picture cannot be written: {error}",
            fix="free some space, and start the same command again: the run goes on",
        ) from None


def _row(instance: PhotoInstance, found: PhotoEstimate) -> Row:
    sighting = instance.sighting
    scores = score_alignment(sighting.target, instance.protocol.metrics, found.alignment, found.box)
    return {"rms_px": _rms(found, sighting)} | scores


def _rms(found: PhotoEstimate, sighting: Sighting) -> float | None:
    """Root mean square residual of the given keypoints [px]; None behind the camera."""
    if found.result is not None:
        residuals = found.result.residuals
    else:
        points = found.alignment.apply(sighting.points_3d)
        residuals = sighting.camera.project_where_ahead(points) - sighting.points_2d
    rms = float(np.sqrt((residuals**2).sum(axis=1).mean())) if len(residuals) else np.nan
    return rms if np.isfinite(rms) else None
