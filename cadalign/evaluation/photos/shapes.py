"""Shape models that a run on photos is given, or finds in the data set's folder."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cadalign.datasets.photos.kitti_keypoints import car_shape
from cadalign.errors import InputError, quote
from cadalign.shapes.model import ShapeModel


def shapes_of(files: Sequence[Path], folder: Path) -> tuple[ShapeModel, ...]:
    """The shape models of some files, and of the folder for a category that they lack.

    Raises
    ------
    InputError
        If two files are of the same category.
    DataError
        If one cannot be read.
    """
    given = [ShapeModel.open(path) for path in files]
    counts = Counter(each.category for each in given)
    twice = next((name for name, count in counts.items() if count > 1), None)
    if twice is not None:
        what, fix = f"two files are of the category {quote(twice)}", "give one for each category"
        raise InputError(what, where="shape", fix=fix)
    found = car_shape(folder)
    if found is not None and found.category not in counts:
        given.append(found)
    return tuple(given)


def fingerprint(shapes: Sequence[ShapeModel]) -> str:
    """Hash of shape models; empty of none."""
    if not shapes:
        return ""
    digest = hashlib.sha256()
    for shape in shapes:
        digest.update(f"{shape.category}\0{shape.inflation!r}\0{shape.unit}\0".encode())
        for part in shape.components:
            numbers = [part.weight, *part.mean.ravel(), *part.modes.ravel()]
            digest.update(np.append(numbers, part.residual_sigma).tobytes())
    return digest.hexdigest()[:16]
