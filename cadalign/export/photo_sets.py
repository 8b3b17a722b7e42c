"""Annotated photos as data sets in the forms that `cadalign.datasets.open` reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.photos.formats import PHOTO_FORMATS, write_photos
from cadalign.datasets.photos.photo import (
    CadModel,
    LoadedModel,
    NamedPoints,
    Photo,
    PhotoKeypoints,
    PhotoObject,
    Truth,
)
from cadalign.errors import InputError
from cadalign.export.aligned_object import AlignedObject

FORMS = tuple(each.name for each in PHOTO_FORMATS if each.write is not None)
"""Names of the forms."""


@dataclass(frozen=True, eq=False)
class AnnotatedPhoto:
    """A photo with its aligned object and its keypoints.

    Parameters
    ----------
    exported : AlignedObject
        With a mesh, and with the photo as its only view. Its ids are the keypoints' names.
    image : Path
        The photo.
    category : str
        What the object is, such as ``chair``.
    mask : Path, optional
        Image of the object's pixels.
    up : (3,) float, optional
        Direction in the camera that is up in the scene; that of a level camera by default.
    """

    exported: AlignedObject
    image: Path
    category: str = "object"
    mask: Path | None = None
    up: FloatArray | None = None

    def to_photo(self) -> Photo:
        """The photo as data sets have it."""
        (found,) = photos_of(self.exported, category=self.category, mask=self.mask)
        return Photo(self.image.name, self.image, found.camera, found.objects, up=self.up)


def photos_of(
    exported: AlignedObject, *, category: str = "object", mask: Path | None = None
) -> tuple[Photo, ...]:
    """The views of an aligned object as photos of a data set.

    Parameters
    ----------
    exported : AlignedObject
    category : str
        What the object is.
    mask : Path, optional
        Image of the object's pixels.
    """
    names = tuple(str(name) for name in exported.ids)
    model = CadModel(
        exported.name,
        LoadedModel(exported.mesh, NamedPoints(names, exported.points_3d)),
        bounds=exported.bounds if exported.mesh or names else None,
    )
    photos = []
    for number, view in enumerate(exported.views):
        marked = tuple(str(name) for name in view.ids)
        found = PhotoObject(
            object_id="0",
            category=category,
            truth=Truth(view.cam_from_model, metres=exported.metres),
            keypoints=PhotoKeypoints(view.points_2d, marked, np.ones(len(marked), dtype=bool)),
            model=model,
            mask_path=mask,
        )
        image = view.image if isinstance(view.image, Path) else None
        name = view.image_name or f"{number}.png"
        photos.append(Photo(name, image, view.camera, (found,)))
    return tuple(photos)


def write_photo_set(
    folder: Path, photos: Sequence[AnnotatedPhoto], form: str
) -> tuple[InputError, ...]:
    """Write annotated photos as a data set; see `cadalign.datasets.write_photos`.

    Raises
    ------
    InputError
        If the form is unknown, or there is no photo that it can hold.
    DataError
        If the folder has files, or cannot be written to.
    """
    if not photos and form in FORMS:
        fix = "place at least four pairs"
        raise InputError("no photo has an alignment yet", where="export", fix=fix)
    return write_photos(folder, [photo.to_photo() for photo in photos], form)
