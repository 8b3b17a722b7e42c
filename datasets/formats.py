"""Formats of photos and of correspondences: which one lies in a folder, and opening it."""

from __future__ import annotations

import os
from pathlib import Path

from cadalign.datasets.photos.dataset import PhotoDataset
from cadalign.datasets.photos.pascal3d import Pascal3D, Pascal3DDetections
from cadalign.datasets.photos.pix3d import Pix3D
from cadalign.datasets.photos.scan2cad import Scan2CAD
from cadalign.datasets.sfm.blind_pnp import BlindPnP
from cadalign.datasets.sfm.colmap import Colmap
from cadalign.datasets.sfm.correspondences import CorrespondenceSet
from cadalign.errors import DataError, InputError
from cadalign.io.files import as_path

PHOTO_FORMATS = (Scan2CAD, Pix3D, Pascal3D, Pascal3DDetections)
"""The known formats, in the order in which they are looked for."""


def open_photos(path: str | os.PathLike[str]) -> PhotoDataset:
    """Open the data set of photos that lies in a folder, whichever format it has.

    Parameters
    ----------
    path : str or path-like
        The folder; see the classes for what may lie in it: `Scan2CAD`, `Pix3D`, `Pascal3D`,
        `Pascal3DDetections`.

    Returns
    -------
    PhotoDataset
        Its `PhotoDataset.kind` names the format.

    Raises
    ------
    DataError
        If there is no such folder, no known format in it, or it cannot be read.

    Examples
    --------
    >>> dataset = cadalign.datasets.open("pix3d")  # doctest: +SKIP
    >>> dataset  # doctest: +SKIP
    Pix3D('pix3d'): 10069 photos
    """
    folder = as_path(path)
    if "\0" in str(path) or not folder.is_dir():
        raise DataError("no such folder", where=repr(str(path)), fix="give a data set's folder")
    for each in PHOTO_FORMATS:
        if each.is_here(folder):
            return each(folder)
    what = "no data set of photos is recognised in this folder"
    fix = f"known are: {'; '.join(each.signature for each in PHOTO_FORMATS)}"
    raise DataError(what, where=str(folder), fix=fix)


_FORMATS: dict[str, type[Colmap] | type[BlindPnP]] = {"colmap": Colmap, "blind-pnp": BlindPnP}
AUTO = "auto"
"""Recognise the format by the names of the files."""
CORRESPONDENCE_FORMATS = (AUTO, *_FORMATS)
"""The names that `open_correspondences` knows."""


def open_correspondences(path: str | os.PathLike[str], *, format: str = AUTO) -> CorrespondenceSet:
    """Open correspondences of any format.

    Parameters
    ----------
    path : str or path-like
        A folder, as `Colmap` or `BlindPnP` takes it.
    format : {"auto", "colmap", "blind-pnp"}
        ``auto`` goes by the names of the files.

    Raises
    ------
    InputError
        If the format is unknown.
    DataError
        If no format or several are recognised, or the loader refuses the files.

    Examples
    --------
    >>> open_correspondences("reconstruction")  # doctest: +SKIP
    Colmap('reconstruction/images.txt'): 4 images
    """
    if format not in CORRESPONDENCE_FORMATS:
        fix = f"known are {', '.join(CORRESPONDENCE_FORMATS)}"
        raise InputError(f"unknown format {format!r}", where="format", fix=fix)
    root = as_path(path)
    return _FORMATS[_recognize(root) if format == AUTO else format](root)


def _recognize(root: Path) -> str:
    if not root.is_dir():
        fix = "give the folder of the correspondences"
        raise DataError("no such folder", where=str(root), fix=fix)
    found = [name for name, known in _FORMATS.items() if known.is_here(root)]
    if not found:
        sought = "; ".join(f"{name}: {known.signature}" for name, known in _FORMATS.items())
        what = f"there are no correspondences of a known format. Looked for {sought}"
        raise DataError(what, where=str(root), fix="give the folder that holds such files")
    if len(found) > 1:
        what = f"the folder holds files of {' and '.join(found)}"
        raise DataError(what, where=str(root), fix="say which format to read")
    return found[0]
