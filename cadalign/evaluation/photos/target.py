"""Photos as tasks, and their objects with truth and CAD models, which are read once for many."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.formats import open_photos
from cadalign.datasets.photos.dataset import PhotoDataset
from cadalign.datasets.photos.photo import CadModel, Photo, PhotoObject
from cadalign.errors import DataError
from cadalign.evaluation.benchmark import Case, Tasks
from cadalign.evaluation.runs.work import (
    UNREADABLE,
    LeftOutError,
    Row,
    fingerprint,
    fingerprint_of_files,
)
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.camera import Camera
from cadalign.render.scene import Scene

_KEPT = 16


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


class PhotoTasks(Tasks[PhotoTask]):
    """The photos of a data set, then the records that its listing could not read."""

    def __init__(self, dataset: PhotoDataset, max_photos: int | None) -> None:
        self._names = dataset.names[:max_photos]
        bad = dataset.problems.items() if max_photos is None else ()
        self._bad = tuple((name, str(error)) for name, error in bad)
        self._annotations = fingerprint_of_files(dataset.annotation_files())
        if not len(self):
            raise DataError("there are no photos", where=str(dataset.root))

    def __len__(self) -> int:
        return len(self._names) + len(self._bad)

    def task(self, index: int) -> PhotoTask:
        """A photo, or a record that could not be read."""
        if index < len(self._names):
            return PhotoTask(index, self._names[index])
        return PhotoTask(-1, *self._bad[index - len(self._names)])

    def fingerprint(self) -> str:
        """Hash of the photos' names and annotations: a run must not go on with others."""
        return fingerprint("\0".join(self._names), repr(self._bad), self._annotations)


opened = lru_cache(maxsize=1)(open_photos)
"""The data set of a folder, listed once in every process."""


def reopened(root: Path) -> PhotoDataset:
    """`opened`, listed anew: a session may have changed its files."""
    opened.cache_clear()
    return opened(root)


@dataclass(frozen=True)
class Cad:
    """A CAD model of the data set in a folder."""

    root: str  # the folder
    model_id: str
    model: CadModel = field(compare=False, repr=False)  # where it is read from

    @property
    def scene(self) -> Scene:
        """The mesh; raises DataError if there is none, or it cannot be read."""
        return _scene(self)

    @property
    def has_mesh(self) -> bool:
        """True if there is a mesh that can be read."""
        try:
            return bool(self.scene.mesh.faces.size)
        except DataError:
            return False

    @property
    def bounds(self) -> FloatArray | None:
        """The bounding box (2, 3): the annotation's, the mesh's or that of the keypoints."""
        if self.model.bounds is not None:
            return np.asarray(self.model.bounds)
        if self.has_mesh:
            return np.asarray(self.scene.bounds)
        points = self.model.load_keypoints()
        return (
            None if points is None else np.array([points.xyz.min(axis=0), points.xyz.max(axis=0)])
        )


@lru_cache(maxsize=_KEPT)
def _scene(cad: Cad) -> Scene:
    return Scene(cad.model.load_mesh())


@dataclass(frozen=True, eq=False)
class PhotoTarget:
    """An object of a photo with its truth, as metrics need it."""

    photo: Photo
    found: PhotoObject
    root: str  # the data set's folder
    is_shown: bool = False  # its pictures are drawn

    @property
    def cad(self) -> Cad | None:
        """The CAD model."""
        model = self.found.model
        return None if model is None else Cad(self.root, model.model_id, model)

    @property
    def bounds(self) -> FloatArray | None:
        """The box (2, 3) of the CAD model."""
        return None if self.cad is None else self.cad.bounds

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
    """The object's rectangle [px], or that of its keypoints."""
    if found.bbox is not None:
        return found.bbox
    if found.keypoints is None or not len(found.keypoints):
        raise LeftOutError("the object's place in the photo is not known")
    points = found.keypoints.points_2d
    return np.concatenate([points.min(axis=0), points.max(axis=0)])
