"""Bundler's models: photos with known poses and the points that they see.

Snavely, Seitz and Szeliski, "Photo Tourism", SIGGRAPH 2006. The format is described in the manual
of Bundler 0.4, https://www.cs.cornell.edu/~snavely/bundler/bundler-v0.4-manual.html.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray, parse_numbers
from cadalign.datasets.sfm.correspondences import Correspondences, CorrespondenceSet, rigid_pose
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import OPENGL_AXES
from cadalign.io.files import as_path, damaged, listed, read_text
from cadalign.io.images import open_photo

ImageSize = tuple[int, int]
"""Width and height [px]."""

_IMAGE_SUFFIXES = frozenset((".jpg", ".jpeg", ".png", ".ppm", ".pgm", ".tif", ".tiff", ".bmp"))
# How far keypoints may lie outside the image's pixel centres [px].
_MARGIN = 1.0
PATTERNS = ("bundle.out", "bundle/bundle.out", "*.out")
"""The file in a folder, in the order in which it is looked for."""
_HEADER = "# Bundle file v0.3"
_CAMERA_VALUES = 15
# A point: xyz, colour, the number of its views; then the views.
_POINT_VALUES = 7
_VIEW_VALUES = 4


class Bundler(CorrespondenceSet):
    """The photos of a Bundler model (``bundle.out``, version 0.3), in the file's order.

    Poses are turned into cadalign's axes and observations into its pixels: Bundler's origin is the
    middle of the image, ((w - 1) / 2, (h - 1) / 2), its y points up. The principal point is the
    middle of the image, the distortion (k1, k2).

    Photos that Bundler could not place (focal length 0) are left out; `unplaced` names them. Ids
    are the names in ``list.txt``, or in the folder ``images``, or else the position in the file.

    Parameters
    ----------
    path : str or path-like
        The file, or a folder with one ``*.out`` in it (or in ``bundle``).
    sizes : (width, height), or a sequence of one for each photo of the file, optional
        Image sizes [px]. By default those of the photos, which are sought beside the file: those
        that ``list.txt`` names, or the files of a folder ``images`` in the order of their names if
        they are as many as the file's photos. Where there are none, the smallest size that has
        all of the observations in the image, which does not change any projection.

    Raises
    ------
    DataError
        If the file is missing, cut short or malformed. Asking for an image raises it if its camera
        is invalid or an observation lies outside the photo.
    InputError
        If ``sizes`` don't match the file.
    """

    def __init__(
        self, path: str | os.PathLike[str], *, sizes: ImageSize | Sequence[ImageSize] | None = None
    ) -> None:
        file = _find_file(as_path(path))
        self._model = _read_bundler(file)
        count = len(self._model.cameras)
        self._sizes = _as_sizes(sizes, count)
        names, self._photos = _find_photos(file, count)
        placed = self._model.cameras[:, 0] != 0
        self._rows = np.flatnonzero(placed)
        self.unplaced = tuple(names[row] for row in np.flatnonzero(~placed))
        """The ids of the photos without a pose."""
        super().__init__(file, [names[row] for row in self._rows])

    def _read(self, position: int) -> Correspondences:
        row = int(self._rows[position])
        name = self.ids[position]
        focal, k1, k2 = self._model.cameras[row, :3].tolist()
        views = slice(self._model.view_starts[row], self._model.view_starts[row + 1])
        points, centred = self._model.view_points[views], self._model.view_pixels[views]
        width, height = self._size(row, centred, name)
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        pose = self._model.cameras[row, 3:].reshape(4, 3)
        return Correspondences(
            id=name,
            points_3d=self._model.points[points],
            points_2d=centred * (1, -1) + middle,
            camera=Camera(width, height, focal, focal, middle[0], middle[1], (k1, k2, 0.0, 0.0)),
            cam_from_world=rigid_pose(OPENGL_AXES[:, None] * pose[:3], OPENGL_AXES * pose[3]),
            point_ids=points,
        )

    def _size(self, row: int, centred: FloatArray, name: str) -> ImageSize:
        size, photo = None, self._photos[row]
        if self._sizes is not None:
            size = self._sizes[row]
        elif photo is not None:
            with open_photo(photo) as image:  # not turned upright: Bundler does not either
                size = image.size
        reach = np.abs(centred).max(axis=0, initial=0.0)
        if not np.isfinite(reach).all():
            raise InputError("an observation is NaN or infinite", where="observations")
        if size is None:
            return 2 * int(np.ceil(reach[0])) + 1, 2 * int(np.ceil(reach[1])) + 1
        if (reach > (np.array(size) - 1) / 2 + _MARGIN).any():
            what = f"observations reach {reach[0]:.1f} and {reach[1]:.1f} px from the middle"
            what += f", outside an image of {size[0]} x {size[1]}"
            fix = "give the sizes of the photos that the model was made from"
            raise DataError(what, where=f"{self.source}, image {name}", fix=fix)
        return size


def _find_file(path: Path) -> Path:
    if path.is_file():
        return path
    if not path.is_dir():
        raise DataError("no such file", where=str(path), fix="give a bundle.out")
    for pattern in PATTERNS:
        found = listed(path, pattern)
        if len(found) == 1:
            return found[0]
        if found:
            names = ", ".join(file.name for file in found)
            raise DataError(f"there are {names}", where=str(path), fix="give one of these files")
    raise DataError("there is no bundle.out", where=str(path), fix="give Bundler's output file")


def _find_photos(file: Path, count: int) -> tuple[list[str], list[Path | None]]:
    """Ids and files, where there are any, of a model's list, or of a folder ``images``."""
    # Bundler writes bundle/bundle.out beside list.txt.
    for listing in (file.parent / "list.txt", file.parent.parent / "list.txt"):
        if not listing.is_file():
            continue
        # A line is a path, optionally followed by 0 and the focal length that the EXIF data give.
        lines = read_text(listing, errors="replace").split("\n")
        names = [line.split()[0].removeprefix("./") for line in lines if line.strip()]
        if len(names) != count:
            what = f"names {len(names)} photos, {file.name} has {count}"
            fix = "the list must be the one that the model was made with"
            raise DataError(what, where=str(listing), fix=fix)
        places = ((listing.parent / n, listing.parent / "images" / Path(n).name) for n in names)
        return names, [next(filter(Path.is_file, place), None) for place in places]
    folder = file.parent / "images"
    found = listed(folder) if folder.is_dir() else []
    found = [path for path in found if path.suffix.lower() in _IMAGE_SUFFIXES]
    if len(found) == count:
        return [path.name for path in found], [*found]
    return [str(row) for row in range(count)], [None] * count


def _as_sizes(
    sizes: ImageSize | Sequence[ImageSize] | None, count: int
) -> tuple[ImageSize, ...] | None:
    if sizes is None:
        return None
    array = np.asarray(sizes)
    if array.shape == (2,):
        array = np.tile(array, (count, 1))
    if array.shape != (count, 2) or array.dtype.kind not in "iu" or (array < 1).any():
        what = f"not a (width, height), nor one for each of {count} photos"
        raise InputError(what, where="sizes")
    return tuple((int(width), int(height)) for width, height in array)


# The file -----------------------------------------------------------------------------------------


class _Model(NamedTuple):
    """Content of the file; observations are ordered by camera."""

    # (c, 15) focal length [px], k1, k2, rotation (row by row) and translation, world to camera;
    # zeros for a photo without a pose.
    cameras: FloatArray
    points: FloatArray  # (m, 3)
    view_points: IntArray  # (v,) the point that each observation shows
    view_pixels: FloatArray  # (v, 2) where, from the image's middle [px], x to the right and y up
    view_starts: IntArray  # (c + 1,) where each camera's observations begin


def _read_bundler(path: Path) -> _Model:
    values = _read_values(path)
    if len(values) < 2:
        raise damaged("the numbers of cameras and points are missing", path)
    camera_count, point_count = (_as_count(value, path, "the first line") for value in values[:2])
    start = 2 + _CAMERA_VALUES * camera_count
    if start > len(values):
        camera = (len(values) - 2) // _CAMERA_VALUES
        raise damaged(f"the file ends within camera {camera} of {camera_count}", path)
    points, views = _read_points(values, start, point_count, path)
    view_points = np.repeat(np.arange(point_count), [len(each) for each in views])
    table = np.concatenate([np.empty((0, _VIEW_VALUES)), *views])
    cameras = table[:, 0]
    is_known = (cameras >= 0) & (cameras < camera_count) & (cameras == np.floor(cameras))
    if not is_known.all():
        row = int(np.argmin(is_known))
        seen = f"point {view_points[row]} is observed in camera {cameras[row]:g}"
        raise damaged(f"{seen}, which doesn't exist; there are {camera_count}", path)
    order = np.argsort(cameras, kind="stable")
    return _Model(
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
            raise damaged(f"the file ends within point {row} of {count}", path)
        views.append(values[start:end].reshape(-1, _VIEW_VALUES))
        start = end
    if start < len(values):
        extra = len(values) - start
        raise damaged(f"{extra} values too many after the last of {count} points", path)
    return np.array(points, dtype=float).reshape(-1, 3), views


def _read_values(path: Path) -> FloatArray:
    text = read_text(path, errors="replace")
    header, _, body = text.partition("\n")
    if header.strip() != _HEADER:
        fix = f"only files that begin with {_HEADER!r} can be read"
        raise DataError(f"begins with {header.strip()[:40]!r}", where=str(path), fix=fix)
    plain = body.encode(errors="replace")
    try:
        return parse_numbers(plain, len(plain.split()))
    except ValueError:
        pass
    for number, line in enumerate(body.split("\n"), start=2):
        for word in line.split():
            try:
                float(word)
            except ValueError:
                raise damaged(f"{word[:40]!r} is not a number", f"{path}, line {number}") from None
    raise damaged("holds something else than numbers", path)


def _as_count(value: float, path: Path, where: str) -> int:
    if not (0 <= value < np.inf and value % 1 == 0):
        raise damaged(f"{value:g} is not a number of things", f"{path}, {where}")
    return int(value)
