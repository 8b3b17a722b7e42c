"""Recognise the format of a data set of photos or correspondences, and open it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from cadalign.datasets.colmap import Colmap
from cadalign.datasets.correspondences import BlindPnP, CorrespondenceSet
from cadalign.datasets.pascal3d import Pascal3D
from cadalign.datasets.photo import PhotoDataset
from cadalign.datasets.pix3d import Pix3D
from cadalign.datasets.scan2cad import Scan2CAD
from cadalign.errors import DataError
from cadalign.io.files import as_path

PHOTO_FORMATS = (Scan2CAD, Pix3D, Pascal3D)
"""Formats of photos, in the order in which they are tried."""
CORRESPONDENCE_FORMATS = (Colmap, BlindPnP)
"""Formats of correspondences, in the order in which they are tried."""


def open_photos(path: str | os.PathLike[str]) -> PhotoDataset:
    """Open a data set of photos; the format is recognised by its files.

    Parameters
    ----------
    path : str or path-like
        The data set's folder; `Scan2CAD`, `Pix3D` and `Pascal3D` describe its layout.

    Returns
    -------
    PhotoDataset
        The data set; `PhotoDataset.kind` names its format.

    Raises
    ------
    DataError
        If the folder is missing, has no known format, or cannot be read.

    Examples
    --------
    >>> dataset = cadalign.datasets.open("pix3d")  # doctest: +SKIP
    >>> dataset  # doctest: +SKIP
    Pix3D('pix3d'): 10069 photos
    """
    found: PhotoDataset = _open_folder(path, PHOTO_FORMATS, "photos")
    return found


def open_correspondences(path: str | os.PathLike[str]) -> CorrespondenceSet:
    """Open a set of correspondences; the format is recognised by its files.

    Parameters
    ----------
    path : str or path-like
        The folder; `Colmap` and `BlindPnP` describe its layout.

    Raises
    ------
    DataError
        If the folder is missing, has no known format, or cannot be read.

    Examples
    --------
    >>> open_correspondences("reconstruction")  # doctest: +SKIP
    Colmap('reconstruction/images.txt'): 4 images
    """
    found: CorrespondenceSet = _open_folder(path, CORRESPONDENCE_FORMATS, "correspondences")
    return found


def _open_folder(path: str | os.PathLike[str], formats: Sequence[Any], content: str) -> Any:
    folder = as_path(path)
    if not folder.is_dir():
        raise DataError("no such folder", where=repr(str(path)), fix="give a data set's folder")
    for each in formats:
        if each.is_here(folder):
            return each(folder)
    what = f"no data set of {content} is recognised in this folder"
    fix = f"known formats: {'; '.join(each.signature for each in formats)}"
    raise DataError(what, where=str(folder), fix=fix)
