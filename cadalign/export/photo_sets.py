"""Annotated photos as data sets in the forms that `cadalign.datasets.open` reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cadalign.arrays import FloatArray
from cadalign.datasets.photos.formats import PHOTO_FORMATS, write_photos
from cadalign.datasets.photos.photo import Photo
from cadalign.errors import InputError
from cadalign.export.aligned_object import AlignedObject, photos_of

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
