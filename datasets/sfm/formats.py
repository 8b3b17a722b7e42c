"""Correspondences of any format: which one a folder holds, and its loader."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cadalign.datasets.sfm import blind_pnp, bundler, colmap
from cadalign.datasets.sfm.correspondences import CorrespondenceSet
from cadalign.errors import DataError, InputError
from cadalign.io.files import as_path, open_input


@dataclass(frozen=True)
class _Format:
    """A format of correspondences, and the files that it is recognised by."""

    load: Callable[[Path], CorrespondenceSet]  # makes the set of a folder
    sought: str  # the files of this format, for messages
    layouts: tuple[tuple[str, ...], ...]
    """Patterns of the files below a folder, which all belong to one of the layouts."""
    header: bytes = b""  # the first bytes of each file

    def fit(self, folder: Path) -> int:
        """2 for a folder that holds all files of a layout, 1 for some of them, 0 for none."""
        best = 0
        for layout in self.layouts:
            files = [[file for file in folder.glob(name) if file.is_file()] for name in layout]
            if all(any(_begins_with(file, self.header) for file in found) for found in files):
                return 2
            best = max(best, int(any(files)))
        return best


_BUNDLER_HEADER = b"# Bundle file"  # many a program calls its log something.out
_FORMATS = {
    "colmap": _Format(
        colmap.Colmap,
        "cameras, images and points3D (.bin or .txt; also in sparse/0, sparse or 0)",
        colmap.LAYOUTS,
    ),
    "bundler": _Format(
        bundler.Bundler,
        "bundle.out (also in bundle, or one *.out)",
        tuple((pattern,) for pattern in bundler.PATTERNS),
        header=_BUNDLER_HEADER,
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
        A folder, as `Colmap`, `Bundler` or `BlindPnP` takes it, or Bundler's file.
    format : {"auto", "colmap", "bundler", "blind-pnp"}
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
    if root.is_file():
        if _begins_with(root, _BUNDLER_HEADER):
            return "bundler"
        what = f"not a Bundler file: it does not begin with {_BUNDLER_HEADER.decode()!r}"
        raise DataError(what, where=str(root), fix="for other formats, give the folder")
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


def _begins_with(file: Path, header: bytes) -> bool:
    with open_input(file, most=sys.maxsize) as stream:
        return stream.read(len(header)) == header
