"""COLMAP's binary files, see https://colmap.github.io/format.html; little endian.

Readers raise `DataError` with the file and the offset.
"""

from __future__ import annotations

import struct
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.datasets.sfm.colmap_model import CameraTable, ColmapImage, ColmapPoints, ColmapView
from cadalign.errors import DataError
from cadalign.geometry.camera import COLMAP_PARAMS
from cadalign.io.files import reading

# COLMAP's camera models in the order of their numbers, and how many parameters those have that
# `Camera` doesn't know: a camera nobody asks for must not keep the others from being read.
_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"),
    *("FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
    "RAD_TAN_THIN_PRISM_FISHEYE",
)
_UNSUPPORTED_COUNTS = {
    "OPENCV_FISHEYE": 8,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
}

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
        cameras[camera_id] = {
            "model": name,
            "width": width,
            "height": height,
            "params": params.tolist(),
        }
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
        images.append((name, partial(_read_view, fields, observations)))
    cursor.finish()
    return images


def _read_view(fields: tuple[Any, ...], observations: npt.NDArray[Any]) -> ColmapView:
    return ColmapView(
        quat_wxyz=np.array(fields[1:5]),
        translation=np.array(fields[5:8]),
        camera_id=fields[8],
        points_2d=observations["xy"].astype(float),
        point_ids=observations["point_id"].astype(np.int64),
    )


class _Cursor:
    """Reads a file piece by piece and says where it ends too early."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with reading(path):
            self._data = path.read_bytes()
        self.offset = 0

    def count(self, what: str) -> int:
        """The number of things that follow."""
        return int(self.unpack(_COUNT, f"the number of {what}")[0])

    def unpack(self, layout: struct.Struct, what: str) -> tuple[Any, ...]:
        """The next fields."""
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
