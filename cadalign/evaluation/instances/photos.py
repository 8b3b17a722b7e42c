"""Objects in photos: methods, estimates, errors, records and pictures."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from cadalign.errors import DataError
from cadalign.estimation.align import align
from cadalign.estimation.fit import fit
from cadalign.estimation.model import Model
from cadalign.estimation.options import SIMILAR_SCALE_SIGMA
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.evaluation.benchmark import (
    Benchmark,
    Case,
    Setting,
    attempt,
    write_picture,
)
from cadalign.evaluation.experiments.photos import (
    COLUMNS,
    EPNP,
    GRAVITY,
    IMAGE,
    MASK,
    PRIOR,
    RIGID,
    SIMILAR,
    TRUTH,
    PhotosOptions,
    parts_of,
    protocol_of,
)
from cadalign.evaluation.instances.pictures import NO_PHOTO, write_pictures, write_preview
from cadalign.evaluation.instances.record import (
    RECORD_COLUMNS,
    Estimate,
    aligned_shape,
    record_of,
    record_stem,
)
from cadalign.evaluation.instances.sighting import (
    PhotoTarget,
    PhotoTask,
    Sighting,
    make_sighting,
    photos_of,
    targets_of,
)
from cadalign.evaluation.methods import Method, MethodInput
from cadalign.evaluation.options import is_function
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.work import LeftOutError, Outcome, Row
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.mesh import Mesh

# Evidence about the outline, which needs a mesh.
_OUTLINED = frozenset({MASK, IMAGE})

# Methods ------------------------------------------------------------------------------------------


_UP_SIGMA_DEG = 3.0  # of phones and rigs, and of upright objects
_SIMILAR_SIGMA = 0.04  # standard deviation of the object's keypoints from the model's [diagonals]


@dataclass(frozen=True, eq=False)
class PhotoEstimate:
    """An estimate of an object."""

    alignment: Alignment
    """Maps the box of the data set's model, in its own unit, to the estimated box."""
    box: Box  # the object's box in the camera frame
    result: Result | None = None  # with shape and covariances


def estimate_object(sighting: Sighting, *, method: str) -> PhotoEstimate:
    """Estimate an object by a method's name; see `PhotosOptions.methods`.

    Raises LeftOutError if the object lacks what the method needs; and CadalignError if there is no
    estimate.
    """
    base, evidence = parts_of(method)
    if base == TRUTH:
        gt, box = sighting.target.gt, sighting.target.gt_box
        if gt is None or box is None:
            raise LeftOutError("the true pose is unknown")
        return PhotoEstimate(gt, box)
    if base == EPNP:
        given = sighting.input
        found = fit(given.points_3d, given.points_2d, given.camera, method="epnp")
        return estimate_of_model(found.alignment, sighting)
    model = _model(base, sighting, with_mesh=bool(_OUTLINED & evidence))
    result = align(model, _view(sighting, evidence))
    return estimate_of_model(result.alignment, sighting, result)


def _model(base: str, sighting: Sighting, *, with_mesh: bool) -> Model:
    width, bounds = sighting.width, sighting.bounds * sighting.width
    kind: dict[str, Any] = {}
    if base == RIGID:
        kind = {"stretch": "none"}
    elif base == PRIOR:
        kind = {"stretch_sigma": SIMILAR_SCALE_SIGMA}
    elif base == SIMILAR:
        kind = {"shape_sigma": _SIMILAR_SIGMA * float(np.linalg.norm(np.ptp(bounds, axis=0)))}
    if with_mesh:
        scene = sighting.target.scene
        if scene is None:
            raise LeftOutError("the model has no mesh, which the outline needs")
        kind["mesh"] = Mesh(scene.mesh.vertices * width, scene.mesh.faces)
    return Model(
        points_3d=sighting.model.xyz * width,
        ids=sighting.model.names,
        bounds=bounds,
        up_axis=sighting.protocol.up_axis,
        **kind,
    )


def _view(sighting: Sighting, evidence: Collection[str]) -> View:
    photo, found = sighting.target.photo, sighting.target.found
    given: dict[str, Any] = {}
    if MASK in evidence:
        if found.mask_path is None:
            raise LeftOutError("the object has no mask")
        given["mask"] = found.read_mask()
    if GRAVITY in evidence:
        if photo.up is None:
            raise LeftOutError("the direction of gravity is unknown")
        given |= {"up": photo.up, "up_sigma_deg": _UP_SIGMA_DEG}
    if IMAGE in evidence:
        if photo.image is None:
            raise LeftOutError("the photo's file is missing")
        given["image"] = photo.read_image()
    seen = sighting.input
    return View(seen.camera, seen.points_2d, ids=sighting.names, sigma=seen.sigma, **given)


def estimate_of_model(
    found: Alignment, sighting: Sighting, result: Result | None = None
) -> PhotoEstimate:
    """Convert an estimate of the model with the object's width to the data set's model."""
    bounds = sighting.bounds * sighting.width if result is None else result.bounds
    box = Box.from_model(bounds, found)
    alignment = Alignment(found.rotation, found.translation, found.scale * sighting.width)
    return PhotoEstimate(alignment, box, result)


# Setting ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PhotoObjects(Setting):
    """Instances of the experiment: objects in photos."""

    columns = COLUMNS
    record_columns = RECORD_COLUMNS

    options: PhotosOptions
    drawn_in: RunFolder  # folder for pictures

    def _cases(self, task: PhotoTask) -> list[Case]:
        wanted = self.options.categories
        found = []
        for each in targets_of(task, self.options.root, pictures=self.options.pictures):
            if isinstance(each, Case):
                found.append(each)
            elif wanted is None or each.found.category in wanted:
                found.append(self._case(each))
        return found

    def _case(self, target: PhotoTarget) -> Case:
        protocol = protocol_of(photos_of(self.options.root).kind)
        sighting = attempt(partial(make_sighting, target, protocol))
        if isinstance(sighting, Exception):
            return Case(target.names, error=sighting)
        facts = {"keypoints": len(sighting.names)}
        return Case(target.names, facts, sighting)

    def method_input(self, sighting: Sighting) -> MethodInput:
        return sighting.input

    def estimate_of(
        self, method: Method, sighting: Sighting, answer: Alignment | Result
    ) -> PhotoEstimate:
        if isinstance(answer, Alignment):
            return estimate_of_model(answer, sighting)
        is_of_model = tuple(answer.ids) == tuple(sighting.model.names)
        return estimate_of_model(answer.alignment, sighting, answer if is_of_model else None)

    def row(self, method: Method, sighting: Sighting, estimate: PhotoEstimate) -> Row:
        scores = sighting.protocol.score(sighting.target, estimate.alignment, estimate.box)
        return {"rms_px": _rms(estimate, sighting)} | scores

    def finish(self, case: Case, outcomes: list[Outcome], estimates: list[Any]) -> str | None:
        if not any(outcome.is_ok for outcome in outcomes):
            return None
        sighting: Sighting = case.instance
        if sighting.target.is_shown:
            *_, last = (each for each in estimates if isinstance(each, PhotoEstimate))
            write_picture(draw_sighting, self.drawn_in, sighting, last)
        return record_of(
            outcomes,
            [_describe(each, sighting) for each in estimates],
            camera=sighting.input.camera,
            gt=sighting.target.gt,
            stretch=np.ones(3),
            bounds=sighting.bounds,
            points_3d=sighting.points_3d,
            points_2d=sighting.input.points_2d,
            ids=np.arange(len(sighting.names)),
        )


def photos_benchmark(options: PhotosOptions, drawn_in: RunFolder) -> Benchmark:
    """The benchmark of the chosen methods on objects in photos."""
    own = {
        name: Method(name, partial(estimate_object, method=name))
        for name in options.methods
        if not is_function(name)
    }
    setting = PhotoObjects(options, drawn_in)
    return Benchmark.from_methods(setting, options.methods, own, metrics=options.metrics)


def _rms(found: PhotoEstimate, sighting: Sighting) -> float | None:
    """Root mean square residual of the keypoints [px]; None if a point is behind the camera."""
    if found.result is not None:
        residuals = found.result.residuals
    else:
        points = found.alignment.apply(sighting.points_3d)
        residuals = sighting.input.camera.project_where_ahead(points) - sighting.input.points_2d
    rms = float(np.sqrt((residuals**2).sum(axis=1).mean())) if len(residuals) else np.nan
    return rms if np.isfinite(rms) else None


def _describe(estimate: PhotoEstimate | Any, sighting: Sighting) -> Estimate | Any:
    """Convert an estimate for the record; errors are unchanged."""
    if not isinstance(estimate, PhotoEstimate):
        return estimate
    result, model = estimate.result, sighting.model
    if result is None:
        return estimate.alignment
    return aligned_shape(
        result,
        np.arange(len(model)),
        model.xyz,
        model_bounds=sighting.bounds,
        sigma=sighting.input.sigma,
        result=result,
    )


def draw_sighting(folder: RunFolder, sighting: Sighting, estimate: PhotoEstimate) -> None:
    """Write pictures of an object and the preview of its model to a run's folder.

    A missing photo is drawn grey.
    """
    names, camera, scene = sighting.target.names, sighting.input.camera, sighting.target.scene
    stem = record_stem(names["category"], names["model_id"])
    try:
        photo = sighting.target.photo.read_image()
    except DataError:
        photo = np.full((camera.height, camera.width, 3), NO_PHOTO, dtype=np.uint8)
    boxes: dict[str, Any] = {"gt_box": sighting.target.gt_box, "est_box": estimate.box}
    write_pictures(folder, stem, photo, camera, observed=sighting.input.points_2d, **boxes)
    if scene is not None:
        write_preview(folder.previews / f"{stem}.json", scene.mesh)
