"""One posed object of a photo, in metres, as the writers of data sets take it."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.photos.photo import NamedPoints, Photo, PhotoObject
from cadalign.errors import DataError, InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.mesh import Mesh
from cadalign.io.files import made_folder, write_json, writing
from cadalign.io.images import open_photo, write_image
from cadalign.io.meshes.files import write_obj_mesh

LEVEL_UP = (0.0, -1.0, 0.0)
"""Direction in a level camera that is up in the scene."""
_COPIED = {"JPEG": ".jpg", "PNG": ".png"}
_ORIENTATION = 0x0112  # the EXIF tag
_LEAST = 0.9  # of the cosine between an axis and up that another axis is taken

_Entry = TypeVar("_Entry")


class PlacedObject:
    """An object of a photo whose camera, pose and model are known.

    Raises InputError if the photo has no camera, or the object no pose or no model.
    """

    def __init__(self, photo: Photo, found: PhotoObject) -> None:
        aligned, model = found.truth.cam_from_model, found.model
        if aligned is None or model is None:
            missing = "pose with all scales" if aligned is None else "CAD model"
            what = f"object {found.object_id} has no {missing}, which a data set needs"
            raise InputError(what, where=photo.name)
        metres = found.truth.metres or 1.0
        marks = found.keypoints
        up = np.array(LEVEL_UP) if photo.up is None else photo.up
        self.photo, self.found, self.model = photo, found, model
        self.camera = found.truth.camera or photo.known_camera
        """The camera that the pose fits the photo with."""
        self.camera.require_focal()
        self.category = _file_name(found.category)
        """The category as the name of a folder."""
        self.model_id = _file_name(model.model_id)
        """The model's id as the name of a folder."""
        self.pose = Alignment(aligned.rotation, aligned.translation * metres, np.ones(3))
        """The pose of the stretched model, without stretch [m]."""
        self.scale: FloatArray = aligned.scale * metres
        """Metres per model unit along the model's axes, (3,) float."""
        self.marked = dict(zip(marks.names, marks.points_2d, strict=True)) if marks else {}
        """The pixels (2,) of the marked keypoints by their names."""
        self.up: FloatArray = up / np.linalg.norm(up)
        """The direction in the camera that is up in the scene, of length 1."""

    @cached_property
    def keypoints(self) -> NamedPoints:
        """The model's keypoints, none where it has none."""
        with _left_out():
            return self.model.load_keypoints() or NamedPoints((), np.empty((0, 3)))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the model's keypoints."""
        return self.keypoints.names

    @property
    def points(self) -> FloatArray:
        """The keypoints on the stretched model, (k, 3) float [m]."""
        return self.keypoints.xyz * self.scale

    @property
    def bounds(self) -> FloatArray:
        """Lowest and highest coordinates of the model before the stretch, (2, 3) float."""
        return self.mesh.bounds if self.model.bounds is None else self.model.bounds

    @property
    def sides(self) -> FloatArray:
        """Extents of the stretched model along its axes, (3,) float [m]."""
        return np.asarray(np.ptp(self.bounds, axis=0) * self.scale)

    @property
    def center(self) -> FloatArray:
        """The centre of the model's box in the camera, (3,) float [m]."""
        middle: FloatArray = self.bounds.mean(axis=0) * self.scale
        return np.asarray(self.pose.apply(middle[None])[0])

    @cached_property
    def mesh(self) -> Mesh:
        """The model's mesh; raises InputError where there is none that can be read."""
        with _left_out():
            return self.model.load_mesh()

    @property
    def bbox(self) -> FloatArray:
        """Left, top, right and bottom of the object in the image, (4,) float [px]."""
        if self.found.bbox is not None:
            return self.found.bbox
        with _left_out():
            mesh = self.model.find_mesh()
        points = self.points if mesh is None else mesh.vertices * self.scale
        pixels = self.camera.project_where_ahead(self.pose.apply(points))
        pixels = pixels[np.isfinite(pixels).all(axis=1)]
        if not len(pixels):
            raise InputError("the object lies behind the camera", where=self.photo.name)
        size = np.array([self.camera.width, self.camera.height])
        low, high = (np.clip(f(axis=0), -0.5, size - 0.5) for f in (pixels.min, pixels.max))
        return np.concatenate([low, high])

    def require_plain_camera(self, format: str) -> None:
        """Refuse lens distortion, for which a format has no place."""
        if self.camera.distortion:
            what = f"{format} has no place for lens distortion"
            fix = "undistort the photo and annotate it again"
            raise InputError(what, where=self.photo.name, fix=fix)

    def copy_image(self, stem: Path) -> Path:
        """Copy the photo, upright; a file that is so already is copied as it is."""
        made_folder(stem.parent)
        if isinstance(self.photo.image, Path):
            with _left_out(), open_photo(self.photo.image) as image:
                ending = _COPIED.get(image.format or "")
                is_upright = image.getexif().get(_ORIENTATION, 1) == 1
            if ending is not None and is_upright:
                path = stem.with_name(f"{stem.name}{ending}")
                with writing(path):
                    shutil.copyfile(self.photo.image, path)
                return path
        with _left_out():
            pixels = self.photo.read_image()
        path = stem.with_name(f"{stem.name}.png")
        write_image(path, pixels)
        return path

    def write_mask(self, path: Path) -> Path | None:
        """Write the mask as a PNG, 255 on the object; None without one."""
        if self.found.mask_path is None:
            return None
        made_folder(path.parent)
        with _left_out():
            mask = self.found.read_mask()
        write_image(path, np.where(mask, 255, 0).astype(np.uint8))
        return path

    def write_model(self, path: Path, *, is_stretched: bool) -> None:
        """Write the mesh as OBJ in its own frame: stretched [m], or as it is."""
        mesh = self.mesh
        write_obj_mesh(path, mesh.stretched(self.scale) if is_stretched else mesh)


def placed_objects(
    photos: Iterable[Photo], problems: list[InputError]
) -> Iterator[tuple[int, PlacedObject]]:
    """Objects of photos with their numbers; why others cannot be written is added to problems."""
    for number, (photo, found) in enumerate((p, each) for p in photos for each in p.objects):
        try:
            if photo.image is None:
                raise InputError("the image of this photo is not there", where=photo.name)
            placed = PlacedObject(photo, found)
        except InputError as error:
            problems.append(error)
        else:
            yield number, placed


def converted(
    numbered: Iterable[tuple[int, PlacedObject]], convert: Callable[[int, PlacedObject], _Entry]
) -> tuple[list[_Entry], list[InputError]]:
    """Entries of the objects that a format can hold, and why the others are left out."""
    entries, problems = [], []
    for number, placed in numbered:
        try:
            entries.append(convert(number, placed))
        except InputError as error:
            problems.append(error)
    return entries, problems


def list_writer(
    name: str, convert: Callable[[Path, int, PlacedObject], Any]
) -> Callable[[Path, Iterable[tuple[int, PlacedObject]]], list[InputError]]:
    """The writer of a JSON list of the objects' entries, made in its folder; see `converted`."""

    def write(folder: Path, numbered: Iterable[tuple[int, PlacedObject]]) -> list[InputError]:
        entries, problems = converted(numbered, partial(convert, folder))
        write_json(folder / name, entries)
        return problems

    return write


@contextmanager
def _left_out() -> Iterator[None]:
    """Let what cannot be read of an object be the reason why it is left out."""
    try:
        yield
    except DataError as error:
        raise InputError(error.what, where=error.where, fix=error.fix) from None


def _file_name(text: str) -> str:
    """A text as a name that does not leave its folder."""
    name = re.sub(r"[/\\\0]", "_", text)
    return name if name.strip(".") else f"_{name}"


def upright_rotation(up: FloatArray) -> FloatArray:
    """A rotation (3, 3) that takes a direction of length 1 to z."""
    beside = np.eye(3)[0 if abs(up[0]) < _LEAST else 1]
    x = beside - (beside @ up) * up
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(up, x), up])
