"""Files of the learned shapes that come with the package: statistics of KeypointNet's annotations.

`scripts/learn_shapes.py` writes them; LICENSE.md beside them has the notice of the data.
"""

from __future__ import annotations

import logging
import os
from pathlib import Path

from cadalign.errors import unknown_name
from cadalign.io.documents import path_from

logger = logging.getLogger("cadalign")

CATEGORIES = (
    *("airplane", "bathtub", "bed", "bottle", "cap", "chair", "guitar", "helmet"),
    *("knife", "laptop", "motorcycle", "mug", "skateboard", "table", "vessel"),
)
_FOLDER = Path(__file__).parents[1] / "shapes" / "pretrained"


def pretrained_path(category: str) -> Path:
    """Return the shape file of a category; raises InputError if there is none."""
    if category not in CATEGORIES:
        raise unknown_name("category", category, CATEGORIES, where="category")
    return _FOLDER / f"{category}.shape"


def category_of(path: Path | None) -> str | None:
    """Return the category whose file of the package a path is; None for other paths."""
    return path.stem if path is not None and path.parent == _FOLDER else None


def shape_path(name: str | os.PathLike[str], folder: Path | None = None) -> Path:
    """Return the shape file that a path in a folder, or the name of a category, means.

    An existing file of a category's name is preferred, with a warning. Raises InputError for
    another name without an ending and without a file.
    """
    text = os.fspath(name)
    path = path_from(text, folder)
    if path.is_file():
        if text in CATEGORIES:
            warning = (
                "%s: this file is used, not the shape of the category that comes with cadalign"
            )
            logger.warning(warning, path)
    elif text in CATEGORIES:
        return pretrained_path(text)
    elif not path.suffix and not path.exists():
        raise unknown_name("shape", text, CATEGORIES, where="shape")
    return path
