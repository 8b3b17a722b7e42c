"""Correspondences of any format: which one a folder holds, and its loader."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cadalign.datasets.sfm.blind_pnp import BlindPnP
from cadalign.datasets.sfm.bundler import Bundler
from cadalign.datasets.sfm.colmap import Colmap
from cadalign.datasets.sfm.correspondences import CorrespondenceSet
from cadalign.errors import DataError, InputError
from cadalign.io.files import open_input

AUTO = "auto"
"""Recognise the format by the names of the files."""
_BUNDLER_HEADER = b"# Bundle file"


@dataclass(frozen=True)
class _Format:
    """A format, and the files that it is recognised by."""

    name: str
    load: Callable[[Path], CorrespondenceSet]
    sought: str  # the files of this format, for messages
    layouts: tuple[tuple[str, ...], ...]  # patterns of files below the folder
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


_FORMATS = (
    _Format(
        "colmap",
        Colmap,
        "cameras, images and points3D (.bin or .txt; also in sparse/0, sparse or 0)",
        tuple(
            tuple(f"{folder}{stem}{suffix}" for stem in ("cameras", "images", "points3D"))
            for folder in ("", "sparse/0/", "sparse/", "0/")
            for suffix in (".bin", ".txt")
        ),
    ),
    _Format(
        "bundler",
        Bundler,
        "bundle.out (also in bundle, or one *.out)",
        (("bundle.out",), ("bundle/bundle.out",), ("*.out",)),
        # Many a program calls its log something.out.
        header=_BUNDLER_HEADER,
    ),
    _Format(
        "blind-pnp",
        BlindPnP,
        "matches.pkl, R.pkl and t.pkl, or p2d.pkl, p3d.pkl, R_gt.pkl and t_gt.pkl "
        "(also in preprocessed)",
        tuple(
            tuple(f"{folder}{stem}.pkl" for stem in stems)
            for folder in ("", "preprocessed/")
            for stems in (("matches", "R", "t"), ("p2d", "p3d", "R_gt", "t_gt"))
        ),
    ),
)
CORRESPONDENCE_FORMATS = (AUTO, *(known.name for known in _FORMATS))
"""The names that `open_correspondences` knows."""


def open_correspondences(path: str | os.PathLike[str], *, format: str = AUTO) -> CorrespondenceSet:
    """Open correspondences of any format.

    Parameters
    ----------
    path : str or path-like
        A folder, as `Colmap`, `Bundler` or `BlindPnP` takes it, or Bundler's file.
    format : {"auto", "colmap", "bundler", "blind-pnp"}
        ``auto`` goes by the names of the files.

    Returns
    -------
    CorrespondenceSet

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
        raise InputError(
            f"unknown format {format!r}",
            where="format",
            fix=f"known are {', '.join(CORRESPONDENCE_FORMATS)}",
        )
    root = Path(path)
    if format == AUTO:
        return _recognize(root).load(root)
    return next(known for known in _FORMATS if known.name == format).load(root)


def _recognize(root: Path) -> _Format:
    if root.is_file():
        if _begins_with(root, _BUNDLER_HEADER):
            return next(known for known in _FORMATS if known.load is Bundler)
        raise DataError(
            f"not a Bundler file: it does not begin with {_BUNDLER_HEADER.decode()!r}",
            where=str(root),
            fix="for other formats, give the folder",
        )
    if not root.is_dir():
        fix = "give the folder of the correspondences"
        raise DataError("no such folder", where=str(root), fix=fix)
    # A layout with files missing is better named by its loader, which says which ones.
    fits = [known.fit(root) for known in _FORMATS]
    found = [known for known, fit in zip(_FORMATS, fits, strict=True) if fit and fit == max(fits)]
    if not found:
        sought = "; ".join(f"{known.name}: {known.sought}" for known in _FORMATS)
        raise DataError(
            f"there are no correspondences of a known format. Looked for {sought}",
            where=str(root),
            fix="give the folder that holds such files",
        )
    if len(found) > 1:
        names = " and ".join(known.name for known in found)
        raise DataError(
            f"the folder holds files of {names}", where=str(root), fix="say which format to read"
        )
    return found[0]


def _begins_with(file: Path, header: bytes) -> bool:
    with open_input(file, most=sys.maxsize) as (stream, _):
        return stream.read(len(header)) == header
