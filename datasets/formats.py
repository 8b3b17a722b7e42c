"""Formats of photos and of correspondences: which one lies in a folder, opening and writing it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cadalign.datasets.photos import bop, kitti, pascal3d, pix3d, posed_photos, scan2cad
from cadalign.datasets.photos.dataset import PhotoDataset, PhotoFormat
from cadalign.datasets.photos.photo import Photo
from cadalign.datasets.photos.placed import placed_objects
from cadalign.datasets.sfm import blind_pnp, colmap
from cadalign.datasets.sfm.correspondences import CorrespondenceSet
from cadalign.errors import DataError, InputError, all_left_out, unknown
from cadalign.io.files import as_path, writing

PHOTO_FORMATS = (
    scan2cad.FORMAT,
    pix3d.FORMAT,
    bop.FORMAT,
    kitti.FORMAT,
    pascal3d.FORMAT,
    pascal3d.DETECTIONS,
    posed_photos.FORMAT,
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
        `Pascal3D`, `Pascal3DDetections`, `PosedPhotos`.
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
    the stretched mesh as the model; KITTI has boxes that stand upright alone. Written lengths are
    metres (`Truth.metres`) or, in BOP, millimetres.

    Parameters
    ----------
    path : str or path-like
        A new or empty folder.
    photos : iterable of Photo
    form : str
        The `PhotoFormat.name` of a format with a writer: pix3d, bop, scan2cad, kitti.
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
            raise all_left_out(problems)
    except BaseException:  # what is half written would be in the way of another try
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return tuple(problems)


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
