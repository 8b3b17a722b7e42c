"""Formats of photos and of correspondences: which one lies in a folder, and opening it."""

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
"""The known formats of photos, in the order in which they are looked for."""
CORRESPONDENCE_FORMATS = (Colmap, BlindPnP)
"""The known formats of correspondences, in the order in which they are looked for."""


def open_photos(path: str | os.PathLike[str]) -> PhotoDataset:
    """Open the data set of photos that lies in a folder, whichever format it has.

    Parameters
    ----------
    path : str or path-like
        The folder; see the classes for what may lie in it: `Scan2CAD`, `Pix3D`, `Pascal3D`.

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
    found: PhotoDataset = _opened(path, PHOTO_FORMATS, "photos")
    return found


def open_correspondences(path: str | os.PathLike[str]) -> CorrespondenceSet:
    """Open correspondences of any format.

    Parameters
    ----------
    path : str or path-like
        A folder, as `Colmap` or `BlindPnP` takes it.

    Raises
    ------
    DataError
        If there is no such folder, no known format in it, or it cannot be read.

    Examples
    --------
    >>> open_correspondences("reconstruction")  # doctest: +SKIP
    Colmap('reconstruction/images.txt'): 4 images
    """
    found: CorrespondenceSet = _opened(path, CORRESPONDENCE_FORMATS, "correspondences")
    return found


def _opened(path: str | os.PathLike[str], formats: Sequence[Any], content: str) -> Any:
    folder = as_path(path)
    if not folder.is_dir():
        raise DataError("no such folder", where=repr(str(path)), fix="give a data set's folder")
    for each in formats:
        if each.is_here(folder):
            return each(folder)
    what = f"no data set of {content} is recognised in this folder"
    fix = f"known are: {'; '.join(each.signature for each in formats)}"
    raise DataError(what, where=str(folder), fix=fix)
