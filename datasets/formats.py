"""Formats of photos and of correspondences: which one lies in a folder, and opening it."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cadalign.datasets.photos.dataset import PhotoDataset
from cadalign.datasets.photos.pascal3d import Pascal3D, Pascal3DDetections
from cadalign.datasets.photos.pix3d import Pix3D
from cadalign.datasets.photos.scan2cad import Scan2CAD
from cadalign.datasets.sfm import blind_pnp, colmap
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
        Its `PhotoDataset.kind` names the format, `PhotoDataset.summary` counts what is in it.

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


@dataclass(frozen=True)
class _Format:
    """A format of correspondences, and the files that it is recognised by."""

    load: Callable[[Path], CorrespondenceSet]  # makes the set of a folder
    sought: str  # the files of this format, for messages
    layouts: tuple[tuple[str, ...], ...]
    """The files below a folder, which all belong to one of the layouts."""

    def fit(self, folder: Path) -> int:
        """2 for a folder that holds all files of a layout, 1 for some of them, 0 for none."""
        best = 0
        for layout in self.layouts:
            files = [(folder / name).is_file() for name in layout]
            if all(files):
                return 2
            best = max(best, int(any(files)))
        return best


_FORMATS = {
    "colmap": _Format(
        colmap.Colmap,
        "cameras, images and points3D (.bin or .txt; also in sparse/0, sparse or 0)",
        colmap.LAYOUTS,
    ),
    "blind-pnp": _Format(
        blind_pnp.BlindPnP,
        "matches.pkl, R.pkl and t.pkl, or p2d.pkl, p3d.pkl, R_gt.pkl and t_gt.pkl "
        "(also in preprocessed)",
        blind_pnp.LAYOUTS,
    ),
}
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
    Colmap('reconstruction/images.txt', 4 images)
    """
    if format not in CORRESPONDENCE_FORMATS:
        fix = f"known are {', '.join(CORRESPONDENCE_FORMATS)}"
        raise InputError(f"unknown format {format!r}", where="format", fix=fix)
    root = as_path(path)
    return _FORMATS[_recognize(root) if format == AUTO else format].load(root)


def _recognize(root: Path) -> str:
    if not root.is_dir():
        fix = "give the folder of the correspondences"
        raise DataError("no such folder", where=str(root), fix=fix)
    # A layout with files missing is better named by its loader, which says which ones.
    fits = {name: known.fit(root) for name, known in _FORMATS.items()}
    found = [name for name, fit in fits.items() if fit and fit == max(fits.values())]
    if not found:
        sought = "; ".join(f"{name}: {known.sought}" for name, known in _FORMATS.items())
        what = f"there are no correspondences of a known format. Looked for {sought}"
        raise DataError(what, where=str(root), fix="give the folder that holds such files")
    if len(found) > 1:
        what = f"the folder holds files of {' and '.join(found)}"
        raise DataError(what, where=str(root), fix="say which format to read")
    return found[0]
