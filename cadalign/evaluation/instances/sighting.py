"""Photos as tasks, their objects with truth and CAD models, and what methods are given of them."""

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
    PhotoKeypoints,
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
_SIGMA_OF_SIDE = 1 / 64  # of the rectangle's longer side: networks' heatmaps have 64 cells
_LEAST_PX = 0.5  # a standard deviation that keypoints are given at least
_FOCAL_PRIOR = 0.2  # of the logs of scales, while the focal length is estimated


@dataclass(frozen=True)
class PhotoTask:
    """One photo of a data set, by its number."""

    index: int  # its number in the data set; -1 of a record that is no photo
    name: str
    problem: str = ""  # reason why the record cannot be read at all; empty otherwise

    @property
    def names(self) -> Row:
        """The cells that name the rows of the whole record, but for the method."""
        return {"category": UNREADABLE, "model_id": self.name, "view": 0}


def photo_tasks(dataset: PhotoDataset, max_photos: int | None) -> list[PhotoTask]:
    """The photos of a data set, then the records that its listing could not read."""
    tasks = [PhotoTask(index, name) for index, name in enumerate(dataset.names[:max_photos])]
    bad = dataset.problems.items() if max_photos is None else ()
    tasks += [PhotoTask(-1, name, str(error)) for name, error in bad]
    if not tasks:
        raise DataError("there are no photos", where=str(dataset.root))
    return tasks


def annotations_of(dataset: PhotoDataset, tasks: Sequence[PhotoTask]) -> str:
    """Hash of the photos' names and annotations: a run must not go on with others."""
    return fingerprint(repr(tasks), fingerprint_of_files(dataset.annotation_files()))


opened = lru_cache(maxsize=1)(open_photos)
"""The data set of a folder, listed once in every process."""


def reopened(root: Path) -> PhotoDataset:
    """`opened`, listed anew: a session may have changed its files."""
    opened.cache_clear()
    return opened(root)


@dataclass(frozen=True)
class _Cad:
    """A CAD model by its name, for which its mesh is kept."""

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
    """An object of a photo with its truth, as metrics need it."""

    photo: Photo
    found: PhotoObject
    root: str  # the data set's folder
    is_shown: bool = False  # its pictures are drawn

    @property
    def scene(self) -> Scene | None:
        """The mesh of the CAD model; None if there is none that can be read."""
        model = self.found.model
        return None if model is None else _scene(_Cad(self.root, model.model_id, model))

    @property
    def bounds(self) -> FloatArray | None:
        """The box (2, 3) of the CAD model: the annotation's, the mesh's or its keypoints'."""
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
        """The photo's camera, or that of the annotation's convention at the object's rectangle.

        Where the focal length is unknown, the true pose is of a camera whose principal point is at
        the object; methods get the middle of its rectangle instead.
        """
        camera, annotated = self.photo.camera, self.found.truth.camera
        if camera is None or camera.focal_known or annotated is None:
            return camera
        left, top, right, bottom = rectangle_of(self.found)
        middle = (left + right) / 2, (top + bottom) / 2
        return Camera(camera.width, camera.height, annotated.fx, annotated.fy, *middle)

    @property
    def names(self) -> Row:
        """The cells that name its rows, but for the method."""
        found = self.found
        model_id = f"{self.photo.name}/{found.object_id}"
        return {"category": found.category, "model_id": model_id, "view": 0}


def targets_of(task: PhotoTask, root: Path, *, pictures: int) -> list[PhotoTarget | Case]:
    """The objects of a photo, and cases without an instance for what cannot be read."""
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
    shown = task.index < pictures
    good = (PhotoTarget(photo, found, str(dataset.root), shown) for found in photo.objects)
    return [*bad, *good]


def rectangle_of(found: PhotoObject) -> FloatArray:
    """The object's rectangle [px]."""
    if found.bbox is None:
        raise LeftOutError("the object's place in the photo is not known")
    return found.bbox


# What methods are given ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Sighting:
    """The keypoints of an object that methods are given."""

    target: PhotoTarget
    names: tuple[str, ...]  # (n,), the given keypoints
    points_3d: FloatArray  # (n, 3), their places on the model, in its own unit
    model: NamedPoints  # all keypoints of the model, in its own unit
    bounds: FloatArray  # (2, 3), the model's box, in its own unit
    width: float  # factor of the model's size that gives it the object's width
    protocol: Protocol  # of the data set
    given: MethodInput  # of the model with the object's width


def sight(target: PhotoTarget, protocol: Protocol) -> Sighting:
    """Collect what methods are given of an object.

    Raises LeftOutError if it has no camera, no model, or too few keypoints; and DataError if its
    model cannot be read.
    """
    camera, cad = target.camera, target.found.model
    if camera is None:
        raise LeftOutError("the photo's camera is not known")
    if cad is None:
        raise LeftOutError("no model is annotated for the object")
    model = cad.load_keypoints()
    marks = target.found.keypoints
    if marks is None or model is None:
        raise LeftOutError("there are no keypoints")
    names, pixels = _marked(marks, model)
    if len(names) < _LEAST_KEYPOINTS:
        raise LeftOutError(f"{len(names)} keypoints are fewer than {_LEAST_KEYPOINTS}")
    bounds, gt = target.bounds, target.gt
    assert bounds is not None  # of the keypoints at least
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
        given=given if camera.focal_known else _calibrated(given),
    )


def _marked(marks: PhotoKeypoints, model: NamedPoints) -> tuple[tuple[str, ...], FloatArray]:
    """The visible keypoints that the model has, and their pixels."""
    good = np.isin(marks.names, model.names)
    return tuple(np.array(marks.names)[good].tolist()), marks.points_2d[good]


def _sigma(target: PhotoTarget, protocol: Protocol) -> float:
    """The standard deviation of keypoints [px] that methods are given."""
    if protocol.sigma_of_width is not None and target.photo.camera is not None:
        return protocol.sigma_of_width * target.photo.camera.width
    left, top, right, bottom = rectangle_of(target.found)
    return max(_SIGMA_OF_SIDE * float(max(right - left, bottom - top)), _LEAST_PX)


def _calibrated(given: MethodInput) -> MethodInput:
    found = fit(
        given.points_3d,
        given.points_2d,
        given.camera,
        sigma=given.sigma,
        stretch_sigma=_FOCAL_PRIOR,
        focal="estimate",
    )
    return replace(given, camera=found.camera)
