"""Learned shapes that come with the package: statistics of KeypointNet's annotations.

`scripts/learn_shapes.py` writes the files; LICENSE.md has the notice of the data.
"""

from __future__ import annotations

import logging
from pathlib import Path

from cadalign.errors import unknown_name

logger = logging.getLogger("cadalign")

CATEGORIES = (
    *("airplane", "bathtub", "bed", "bottle", "cap", "chair", "guitar", "helmet"),
    *("knife", "laptop", "motorcycle", "mug", "skateboard", "table", "vessel"),
)
_FOLDER = Path(__file__).parent


def category_of(path: Path | None) -> str | None:
    """Return the category that a path names; None for a file, even one of a category's name."""
    if path is None or path.name not in CATEGORIES or path.is_file():
        return None
    return path.name


def shape_path(given: Path) -> Path:
    """Return the shape file that a path means: itself, or the file of the category it names.

    An existing file is preferred, with a warning. Paths in observation files are relative to a
    folder, so only the name counts. Raises InputError for another name without a file.
    """
    if category := category_of(given):
        return _FOLDER / f"{category}.shape"
    if given.name in CATEGORIES:
        text = "%s: this file is used, not the shape of the category that comes with cadalign"
        logger.warning(text, given)
    elif not given.suffix and not given.exists():
        raise unknown_name("shape", given.name, CATEGORIES, where=str(given))
    return given
