"""COLMAP's files, text and binary (little endian), see https://colmap.github.io/format.html.

Readers raise `DataError` with the file and the line or offset.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import DataError, brief, quote
from cadalign.geometry.camera_form import COLMAP_PARAMS
from cadalign.io.files import damaged, read_bytes, read_text

INVALID_POINT = -1
"""The point id of an observation that belongs to no point."""


@dataclass(frozen=True, eq=False)
class ColmapView:
    """One image's entry; its pose is camera from world."""

    quat_wxyz: FloatArray  # (4,)
    translation: FloatArray  # (3,)
    camera_id: int
    points_2d: FloatArray  # (n, 2) in COLMAP's pixels, whose centres are at (0.5, 0.5)
    point_ids: IntArray  # (n,) the points that they show, or `INVALID_POINT`


ColmapImage = tuple[str, Callable[[], ColmapView]]
"""An image's name, and the function that reads the rest of its entry."""

ColmapPoints = tuple[IntArray, FloatArray]
"""Numbers (m,) and coordinates (m, 3) of all points, in file order."""

CameraTable = dict[int, dict[str, Any]]
"""Cameras in the form that `cadalign.Camera.from_dict` reads, by number."""


# Binary files -------------------------------------------------------------------------------------


# COLMAP's camera models in the order of their numbers, and how many parameters those have that
# `Camera` doesn't know: a camera nobody asks for must not keep the others from being read.
_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"),
    *("FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
    "RAD_TAN_THIN_PRISM_FISHEYE",
)
_UNSUPPORTED_COUNTS = {"RAD_TAN_THIN_PRISM_FISHEYE": 16}

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # number, model, width, height; parameters follow
_IMAGE = struct.Struct("<I7dI")  # number, wxyz, translation, camera; name and observations follow
_POINT = struct.Struct("<Q3d3Bd")  # number, xyz, colour, error; the track follows
_TRACK_ENTRY = 8
_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point_id", "<i8")])
_PARAMETER = np.dtype("<f8")


def read_cameras_binary(path: Path) -> CameraTable:
    """Read ``cameras.bin``."""
    cursor = _Cursor(path)
    cameras: CameraTable = {}
    for _ in range(cursor.count("cameras")):
        start = cursor.offset
        camera_id, model, width, height = cursor.unpack(_CAMERA, "a camera")
        if not 0 <= model < len(_MODELS):
            # The number of its parameters is unknown, and so is where the next camera begins.
            raise DataError(
                f"camera {camera_id} has the unknown model number {model}",
                where=f"{path}, offset {start}",
                fix="export the model with undistorted images, or as text",
            )
        name = _MODELS[model]
        length = len(COLMAP_PARAMS[name]) if name in COLMAP_PARAMS else _UNSUPPORTED_COUNTS[name]
        params = cursor.array(_PARAMETER, length, f"the parameters of camera {camera_id}")
        if camera_id in cameras:
            raise DataError(f"camera {camera_id} occurs twice", where=f"{path}, offset {start}")
        size = {"width": width, "height": height}
        cameras[camera_id] = {"model": name, **size, "params": params.tolist()}
    cursor.finish()
    return cameras


def read_points_binary(path: Path) -> ColmapPoints:
    """Read numbers and coordinates out of ``points3D.bin``."""
    cursor = _Cursor(path)
    ids, xyz = [], []
    for _ in range(cursor.count("points")):
        point_id, x, y, z, *_rest = cursor.unpack(_POINT, "a point")
        cursor.skip(cursor.count("track entries") * _TRACK_ENTRY, f"the track of point {point_id}")
        ids.append(point_id)
        xyz.append((x, y, z))
    cursor.finish()
    # Numbers are unsigned in the file, but those of observations use -1 for "none".
    return np.array(ids, dtype=np.uint64).astype(np.int64), np.reshape(xyz, (-1, 3))


def read_images_binary(path: Path) -> list[ColmapImage]:
    """Read ``images.bin``."""
    cursor = _Cursor(path)
    images: list[ColmapImage] = []
    for _ in range(cursor.count("images")):
        fields = cursor.unpack(_IMAGE, "an image")
        name = cursor.name()
        observations = cursor.array(
            _OBSERVATION, cursor.count("observations"), f"the observations of image {name[:200]}"
        )
        images.append((name, partial(_binary_view, fields, observations)))
    cursor.finish()
    return images


def _binary_view(fields: tuple[Any, ...], observations: npt.NDArray[Any]) -> ColmapView:
    return ColmapView(
        quat_wxyz=np.array(fields[1:5]),
        translation=np.array(fields[5:8]),
        camera_id=fields[8],
        points_2d=observations["xy"].astype(float),
        point_ids=observations["point_id"].astype(np.int64),
    )


_MOST_BYTES = 2**37  # of one file: models of cities have billions of observations


class _Cursor:
    """Reads a file piece by piece and says where it ends too early."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._data = read_bytes(path, most=_MOST_BYTES)
        self.offset = 0

    def count(self, what: str) -> int:
        return int(self.unpack(_COUNT, f"the number of {what}")[0])

    def unpack(self, layout: struct.Struct, what: str) -> tuple[Any, ...]:
        start = self.skip(layout.size, what)
        return layout.unpack_from(self._data, start)

    def array(self, dtype: np.dtype[Any], count: int, what: str) -> npt.NDArray[Any]:
        """The next values, not copied."""
        start = self.skip(count * dtype.itemsize, what)
        return np.frombuffer(self._data, dtype=dtype, count=count, offset=start)

    def name(self) -> str:
        """The next text, which a zero byte ends."""
        end = self._data.find(b"\0", self.offset)
        length = len(self._data) - self.offset if end < 0 else end - self.offset
        start = self.skip(length + 1, "an image's name")
        return self._data[start : start + length].decode("utf-8", errors="replace")

    def skip(self, size: int, what: str) -> int:
        """Pass over ``size`` bytes and return where they begin."""
        start = self.offset
        if size > len(self._data) - start:
            raise DataError(
                f"the file is cut short: {what} at offset {start} needs {size} bytes, "
                f"{len(self._data) - start} are left",
                where=str(self._path),
                fix="get the whole file",
            )
        self.offset += size
        return start

    def finish(self) -> None:
        """Check that nothing is left."""
        if self.offset != len(self._data):
            raise DataError(
                f"{len(self._data) - self.offset} bytes too many from offset {self.offset} on",
                where=str(self._path),
                fix="is it the file that its name says?",
            )


# Text files ---------------------------------------------------------------------------------------


# Before an image's name: its number, wxyz, translation, and its camera's number.
_POSE_FIELDS = 9


def read_cameras_text(path: Path) -> CameraTable:
    """Read ``cameras.txt``."""
    cameras: CameraTable = {}
    for number, line in _entries(path):
        words = line.split()
        try:
            camera_id = int(words[0])
            camera = {
                "model": words[1],
                "width": int(words[2]),
                "height": int(words[3]),
                "params": [float(word) for word in words[4:]],
            }
        except (IndexError, ValueError):
            raise _malformed(path, number, line, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]") from None
        if camera_id in cameras:
            raise DataError(f"camera {camera_id} occurs twice", where=f"{path}, line {number}")
        cameras[camera_id] = camera
    return cameras


def read_points_text(path: Path) -> ColmapPoints:
    """Read numbers and coordinates out of ``points3D.txt``."""
    ids, xyz = [], []
    for number, line in _entries(path):
        words = line.split(maxsplit=4)
        try:
            ids.append(np.int64(int(words[0])))
            xyz.append((float(words[1]), float(words[2]), float(words[3])))
        except (IndexError, ValueError, OverflowError):
            raise _malformed(path, number, line, "POINT3D_ID X Y Z R G B ERROR TRACK[]") from None
    return np.array(ids, dtype=np.int64), np.reshape(xyz, (-1, 3))


def read_images_text(path: Path) -> list[ColmapImage]:
    """Read ``images.txt``; poses and observations are read when they are asked for."""
    images: list[ColmapImage] = []
    lines = enumerate(_lines(path), start=1)
    for number, line in lines:
        words = line.split(maxsplit=_POSE_FIELDS)
        if not words or words[0].startswith("#"):
            continue
        if len(words) <= _POSE_FIELDS:
            wanted = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of observations"
            raise _malformed(path, number, line, wanted)
        # The observations' line follows in any case; it is empty where there are none.
        _, observations = next(lines, (0, None))
        name = words[-1].strip()
        where = f"{path}, image {brief(name)}"
        images.append((name, partial(_text_view, words[1:-1], observations, where)))
    return images


def _text_view(pose: list[str], observations: str | None, where: str) -> ColmapView:
    try:
        values = np.array([float(word) for word in pose[:-1]])
        camera_id = int(pose[-1])
    except ValueError as error:
        raise DataError(f"the pose is malformed ({brief(error)})", where=where) from None
    if observations is None:
        what = "the file ends before its observations"
        raise DataError(what, where=where, fix="get the whole file")
    words = observations.split()
    if len(words) % 3:
        raise damaged(f"the observations are {len(words)} values, not X Y POINT3D_ID each", where)
    try:
        x, y = (np.array([float(word) for word in words[k::3]], dtype=float) for k in (0, 1))
        point_ids = np.array([int(word) for word in words[2::3]], dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise DataError(f"an observation is malformed ({brief(error)})", where=where) from None
    return ColmapView(values[:4], values[4:], camera_id, np.stack([x, y], axis=1), point_ids)


def _entries(path: Path) -> Iterator[tuple[int, str]]:
    """The lines that are neither empty nor comments, with their numbers from 1."""
    for number, line in enumerate(_lines(path), start=1):
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            yield number, stripped


def _lines(path: Path) -> list[str]:
    # Not splitlines, which would also split names at exotic separators.
    lines = read_text(path, most=_MOST_BYTES, errors="replace").split("\n")
    return lines[:-1] if lines[-1] == "" else lines


def _malformed(path: Path, number: int, line: str, wanted: str) -> DataError:
    what = f"{quote(line)} is malformed"
    return DataError(what, where=f"{path}, line {number}", fix=f"expected {wanted}")


class _Readers(NamedTuple):
    cameras: Callable[[Path], CameraTable]
    images: Callable[[Path], list[ColmapImage]]
    points: Callable[[Path], ColmapPoints]


# COLMAP itself prefers the binary files where both are there.
READERS = {
    ".bin": _Readers(read_cameras_binary, read_images_binary, read_points_binary),
    ".txt": _Readers(read_cameras_text, read_images_text, read_points_text),
}
"""The three readers by the suffix of the files, in order of preference."""
