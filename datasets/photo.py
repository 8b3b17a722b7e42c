"""Photos of a data set: image, camera, and the objects in each with their truth."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, as_floats, as_points
from cadalign.datasets.records import RecordSet
from cadalign.errors import CadalignError, DataError
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.symmetry import Symmetry
from cadalign.io.documents import in_file
from cadalign.io.files import damaged, read_text
from cadalign.io.images import ByteImage, open_photo, read_photo
from cadalign.io.meshes.files import load_mesh

_Record = TypeVar("_Record")


@dataclass(frozen=True, eq=False)
class PhotoKeypoints:
    """The keypoints of an object that are marked in a photo.

    Raises DataError if lengths don't match, InputError if a value is not finite.
    """

    points_2d: FloatArray
    """(k, 2), pixels; integers are pixel centres."""
    names: tuple[str, ...]
    """(k,), what each one is called: the model's keypoint of the same name is the same point."""

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

    names: tuple[str, ...]  # (k,), what each one is called; no name occurs twice
    xyz: FloatArray  # (k, 3), where they lie [model units]

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, eq=False)
class CadModel:
    """The CAD model that an object is aligned with, read when it is asked for."""

    model_id: str
    """The model's id in its data set."""
    mesh: Mesh | Path | Callable[[], Mesh | None] | None = None
    """The mesh, its file, or the function that reads it; None where there is none."""
    keypoints: NamedPoints | Callable[[], NamedPoints | None] | None = None
    """The named keypoints, or the function that reads them; None where there are none."""
    bounds: FloatArray | None = None
    """(2, 3), the bounding box's lowest and highest corner, where the annotation gives it [model
    units]."""

    def find_mesh(self) -> Mesh | None:
        """Read the mesh; None where there is none. Raises DataError if it cannot be read."""
        if isinstance(self.mesh, Path):
            return load_mesh(self.mesh)
        return self.mesh() if callable(self.mesh) else self.mesh

    def load_mesh(self) -> Mesh:
        """Read the mesh; raises DataError if there is none, or it cannot be read."""
        mesh = self.find_mesh()
        if mesh is None:
            raise DataError("there is no mesh of this model", where=f"model {self.model_id}")
        return mesh

    def load_keypoints(self) -> NamedPoints | None:
        """Read the named keypoints; None where there are none. Raises DataError as `load_mesh`."""
        return self.keypoints() if callable(self.keypoints) else self.keypoints


@dataclass(frozen=True, eq=False)
class Truth:
    """The known parts of an object's pose; anything may be missing."""

    cam_from_model: Alignment | None = None
    """Pose and stretch of the CAD model in the camera frame, where all of it is annotated."""
    box: Box | None = None
    """The object's oriented box in the camera frame."""
    camera: Camera | None = None
    """The camera that the pose was annotated with, where it is not the photo's: the pose fits the
    photo under this camera, and its translation and focal length are conventions."""
    metres: float | None = None
    """Length of one unit of the camera frame [m]; None where the size is not known."""

    @property
    def rotation(self) -> FloatArray | None:
        """The rotation from model to camera, (3, 3) float; None where it is not known."""
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
    """What is known of its pose."""
    keypoints: PhotoKeypoints | None = None
    """Keypoints marked in the photo."""
    model: CadModel | None = None
    """The CAD model annotated for it."""
    symmetry: Symmetry = field(default_factory=_no_symmetry)
    """Motions that take the model to itself."""
    mask_path: Path | None = None
    """An image of the object's pixels; see `read_mask`."""
    bbox: FloatArray | None = None
    """(4,), left, top, right and bottom of its rectangle in the photo [px]."""

    def read_mask(self) -> BoolArray:
        """Read the object's pixels, (h, w) bool; raises DataError if there are none."""
        if self.mask_path is None:
            raise DataError("this object has no mask", where=f"object {self.object_id}")
        with open_photo(self.mask_path) as image:
            return np.asarray(image.convert("L")) > 0


@dataclass(frozen=True, eq=False)
class Photo:
    """One photo with the objects in it."""

    name: str
    """The photo's name within its data set; no other has it."""
    image: Path | None
    """The image's file; None where it is not there."""
    camera: Camera | None
    """Its camera, `Camera.without_focal` where the focal length is unknown; None where not even the
    image's size is."""
    objects: tuple[PhotoObject, ...]
    """The objects whose annotation could be read."""
    up: FloatArray | None = None
    """(3,), the direction against gravity in the camera's frame, as a sensor or the rig
    has it."""
    problems: tuple[DataError, ...] = ()
    """Why further objects of this photo could not be read."""

    def read_image(self) -> ByteImage:
        """Read the photo's pixels, (h, w, 3) uint8; raises DataError if there are none."""
        if self.image is None:
            raise DataError("the image of this photo is not there", where=self.name)
        return read_photo(self.image)


class PhotoDataset(RecordSet[Photo]):
    """A data set of photos; see `cadalign.datasets.records.RecordSet`.

    Objects that could not be read in a photo are among the `problems`, too.

    Examples
    --------
    >>> for photo in cadalign.datasets.open("pix3d"):  # doctest: +SKIP
    ...     for found in photo.objects:
    ...         print(photo.name, found.category, found.truth.cam_from_model)
    """

    kind = "photos"
    noun = "photo"
    patterns: tuple[str, ...] = ("*.json",)
    """Patterns of the annotations' files, below the folder."""

    def __iter__(self) -> Iterator[Photo]:
        for photo in super().__iter__():
            for number, problem in enumerate(photo.problems):
                self._tell(f"{photo.name}, problem {number + 1}", problem)
            yield photo

    def annotation_files(self) -> list[Path]:
        """List the files of the annotations, by which a run knows those that it began with."""
        found = (path for pattern in self.patterns for path in self.root.glob(pattern))
        return sorted({path for path in found if path.is_file()})


def read_each(
    records: Iterable[_Record], read: Callable[[int, _Record], PhotoObject | None], *, where: str
) -> tuple[tuple[PhotoObject, ...], tuple[DataError, ...]]:
    """Read a photo's objects, and the reasons why some could not be read.

    ``read`` makes the object of a number and a record, None for one that is left out on purpose;
    ``where`` is the place of the records, for messages.
    """
    found: list[PhotoObject] = []
    problems: list[DataError] = []
    for number, record in enumerate(records):
        try:
            each = read(number, record)
        except CadalignError as error:
            place = f"{where}, object {number}"
            if error.where:
                has_file = error.where.startswith(where)
                place = error.where if has_file else f"{place}: {error.where}"
            problems.append(DataError(error.what, where=place, fix=error.fix))
            continue
        if each is not None:
            found.append(each)
    return tuple(found), tuple(problems)


def read_matrix(path: Path, shape: tuple[int | None, int]) -> FloatArray:
    """Read a text file of a matrix, a row on each line; None for any number of rows.

    Raises DataError if it cannot be read, or is not a matrix of finite numbers of this shape.
    """
    rows = [line.split() for line in read_text(path).splitlines() if line.strip()]
    try:
        matrix = np.array(rows, dtype=np.float64)
    except ValueError:
        raise damaged("not a table of numbers", path) from None
    with in_file(path):
        return as_floats(matrix, name="matrix", shape=shape)


def existing(path: Path) -> Path | None:
    """The path if there is such a file, else None; also of a name that no file can have."""
    return path if os.path.isfile(path) else None


def first_existing(paths: Iterable[Path]) -> Path | None:
    """The first of the paths that is a file; None where none is."""
    return next((path for path in paths if existing(path)), None)
