"""Correspondences of any format: which one a folder holds, and its loader."""

from __future__ import annotations

import os
from pathlib import Path

from cadalign.datasets.sfm import blind_pnp, bundler, colmap
from cadalign.datasets.sfm.correspondences import (
    CorrespondenceFormat,
    CorrespondenceSet,
    begins_with,
)
from cadalign.errors import DataError, InputError

AUTO = "auto"
"""Recognise the format by the names of the files."""
_FORMATS = (colmap.FORMAT, bundler.FORMAT, blind_pnp.FORMAT)
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


def _recognize(root: Path) -> CorrespondenceFormat:
    if root.is_file():
        if begins_with(root, bundler.FORMAT.header):
            return bundler.FORMAT
        raise DataError(
            f"not a Bundler file: it does not begin with {bundler.FORMAT.header.decode()!r}",
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
