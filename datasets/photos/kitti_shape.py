"""The linear shape model of a car that lies beside files of cars' keypoints.

::

    car_tracks.json     names and places of the mean car's keypoints [m]
    meanShape_2.txt     the same mean in another unit and frame, k x 3
    vectors2.txt        modes of deformation of unit norm, in that frame, each 3 k numbers

After Krishna et al., "Reconstructing Vehicles from a Single Image: Shape Priors for Road Scene
Understanding", ICRA 2017.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Raw

from cadalign.arrays import FloatArray
from cadalign.datasets.photos.kitti_keypoints import TRACKS, MeanCar, car_bounds
from cadalign.datasets.photos.records import parse, read_table
from cadalign.errors import DataError
from cadalign.io.documents import convert, in_file
from cadalign.io.files import damaged, read_text
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.reflections import find_reflection

_MEAN, _MODES = "meanShape_2.txt", "vectors2.txt"
_LENGTH_SIGMAS = (0.05, 0.11, 0.08)  # of the logs of width, length, height of cars in KITTI
_MODE_DEVIATION = 1.5  # of modes of unit norm, on a mean of about 8 units of length
_REST = 0.03  # what the modes leave of a keypoint's place [m]


def car_shape(folder: Path) -> ShapeModel | None:
    """The shape model of the cars of a folder, in metres; None without its three files.

    Raises
    ------
    DataError
        If a file cannot be read, or their sizes disagree.
    """
    paths = [folder / name for name in (TRACKS, _MEAN, _MODES)]
    if not all(path.is_file() for path in paths):
        return None
    car = _mean_car(paths[0])
    points = np.array(car.model_xyz, dtype=float).reshape(-1, 3)
    mean = _numbers(paths[1], len(points) * 3).reshape(-1, 3)
    modes = _numbers(paths[2], len(points) * 3).reshape(-1, len(points), 3)
    box = car_bounds(points)
    metres, *_ = np.linalg.lstsq(mean - mean.mean(axis=0), points - points.mean(axis=0), rcond=None)
    return ShapeModel.from_basis(
        points,
        modes @ metres,
        np.full(len(modes), _MODE_DEVIATION),
        names=car.names,
        box=box,
        residual_sigma=_REST,
        size_sigma=_LENGTH_SIGMAS,
        # The mean of annotated cars is a little skew: its left wheel stands before its right one.
        reflection=find_reflection(np.vstack([points, box])[None], car.names, axis=0),
        category="Car",
        up_axis="z",
        unit="m",
    )


def _mean_car(path: Path) -> MeanCar:
    table = read_table(path)
    raw: dict[str, Any] = {
        name: parse(table.get(name, Raw(b"null")), Any, path=path, where=name)
        for name in ("names", "model_xyz")
    }
    with in_file(path):
        found: MeanCar = convert(raw, MeanCar)
    return found


def _numbers(path: Path, multiple: int) -> FloatArray:
    """All numbers of a text file, a multiple of so many."""
    text = read_text(path)
    try:
        values = np.array(text.split(), dtype=np.float64)
    except ValueError:
        raise damaged("not a table of numbers", path) from None
    if not len(values) or len(values) % multiple:
        what = f"{len(values)} numbers are not a multiple of {multiple}"
        raise DataError(what, where=str(path))
    if not np.isfinite(values).all():
        raise DataError("some of its numbers are not finite", where=str(path))
    return values
