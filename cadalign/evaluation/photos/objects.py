"""Objects in photos: errors of methods, records and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from cadalign.errors import DataError
from cadalign.estimation.result import Result
from cadalign.evaluation.benchmark import (
    VIEW_NAMES,
    Benchmark,
    Case,
    Setting,
    attempt,
    write_picture,
)
from cadalign.evaluation.experiments.photos import COLUMNS, PhotosOptions
from cadalign.evaluation.instances.pictures import (
    NO_PHOTO,
    cut_out,
    shown_photo,
    write_pictures,
    write_preview,
)
from cadalign.evaluation.instances.record import (
    RECORD_COLUMNS,
    Estimate,
    aligned_shape,
    record_of,
    record_stem,
)
from cadalign.evaluation.methods import Method, MethodInput
from cadalign.evaluation.metrics.photos import score_alignment
from cadalign.evaluation.options import is_function
from cadalign.evaluation.photos.methods import (
    PhotoEstimate,
    Sighting,
    estimate_object,
    estimate_of_model,
    sight,
    with_all_evidence,
)
from cadalign.evaluation.photos.protocols import TRUTH, is_own, protocol_of
from cadalign.evaluation.photos.target import PhotoTarget, PhotoTask, opened, targets_of
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.work import Outcome, Row
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import rescaled_pixels
from cadalign.io.images import ByteImage
from cadalign.render.drawing.overlay import draw_overlay
from cadalign.render.raycast.renderer import cast_geometry
from cadalign.shapes.model import ShapeModel

_NO_SOURCE: Row = {"source": ""}


@dataclass(frozen=True)
class PhotoObjects(Setting):
    """Objects in photos: the setting of the experiment."""

    names = VIEW_NAMES
    columns = COLUMNS
    record_columns = RECORD_COLUMNS

    options: PhotosOptions
    drawn_in: RunFolder  # the folder that pictures go to

    def failed(self, task: PhotoTask) -> list[Case]:
        return [Case(task.names, _NO_SOURCE)]

    def _cases(self, task: PhotoTask) -> list[Case]:
        wanted = self.options.categories
        found = []
        for each in targets_of(task, self.options.root, pictures=self.options.pictures):
            if isinstance(each, Case):
                found.append(replace(each, facts=_NO_SOURCE))
            elif wanted is None or each.found.category in wanted:
                found.append(self._case(each))
        return found

    def _case(self, target: PhotoTarget) -> Case:
        protocol = protocol_of(opened(self.options.root).kind)
        sighting = attempt(sight, target, protocol, self.options)
        if isinstance(sighting, Exception):
            return Case(target.names, _NO_SOURCE, error=sighting)
        facts = {"keypoints": len(sighting.names), "source": sighting.source}
        return Case(target.names, facts, sighting)

    def given(self, sighting: Sighting) -> MethodInput:
        return MethodInput(
            sighting.points_3d * sighting.width,
            sighting.points_2d,
            sighting.camera,
            sighting.sigma,
            bounds=sighting.bounds * sighting.width,
            gt=sighting.target.gt,
            make_views=partial(with_all_evidence, sighting),
        )

    def answered(
        self, method: Method, sighting: Sighting, answer: Alignment | Result
    ) -> PhotoEstimate:
        if isinstance(answer, Alignment):
            return estimate_of_model(answer, sighting)
        is_of_model = tuple(answer.ids) == tuple(sighting.model.names)
        return estimate_of_model(answer.alignment, sighting, answer if is_of_model else None)

    def row(self, method: Method, sighting: Sighting, estimate: PhotoEstimate) -> Row:
        sets = sighting.protocol.metrics
        scores = score_alignment(sighting.target, sets, estimate.alignment, estimate.box)
        return {"rms_px": _rms(estimate, sighting)} | scores

    def finish(
        self, case: Case, outcomes: list[Outcome], estimates: list[Any]
    ) -> tuple[list[Outcome], Row | None]:
        if not any(outcome.is_ok for outcome in outcomes):
            return outcomes, None
        sighting: Sighting = case.instance
        if sighting.target.is_shown:
            methods = [outcome.names["method"] for outcome in outcomes]
            pairs = dict(zip(methods, estimates, strict=True))
            found = (pairs.get(name) for name in (sighting.protocol.best, *methods, TRUTH))
            best = next((each for each in found if isinstance(each, PhotoEstimate)), None)
            write_picture(draw_sighting, self.drawn_in, sighting, best)
        return outcomes, sighting_record(sighting, outcomes, estimates)


def photos_benchmark(
    options: PhotosOptions, shapes: tuple[ShapeModel, ...], drawn_in: RunFolder
) -> Benchmark:
    """The methods of the options on objects in photos."""
    how: dict[str, Any] = {"shapes": shapes, "similar_sigma": options.similar_sigma}
    own = {
        name: Method(name, partial(estimate_object, method=name, **how))
        for name in options.methods
        if not is_function(name) and is_own(name)
    }
    setting = PhotoObjects(options, drawn_in)
    return Benchmark.chosen(setting, options.methods, own, metrics=options.metrics)


def _rms(found: PhotoEstimate, sighting: Sighting) -> float | None:
    """Root mean square residual of the given keypoints [px]; None behind the camera."""
    if found.result is not None:
        residuals = found.result.residuals
    else:
        points = found.alignment.apply(sighting.points_3d)
        residuals = sighting.camera.project_where_ahead(points) - sighting.points_2d
    rms = float(np.sqrt((residuals**2).sum(axis=1).mean())) if len(residuals) else np.nan
    return rms if np.isfinite(rms) else None


def sighting_record(
    sighting: Sighting, outcomes: Sequence[Outcome], estimates: Sequence[PhotoEstimate | Any]
) -> Row:
    """The record of an object, in terms of the data set's model."""
    return record_of(
        outcomes,
        [_described(each, sighting) for each in estimates],
        camera=sighting.camera,
        gt=sighting.target.gt,
        stretch=np.ones(3),
        bounds=sighting.bounds,
        points_3d=sighting.points_3d,
        points_2d=sighting.points_2d,
        ids=np.arange(len(sighting.names)),
    )


def _described(estimate: PhotoEstimate | Any, sighting: Sighting) -> Estimate | Any:
    """An estimate in terms of the data set's model; the error where there is none."""
    if not isinstance(estimate, PhotoEstimate):
        return estimate
    result, model = estimate.result, sighting.model
    if result is None:
        return estimate.alignment
    row_of = {str(name): row for row, name in enumerate(result.ids)}
    known = [row for row, name in enumerate(model.names) if name in row_of]
    return aligned_shape(
        result,
        [row_of[model.names[row]] for row in known],
        model.xyz[known],
        model_bounds=sighting.bounds,
        rms=result.rms,
        sigma=sighting.sigma,
    )


def draw_sighting(folder: RunFolder, sighting: Sighting, estimate: PhotoEstimate | None) -> None:
    """Write the pictures of an object in a photo, and the preview of its model, to a run's folder.

    ``overlays`` gets the photo with the boxes of truth and estimate, the estimated model and the
    keypoints, ``thumbs`` the part around the object with the boxes, ``pictures`` the photo alone,
    the folder of previews that of its model. Files appear whole or not at all.
    """
    names = sighting.target.names
    stem = record_stem(names["category"], names["model_id"])
    photo, camera = _photo(sighting)
    scale = camera.width / sighting.camera.width
    est_box = None if estimate is None else estimate.box
    boxes: dict[str, Any] = {"gt_box": sighting.target.gt_box, "est_box": est_box}
    cad = sighting.target.cad
    frame = predicted = None
    if estimate is not None:
        predicted = camera.project_where_ahead(estimate.alignment.apply(sighting.points_3d))
        if cad is not None and cad.has_mesh:
            frame = cast_geometry(cad.scene, camera, estimate.alignment)
    observed = rescaled_pixels(sighting.points_2d, scale)
    marks: dict[str, Any] = {"observed": observed, "reprojected": predicted}
    image = draw_overlay(photo, camera, est_frame=frame, **boxes, **marks)
    points, box = observed, sighting.target.gt_box
    if box is not None and (box.corners[:, 2] > 0).all():
        points = np.concatenate([points, camera.project(box.corners)])
    crop, near = cut_out(photo, camera, points)
    thumb = draw_overlay(crop, near, axes=False, legend=False, **boxes)
    write_pictures(folder, stem, photo, thumb, image)
    if cad is not None and cad.has_mesh:
        write_preview(folder.previews / f"{stem}.json", cad.scene.mesh)


def _photo(sighting: Sighting) -> tuple[ByteImage, Camera]:
    """The photo in a size for a page, and its camera; a grey one where there is none."""
    camera = sighting.camera
    try:
        image = sighting.target.photo.read_image()
    except DataError:
        image = np.full((camera.height, camera.width, 3), NO_PHOTO, dtype=np.uint8)
    return shown_photo(image, camera)
