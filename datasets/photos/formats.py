"""The formats of data sets of photos: which one lies in a folder, and writing any of them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Sequence

from cadalign.datasets.photos import bop, kitti, objectron, pascal3d, pix3d, posed_photos, scan2cad
from cadalign.datasets.photos.dataset import PhotoDataset, PhotoFormat
from cadalign.datasets.photos.photo import Photo
from cadalign.datasets.photos.placed import placed_objects
from cadalign.errors import DataError, InputError, unknown
from cadalign.io.files import as_path, writing

PHOTO_FORMATS = (
    scan2cad.FORMAT,
    pix3d.FORMAT,
    bop.FORMAT,
    kitti.FORMAT,
    pascal3d.FORMAT,
    pascal3d.DETECTIONS,
    posed_photos.FORMAT,
    objectron.FORMAT,
)
"""The known formats, in the order in which they are looked for."""


def open_photos(
    path: str | os.PathLike[str], *, formats: Sequence[PhotoFormat] = PHOTO_FORMATS
) -> PhotoDataset:
    """Open the data set of photos that lies in a folder, whichever format it has.

    Parameters
    ----------
    path : str or path-like
        The folder; see the classes for what may lie in it: `Scan2CAD`, `Pix3D`, `Bop`, `KittiCars`,
        `Pascal3D`, `Pascal3DDetections`, `PosedPhotos`, `Objectron`.
    formats : sequence of PhotoFormat
        The formats that are looked for, in this order.

    Returns
    -------
    PhotoDataset
        Its `PhotoDataset.kind` names the format, `PhotoDataset.summary` counts what is in it.

    Raises
    ------
    DataError
        If there is no such folder, no known format in it, or it cannot be read.

    Examples
    --------
    >>> dataset = cadalign.datasets.open("KITTI/training")  # doctest: +SKIP
    >>> dataset  # doctest: +SKIP
    KittiCars('KITTI/training'): 7481 photos
    """
    folder = as_path(path)
    if "\0" in str(path) or not folder.is_dir():
        raise DataError("no such folder", where=repr(str(path)), fix="give a data set's folder")
    for each in formats:
        if each.is_here(folder):
            return each.open(folder)
    what = "no data set of photos is recognised in this folder"
    fix = f"known are: {'; '.join(each.signature for each in formats)}"
    raise DataError(what, where=str(folder), fix=fix)


def write_photos(
    path: str | os.PathLike[str],
    photos: Iterable[Photo],
    form: str,
    *,
    formats: Sequence[PhotoFormat] = PHOTO_FORMATS,
) -> tuple[InputError, ...]:
    """Write photos as a data set that `open_photos` reads: from annotations, or another data set.

    Each object becomes a photo of its own. Poses, keypoints, cameras and photos are read back as
    they were given, and masks where the form has them. Forms without a stretch (Pix3D, BOP) have
    the stretched mesh as the model; KITTI has boxes that stand upright alone; Objectron the
    model's box in place of the model. Written lengths are metres (`Truth.metres`) or, in BOP,
    millimetres.

    Parameters
    ----------
    path : str or path-like
        A new or empty folder.
    photos : iterable of Photo
    form : str
        The `PhotoFormat.name` of a format with a writer: pix3d, bop, scan2cad, kitti, objectron.
    formats : sequence of PhotoFormat
        The formats that are known.

    Returns
    -------
    tuple of InputError
        Why some of the objects were left out: they lack something, or the form cannot hold them.

    Raises
    ------
    InputError
        If the form is unknown, or there is no object that it can hold.
    DataError
        If the folder has files or cannot be written to, or a photo cannot be read.

    Examples
    --------
    >>> write_photos("pix3d", cadalign.datasets.open("lmo"), "pix3d")  # doctest: +SKIP
    ()
    """
    folder = as_path(path)
    writers = {each.name: each.write for each in formats if each.write is not None}
    if form not in writers:
        raise unknown("form", form, writers)
    photos = list(photos)
    count = sum(len(photo.objects) for photo in photos)
    if not count:
        raise InputError("there is no object to write", where="photos")
    with writing(folder):
        if folder.exists() and any(folder.iterdir()):
            raise DataError("the folder is not empty", where=str(folder), fix="give a new one")
        folder.mkdir(parents=True, exist_ok=True)
    problems: list[InputError] = []
    try:
        problems += writers[form](folder, placed_objects(photos, problems))
        if len(problems) == count:
            raise problems[0]
    except BaseException:  # what is half written would be in the way of another try
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return tuple(problems)
