"""Photos of a data set: image, camera, and objects with ground truth."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, as_floats, as_points
from cadalign.datasets.records import RecordSet, collect_error
from cadalign.errors import DataError
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.symmetry import Symmetry
from cadalign.io.documents import name_file
from cadalign.io.files import damage_error, read_text
from cadalign.io.images import ByteImage, open_photo, read_photo
from cadalign.io.meshes.files import load_mesh

_Record = TypeVar("_Record")


@dataclass(frozen=True, eq=False)
class PhotoKeypoints:
    """Annotated keypoints of an object in a photo.

    Raises DataError if lengths don't match, InputError if a value is not finite.
    """

    points_2d: FloatArray
    """(k, 2), pixels; integers are pixel centres."""
    names: tuple[str, ...]
    """(k,), name of each keypoint; the model's keypoint of the same name is the same point."""

    def __post_init__(self) -> None:
        points = as_points(self.points_2d, name="keypoints", dimension=2)
        if len(self.names) != len(points):
            raise DataError(f"{len(points)} keypoints, {len(self.names)} names", where="keypoints")
        object.__setattr__(self, "points_2d", points)

    def __len__(self) -> int:
        return len(self.points_2d)


@dataclass(frozen=True, eq=False)
class NamedPoints:
    """Keypoints of a model."""

    names: tuple[str, ...]  # (k,), no name occurs twice
    xyz: FloatArray  # (k, 3), positions [model units]

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, eq=False)
class CadModel:
    """The CAD model annotated for an object; mesh and keypoints are read on access."""

    model_id: str
    """The model's id in its data set."""
    mesh: Mesh | Path | Callable[[], Mesh | None] | None = None
    """The mesh, its file, or a function that reads it; None if there is none."""
    keypoints: NamedPoints | Callable[[], NamedPoints | None] | None = None
    """The named keypoints, or a function that reads them; None if there are none."""
    bounds: FloatArray | None = None
    """(2, 3), lowest and highest corner of the annotated bounding box [model units], or None."""

    def load_mesh(self) -> Mesh:
        """Read the mesh; raises DataError if it is missing or cannot be read."""
        mesh = self.mesh() if callable(self.mesh) else self.mesh
        if mesh is None:
            raise DataError("there is no mesh of this model", where=f"model {self.model_id}")
        return load_mesh(mesh) if isinstance(mesh, Path) else mesh

    def load_keypoints(self) -> NamedPoints | None:
        """Read the named keypoints; None if there are none. Raises DataError as `load_mesh`."""
        return self.keypoints() if callable(self.keypoints) else self.keypoints


@dataclass(frozen=True, eq=False)
class Truth:
    """The annotated parts of an object's pose; any part may be missing."""

    cam_from_model: Alignment | None = None
    """Pose and stretch of the CAD model in the camera frame; None unless all are annotated."""
    box: Box | None = None
    """The object's oriented box in the camera frame."""
    camera: Camera | None = None
    """The camera that the pose was annotated with, if it is not the photo's. The pose fits the
    photo under this camera, but its translation and this focal length are only conventions."""

    @property
    def rotation(self) -> FloatArray | None:
        """The rotation from model to camera, (3, 3) float; None if unknown."""
        return None if self.cam_from_model is None else self.cam_from_model.rotation


_no_symmetry = cache(Symmetry.none)


@dataclass(frozen=True, eq=False)
class PhotoObject:
    """One object in a photo."""

    object_id: str
    """The object's name within its photo."""
    category: str
    """The data set's name of its category."""
    truth: Truth = field(default_factory=Truth)
    """The annotated pose."""
    keypoints: PhotoKeypoints | None = None
    """Keypoints annotated in the photo."""
    model: CadModel | None = None
    """The CAD model annotated for it."""
    symmetry: Symmetry = field(default_factory=_no_symmetry)
    """Symmetry of the model."""
    mask_path: Path | None = None
    """Image file of the object's mask; see `read_mask`."""
    bbox: FloatArray | None = None
    """(4,), left, top, right and bottom of its bounding box in the photo [px]."""

    def read_mask(self) -> BoolArray:
        """Read the object's mask, (h, w) bool; raises DataError if there is none."""
        if self.mask_path is None:
            raise DataError("this object has no mask", where=f"object {self.object_id}")
        with open_photo(self.mask_path) as image:
            return np.asarray(image.convert("L")) > 0


@dataclass(frozen=True, eq=False)
class Photo:
    """One photo with the objects in it."""

    name: str
    """The photo's unique name within its data set."""
    image: Path | None
    """The image file; None if it is missing."""
    camera: Camera | None
    """The camera, `Camera.from_size` if the focal length is unknown; None if the image's size
    is unknown, too."""
    objects: tuple[PhotoObject, ...]
    """The objects whose annotation could be read."""
    up: FloatArray | None = None
    """(3,), measured direction against gravity in the camera frame; None if unknown."""
    problems: tuple[DataError, ...] = ()
    """Errors of the photo's objects that could not be read."""

    def read_image(self) -> ByteImage:
        """Read the photo's pixels, (h, w, 3) uint8; raises DataError if the image is missing."""
        if self.image is None:
            raise DataError("the image file of this photo is missing", where=self.name)
        return read_photo(self.image)


class PhotoDataset(RecordSet[Photo]):
    """A data set of photos; see `cadalign.datasets.records.RecordSet`.

    `problems` also holds the errors of single objects in a photo.

    Examples
    --------
    >>> for photo in cadalign.datasets.open("pix3d"):  # doctest: +SKIP
    ...     for found in photo.objects:
    ...         print(photo.name, found.category, found.truth.cam_from_model)
    """

    kind = "photos"
    noun = "photo"
    patterns: tuple[str, ...] = ("*.json",)
    """Patterns of the annotation files below the folder."""

    def __iter__(self) -> Iterator[Photo]:
        for photo in super().__iter__():
            for number, problem in enumerate(photo.problems):
                self._log_problem(f"{photo.name}, problem {number + 1}", problem)
            yield photo

    def annotation_files(self) -> list[Path]:
        """List the annotation files; a run compares them to detect changes."""
        found = (path for pattern in self.patterns for path in self.root.glob(pattern))
        return sorted({path for path in found if path.is_file()})


def read_each(
    records: Iterable[_Record], read: Callable[[int, _Record], PhotoObject | None], *, where: str
) -> tuple[tuple[PhotoObject, ...], tuple[DataError, ...]]:
    """Read a photo's objects; returns the objects and the errors of those that failed.

    ``read`` converts the record at a position to an object, or to None to leave it out. ``where``
    is the place of the records, for messages.
    """
    found, problems = list[PhotoObject](), dict[str, DataError]()
    for number, record in enumerate(records):
        place = f"{where}, object {number}"
        with collect_error(place, problems), name_file(place):
            each = read(number, record)
            found += [] if each is None else [each]
    return tuple(found), tuple(problems.values())


def read_matrix(path: Path, shape: tuple[int | None, int]) -> FloatArray:
    """Read a text file of a matrix, one row per line; None allows any number of rows.

    Raises DataError if the file cannot be read, or is not a finite matrix of this shape.
    """
    rows = [line.split() for line in read_text(path).splitlines() if line.strip()]
    try:
        matrix = np.array(rows, dtype=np.float64)
    except ValueError:
        raise damage_error("not a table of numbers", path) from None
    with name_file(path):
        return as_floats(matrix, name="matrix", shape=shape)


def existing_file(path: Path) -> Path | None:
    """Return the path if it is a file, else None, also for an invalid file name."""
    return path if os.path.isfile(path) else None


def find_first_file(paths: Iterable[Path]) -> Path | None:
    """Return the first path that is a file, or None."""
    return next((path for path in paths if existing_file(path)), None)
