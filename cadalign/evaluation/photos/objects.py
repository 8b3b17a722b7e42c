"""Objects in photos: errors of methods, records and pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from cadalign.errors import DataError
from cadalign.estimation.result import Result
from cadalign.evaluation.benchmark import (
    Benchmark,
    Case,
    Setting,
    attempt,
    write_picture,
)
from cadalign.evaluation.experiments.photos import COLUMNS
from cadalign.evaluation.instances.pictures import (
    NO_PHOTO,
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
from cadalign.evaluation.photos.options import TRUTH, PhotosOptions, protocol_of
from cadalign.evaluation.photos.target import PhotoTarget, PhotoTask, opened, targets_of
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.work import Outcome, Row
from cadalign.geometry.alignment import Alignment
from cadalign.render.raycast.renderer import cast_geometry
from cadalign.shapes.model import ShapeModel

_NO_SOURCE: Row = {"source": ""}


@dataclass(frozen=True)
class PhotoObjects(Setting):
    """Objects in photos: the setting of the experiment."""

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

    def finish(self, case: Case, outcomes: list[Outcome], estimates: list[Any]) -> str | None:
        if not any(outcome.is_ok for outcome in outcomes):
            return None
        sighting: Sighting = case.instance
        if sighting.target.is_shown:
            methods = [outcome.names["method"] for outcome in outcomes]
            pairs = dict(zip(methods, estimates, strict=True))
            found = (pairs.get(name) for name in (sighting.protocol.best, *methods, TRUTH))
            best = next((each for each in found if isinstance(each, PhotoEstimate)), None)
            write_picture(draw_sighting, self.drawn_in, sighting, best)
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


def photos_benchmark(
    options: PhotosOptions, shapes: tuple[ShapeModel, ...], drawn_in: RunFolder
) -> Benchmark:
    """The methods of the options on objects in photos."""
    how: dict[str, Any] = {"shapes": shapes, "similar_sigma": options.similar_sigma}
    own = {
        name: Method(name, partial(estimate_object, method=name, **how))
        for name in options.methods
        if not is_function(name)
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

    The photo is grey where there is none.
    """
    names, camera, cad = sighting.target.names, sighting.camera, sighting.target.cad
    stem = record_stem(names["category"], names["model_id"])
    has_mesh = cad is not None and cad.has_mesh
    try:
        photo = sighting.target.photo.read_image()
    except DataError:
        photo = np.full((camera.height, camera.width, 3), NO_PHOTO, dtype=np.uint8)
    more: dict[str, Any] = {}
    if estimate is not None:
        predicted = camera.project_where_ahead(estimate.alignment.apply(sighting.points_3d))
        more = {"reprojected": predicted, "est_box": estimate.box}
        if cad is not None and has_mesh:
            more["est_frame"] = lambda near: cast_geometry(cad.scene, near, estimate.alignment)
    gt_box = sighting.target.gt_box
    write_pictures(folder, stem, photo, camera, observed=sighting.points_2d, gt_box=gt_box, **more)
    if cad is not None and has_mesh:
        write_preview(folder.previews / f"{stem}.json", cad.scene.mesh)
