"""Bundler's output file, version 0.3."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import DataError
from cadalign.io.files import reading

_HEADER = "# Bundle file v0.3"
_CAMERA_VALUES = 15
# A point: xyz, colour, the number of its views; then the views.
_POINT_VALUES = 7
_VIEW_VALUES = 4
_CUT = "the file is cut short or damaged; get it again"


@dataclass(frozen=True, eq=False)
class BundlerModel:
    """Content of the file.

    Parameters
    ----------
    cameras : (c, 15) float
        Focal length [px], k1, k2, rotation (row by row) and translation, world to camera; zeros
        for a photo without a pose.
    points : (m, 3) float
        Points.
    view_points : (v,) int
        The point that each observation shows, observations ordered by camera.
    view_pixels : (v, 2) float
        Where, from the middle of the image [px], x to the right and y up.
    view_starts : (c + 1,) int
        Where each camera's observations begin.
    """

    cameras: FloatArray
    points: FloatArray
    view_points: IntArray
    view_pixels: FloatArray
    view_starts: IntArray

    def views(self, camera: int) -> tuple[IntArray, FloatArray]:
        """One camera's observations: points (n,) and positions (n, 2)."""
        chosen = slice(self.view_starts[camera], self.view_starts[camera + 1])
        return self.view_points[chosen], self.view_pixels[chosen]


def read_bundler(path: Path) -> BundlerModel:
    """Read the file."""
    values = _read_values(path)
    if len(values) < 2:
        raise DataError("the numbers of cameras and points are missing", where=str(path), fix=_CUT)
    camera_count, point_count = (_as_count(value, path, "the first line") for value in values[:2])
    start = 2 + _CAMERA_VALUES * camera_count
    if start > len(values):
        raise DataError(
            f"the file ends within camera {(len(values) - 2) // _CAMERA_VALUES} of {camera_count}",
            where=str(path),
            fix=_CUT,
        )
    points, views = _read_points(values, start, point_count, path)
    view_points = np.repeat(np.arange(point_count), [len(each) for each in views])
    table = np.concatenate([np.empty((0, _VIEW_VALUES)), *views])
    cameras = table[:, 0]
    bad = np.flatnonzero(~((cameras >= 0) & (cameras < camera_count) & (cameras % 1 == 0)))
    if len(bad):
        raise DataError(
            f"point {view_points[bad[0]]} is observed in camera {cameras[bad[0]]:g}, which doesn't "
            f"exist; there are {camera_count}",
            where=str(path),
            fix=_CUT,
        )
    order = np.argsort(cameras, kind="stable")
    return BundlerModel(
        cameras=values[2:start].reshape(-1, _CAMERA_VALUES),
        points=points,
        view_points=view_points[order],
        view_pixels=table[order, 2:],
        view_starts=np.searchsorted(cameras[order], np.arange(camera_count + 1)),
    )


def _read_points(
    values: FloatArray, start: int, count: int, path: Path
) -> tuple[FloatArray, list[FloatArray]]:
    """Coordinates (count, 3), and for each point its views (k, 4): camera, key, x, y."""
    points = []
    views = []
    for row in range(count):
        end = start + _POINT_VALUES
        if end <= len(values):
            points.append(values[start : start + 3])
            start, end = end, end + _VIEW_VALUES * _as_count(values[end - 1], path, f"point {row}")
        if end > len(values):
            raise DataError(
                f"the file ends within point {row} of {count}", where=str(path), fix=_CUT
            )
        views.append(values[start:end].reshape(-1, _VIEW_VALUES))
        start = end
    if start < len(values):
        raise DataError(
            f"{len(values) - start} values too many after the last of {count} points",
            where=str(path),
            fix=_CUT,
        )
    return np.array(points, dtype=float).reshape(-1, 3), views


def _read_values(path: Path) -> FloatArray:
    with reading(path):
        text = path.read_text(encoding="utf-8", errors="replace")
    header, _, body = text.partition("\n")
    if header.strip() != _HEADER:
        raise DataError(
            f"begins with {header.strip()[:40]!r}",
            where=str(path),
            fix=f"only files that begin with {_HEADER!r} can be read",
        )
    try:
        # Deprecated for a long time: to stop at text that is no number with a mere warning.
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)
            return np.fromstring(body, dtype=float, sep=" ")
    except (ValueError, DeprecationWarning):
        raise _not_a_number(body, path) from None


def _not_a_number(body: str, path: Path) -> DataError:
    for number, line in enumerate(body.split("\n"), start=2):
        for word in line.split():
            try:
                float(word)
            except ValueError:
                return DataError(
                    f"{word[:40]!r} is not a number", where=f"{path}, line {number}", fix=_CUT
                )
    return DataError("holds something else than numbers", where=str(path), fix=_CUT)


def _as_count(value: float, path: Path, where: str) -> int:
    if not (0 <= value < np.inf and value % 1 == 0):
        raise DataError(f"{value:g} is not a number of things", where=f"{path}, {where}", fix=_CUT)
    return int(value)
