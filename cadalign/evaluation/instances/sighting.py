"""Photos as tasks, their objects with truth and CAD models, and the input of methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.formats import open_photos
from cadalign.datasets.photo import (
    CadModel,
    NamedPoints,
    Photo,
    PhotoDataset,
    PhotoObject,
)
from cadalign.errors import DataError
from cadalign.estimation.fit import fit
from cadalign.evaluation.benchmark import Case
from cadalign.evaluation.methods import MethodInput
from cadalign.evaluation.metrics.photos import Protocol
from cadalign.evaluation.runs.work import (
    UNREADABLE,
    LeftOutError,
    Row,
    fingerprint,
    fingerprint_of_files,
)
from cadalign.geometry.alignment import Alignment, Box, extent
from cadalign.geometry.camera import Camera
from cadalign.render.scene import Scene

_KEPT = 16
_LEAST_KEYPOINTS = 6
_SIGMA_OF_SIDE = 1 / 64  # relative to the longer side: heatmaps of networks have 64 cells
_LEAST_PX = 0.5  # minimum standard deviation of keypoints
_FOCAL_PRIOR = 0.2  # stretch_sigma while the focal length is estimated


@dataclass(frozen=True)
class PhotoTask:
    """One photo of a data set."""

    index: int  # index in the data set; -1 for a record that cannot be read
    name: str
    problem: str = ""  # why the record cannot be read; empty if it can

    @property
    def names(self) -> Row:
        """The cells that identify rows of the whole photo, without the method."""
        return {"category": UNREADABLE, "model_id": self.name, "view": 0}


def photo_tasks(dataset: PhotoDataset, max_photos: int | None) -> list[PhotoTask]:
    """Tasks of a data set's photos, followed by its unreadable records."""
    tasks = [PhotoTask(index, name) for index, name in enumerate(dataset.names[:max_photos])]
    bad = dataset.problems.items() if max_photos is None else ()
    tasks += [PhotoTask(-1, name, str(error)) for name, error in bad]
    if not tasks:
        raise DataError("there are no photos", where=str(dataset.root))
    return tasks


def annotations_of(dataset: PhotoDataset, tasks: Sequence[PhotoTask]) -> str:
    """Hash of photos' names and annotations, so that a run cannot continue with others."""
    return fingerprint(repr(tasks), fingerprint_of_files(dataset.annotation_files()))


photos_of = lru_cache(maxsize=1)(open_photos)
"""The data set of a folder, listed once per process."""


@dataclass(frozen=True)
class _Cad:
    """A CAD model, which its name identifies as a key of the mesh cache."""

    root: str
    model_id: str
    model: CadModel = field(compare=False)


@lru_cache(maxsize=_KEPT)
def _scene(cad: _Cad) -> Scene | None:
    try:
        scene = Scene(cad.model.load_mesh())
    except DataError:
        return None
    return scene if scene.mesh.faces.size else None


@dataclass(frozen=True, eq=False)
class PhotoTarget:
    """An object in a photo with its truth."""

    photo: Photo
    found: PhotoObject
    root: str  # the data set's folder
    is_shown: bool = False  # whether pictures are drawn

    @property
    def scene(self) -> Scene | None:
        """The CAD model's mesh; None if it is missing or cannot be read."""
        model = self.found.model
        return None if model is None else _scene(_Cad(self.root, model.model_id, model))

    @property
    def bounds(self) -> FloatArray | None:
        """The CAD model's box (2, 3): from the annotation, the mesh, or the keypoints."""
        model = self.found.model
        if model is None or model.bounds is not None:
            return None if model is None else np.asarray(model.bounds)
        if self.scene is not None:
            return np.asarray(self.scene.bounds)
        points = model.load_keypoints()
        return None if points is None else extent(points.xyz)

    @property
    def gt(self) -> Alignment | None:
        """The true alignment."""
        return self.found.truth.cam_from_model

    @property
    def gt_box(self) -> Box | None:
        """The true box."""
        if self.found.truth.box is not None:
            return self.found.truth.box
        gt, bounds = self.gt, self.bounds
        return None if gt is None or bounds is None else Box.from_model(bounds, gt)

    @property
    def camera(self) -> Camera | None:
        """The camera as methods get it; None if unknown.

        If the focal length is unknown, the annotated pose refers to a camera with its principal
        point at the object. Methods then get the annotated focal length, and the centre of the
        object's rectangle as principal point.
        """
        camera, annotated = self.photo.camera, self.found.truth.camera
        if camera is None or camera.focal_known or annotated is None:
            return camera
        left, top, right, bottom = rectangle_of(self.found)
        middle = (left + right) / 2, (top + bottom) / 2
        return Camera(camera.width, camera.height, annotated.fx, annotated.fy, *middle)

    @property
    def names(self) -> Row:
        """The cells that identify its rows, without the method."""
        found = self.found
        model_id = f"{self.photo.name}/{found.object_id}"
        return {"category": found.category, "model_id": model_id, "view": 0}


def targets_of(task: PhotoTask, root: Path, *, pictures: int) -> list[PhotoTarget | Case]:
    """Objects of a photo, and cases without an instance for unreadable parts."""
    if task.problem:
        return [Case(task.names, error=DataError(task.problem))]
    dataset = photos_of(root)
    try:
        photo = dataset[task.index]
    except DataError as error:
        return [Case(task.names, error=error)]
    bad = [
        Case(PhotoTask(-1, f"{photo.name}, problem {number + 1}").names, error=problem)
        for number, problem in enumerate(photo.problems)
    ]
    shown = task.index < pictures
    good = (PhotoTarget(photo, found, str(dataset.root), shown) for found in photo.objects)
    return [*bad, *good]


def rectangle_of(found: PhotoObject) -> FloatArray:
    """The object's rectangle [px]."""
    if found.bbox is None:
        raise LeftOutError("the object's rectangle in the photo is unknown")
    return found.bbox


# Input of methods ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Sighting:
    """An object in a photo as an instance: its keypoints and the input of methods."""

    target: PhotoTarget
    names: tuple[str, ...]  # (n,), names of the keypoints in the photo
    points_3d: FloatArray  # (n, 3), their positions on the model, in its own unit
    model: NamedPoints  # all keypoints of the model, in its own unit
    bounds: FloatArray  # (2, 3), the model's box, in its own unit
    width: float  # factor that scales the model to the object's width
    protocol: Protocol  # of the data set
    input: MethodInput  # with the model scaled to the object's width


def make_sighting(target: PhotoTarget, protocol: Protocol) -> Sighting:
    """Make the instance of an object.

    Raises LeftOutError if the object has no camera, no model, or too few keypoints, and DataError
    if its model cannot be read.
    """
    camera, cad = target.camera, target.found.model
    if camera is None:
        raise LeftOutError("the photo's camera is unknown")
    if cad is None:
        raise LeftOutError("no model is annotated for the object")
    model = cad.load_keypoints()
    marks = target.found.keypoints
    if marks is None or model is None:
        raise LeftOutError("there are no keypoints")
    shared = np.isin(marks.names, model.names)
    names, pixels = tuple(np.array(marks.names)[shared].tolist()), marks.points_2d[shared]
    if len(names) < _LEAST_KEYPOINTS:
        raise LeftOutError(f"{len(names)} keypoints are fewer than {_LEAST_KEYPOINTS}")
    bounds, gt = target.bounds, target.gt
    assert bounds is not None  # keypoints have bounds
    row_of = {name: row for row, name in enumerate(model.names)}
    points, width = model.xyz[[row_of[name] for name in names]], float(gt.scale[0]) if gt else 1.0
    sigma = _sigma(target, protocol)
    given = MethodInput(points * width, pixels, camera, sigma, bounds=bounds * width, gt=gt)
    return Sighting(
        target=target,
        names=names,
        points_3d=points,
        model=model,
        bounds=bounds,
        width=width,
        protocol=protocol,
        input=given if camera.focal_known else _estimate_focal(given),
    )


def _sigma(target: PhotoTarget, protocol: Protocol) -> float:
    """The standard deviation of keypoints [px] as methods get it."""
    if protocol.sigma_of_width is not None and target.photo.camera is not None:
        return protocol.sigma_of_width * target.photo.camera.width
    left, top, right, bottom = rectangle_of(target.found)
    return max(_SIGMA_OF_SIDE * float(max(right - left, bottom - top)), _LEAST_PX)


def _estimate_focal(given: MethodInput) -> MethodInput:
    found = fit(
        given.points_3d,
        given.points_2d,
        given.camera,
        sigma=given.sigma,
        stretch_sigma=_FOCAL_PRIOR,
        focal="estimate",
    )
    return replace(given, camera=found.camera)
