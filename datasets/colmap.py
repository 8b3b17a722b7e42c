"""COLMAP's sparse models: photos with known poses and the points they see.

Schönberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016. The files, text and binary
(little endian), are described at https://colmap.github.io/format.html.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray
from cadalign.datasets.correspondences import (
    Correspondences,
    CorrespondenceSet,
    find_layout,
    rigid_pose,
)
from cadalign.errors import DataError, brief, quote
from cadalign.geometry.calibration import COLMAP_PARAMS
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import PIXEL_CENTRE
from cadalign.geometry.rotations import rotation_from_quat_wxyz
from cadalign.io.documents import in_file
from cadalign.io.files import as_path, damaged, read_bytes, read_text

_LAYOUTS = tuple(
    tuple(f"{folder}/{stem}{suffix}" for stem in ("cameras", "images", "points3D"))
    for folder in (".", "sparse/0", "sparse", "0")
    for suffix in (".bin", ".txt")  # COLMAP itself prefers the binary files
)
_INVALID_POINT = -1  # of an observation that belongs to no point
_MOST_BYTES = 2**37  # of one file: models of cities have billions of observations


class _View(NamedTuple):
    """One image's entry; its pose is camera from world."""

    pose: FloatArray  # (7,) quaternion wxyz and translation
    camera_id: int
    points_2d: FloatArray  # (n, 2) in COLMAP's pixels, whose centres are at (0.5, 0.5)
    point_ids: IntArray  # (n,) the points that they show, or `_INVALID_POINT`


# An image's name, and the function that reads the rest of its entry.
_Image = tuple[str, Callable[[], _View]]
# Numbers (m,) and coordinates (m, 3) of all points, in file order.
_Points = tuple[IntArray, FloatArray]
# By number, in the form that `Camera.from_dict` reads.
_Cameras = dict[int, dict[str, Any]]


class Colmap(CorrespondenceSet):
    """The photos of a COLMAP model, sorted by name; text or binary.

    Observations that belong to no point are left out. Poses and observations are checked image by
    image, when they are asked for; see `CorrespondenceSet`.

    Parameters
    ----------
    path : str or path-like
        The folder with ``cameras``, ``images`` and ``points3D`` (``.bin`` or ``.txt``), or one
        that holds them in ``sparse/0``, ``sparse`` or ``0``.

    Raises
    ------
    DataError
        If files are missing, cut short or malformed, or a name or number occurs twice. Asking for
        an image raises it if the image observes points that don't exist, or its camera's model is
        none that `cadalign.Camera.from_dict` reads.

    Examples
    --------
    >>> images = Colmap("reconstruction")  # doctest: +SKIP
    >>> images.names  # doctest: +SKIP
    ('00.jpg', '01.jpg')
    >>> seen = images["00.jpg"]  # doctest: +SKIP
    >>> float(np.median(np.linalg.norm(seen.residuals(), axis=1)))  # doctest: +SKIP
    0.25
    """

    kind = "COLMAP"
    marks = tuple(name for layout in _LAYOUTS for name in layout)
    signature = "cameras, images and points3D (.bin or .txt; also in sparse/0, sparse or 0)"

    def __init__(self, path: str | os.PathLike[str]) -> None:
        fix = "give the folder of cameras, images and points3D, all three as .bin or as .txt"
        nothing = "there is no COLMAP model"
        files = find_layout(as_path(path), _LAYOUTS, nothing=nothing, fix=fix)
        self._camera_file, image_file, self._point_file = files
        is_text = image_file.suffix == ".txt"
        read_cameras, read_points, read_images = _TEXT_READERS if is_text else _BINARY_READERS
        self._cameras = read_cameras(self._camera_file)
        ids, xyz = read_points(self._point_file)
        order = np.argsort(ids, kind="stable")
        self._images = sorted(read_images(image_file), key=lambda image: image[0])
        self._point_ids, self._points = ids[order], xyz[order]
        twice = self._point_ids[1:][self._point_ids[1:] == self._point_ids[:-1]]
        if len(twice):
            raise DataError(f"point {twice[0]} occurs twice", where=str(self._point_file))
        super().__init__(image_file, [name for name, _ in self._images])

    def read(self, position: int) -> Correspondences:
        """Read the image of a number from 0."""
        name, read_view = self._images[position]
        view = read_view()
        rows = view.point_ids != _INVALID_POINT
        return Correspondences(
            id=name,
            points_3d=self._points[self._point_rows(view.point_ids[rows], name)],
            points_2d=view.points_2d[rows] - PIXEL_CENTRE,
            camera=self._camera(view.camera_id, name),
            cam_from_world=rigid_pose(rotation_from_quat_wxyz(view.pose[:4]), view.pose[4:]),
        )

    def _point_rows(self, point_ids: IntArray, name: str) -> IntArray:
        rows = np.searchsorted(self._point_ids, point_ids)
        known = rows < len(self._point_ids)
        known[known] = self._point_ids[rows[known]] == point_ids[known]
        missing = np.unique(point_ids[~known])
        if len(missing):
            what = f"{len(missing)} of the points that it observes do not exist, the first is point"
            raise self._of_another_model(f"{what} {missing[0]}", self._point_file, name)
        return rows

    def _camera(self, camera_id: int, name: str) -> Camera:
        if camera_id not in self._cameras:
            raise self._of_another_model(f"there is no camera {camera_id}", self._camera_file, name)
        with in_file(f"{self._camera_file}, camera {camera_id}"):
            return Camera.from_dict(self._cameras[camera_id])

    def _of_another_model(self, what: str, file: Path, name: str) -> DataError:
        where = f"{self.root}, {brief(name)}"
        return DataError(what, where=where, fix=f"does {file.name} belong to the same model?")


# Binary files -------------------------------------------------------------------------------------

# COLMAP's camera models in the order of their numbers, and how many parameters those have that
# `Camera` doesn't know: a camera nobody asks for must not keep the others from being read.
_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"),
    *("FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
    "RAD_TAN_THIN_PRISM_FISHEYE",
)
_UNSUPPORTED_COUNTS = {
    "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12, "RAD_TAN_THIN_PRISM_FISHEYE": 16,
}
_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # number, model, width, height; parameters follow
_IMAGE = struct.Struct("<I7dI")  # number, wxyz, translation, camera; name and observations follow
_POINT = struct.Struct("<Q3d3Bd")  # number, xyz, colour, error; the track follows
_TRACK_ENTRY = 8
_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point_id", "<i8")])


def _read_cameras_binary(path: Path) -> _Cameras:
    cursor = _Cursor(path)
    cameras: _Cameras = {}
    for _ in range(cursor.count("cameras")):
        where = f"{path}, offset {cursor.offset}"
        camera_id, model, width, height = cursor.unpack(_CAMERA, "a camera")
        if not 0 <= model < len(_MODELS):
            # The number of its parameters is unknown, and so is where the next camera begins.
            what = f"camera {camera_id} has the unknown model number {model}"
            fix = "export the model with undistorted images, or as text"
            raise DataError(what, where=where, fix=fix)
        name = _MODELS[model]
        length = len(COLMAP_PARAMS[name]) if name in COLMAP_PARAMS else _UNSUPPORTED_COUNTS[name]
        what = f"the parameters of camera {camera_id}"
        params = cursor.array(np.dtype("<f8"), length, what).tolist()
        if camera_id in cameras:
            raise DataError(f"camera {camera_id} occurs twice", where=where)
        cameras[camera_id] = {"model": name, "width": width, "height": height, "params": params}
    cursor.finish()
    return cameras


def _read_points_binary(path: Path) -> _Points:
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


def _read_images_binary(path: Path) -> list[_Image]:
    cursor = _Cursor(path)
    images: list[_Image] = []
    for _ in range(cursor.count("images")):
        fields = cursor.unpack(_IMAGE, "an image")
        name = cursor.name()
        what = f"the observations of image {name[:200]}"
        observations = cursor.array(_OBSERVATION, cursor.count("observations"), what)
        images.append((name, partial(_binary_view, fields, observations)))
    cursor.finish()
    return images


def _binary_view(fields: tuple[Any, ...], observations: npt.NDArray[Any]) -> _View:
    points_2d, point_ids = observations["xy"].astype(float), observations["point_id"]
    return _View(np.array(fields[1:8]), fields[8], points_2d, point_ids.astype(np.int64))


class _Cursor:
    """Reads a file piece by piece and says where it ends too early."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._data = read_bytes(path, most=_MOST_BYTES)
        self.offset = 0

    def count(self, what: str) -> int:
        return int(self.unpack(_COUNT, f"the number of {what}")[0])

    def unpack(self, layout: struct.Struct, what: str) -> tuple[Any, ...]:
        return layout.unpack_from(self._data, self.skip(layout.size, what))

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
        start, left = self.offset, len(self._data) - self.offset
        if size > left:
            what = f"{what} at offset {start} needs {size} bytes, {left} are left"
            raise damaged(what, self._path)
        self.offset += size
        return start

    def finish(self) -> None:
        if self.offset != len(self._data):
            what = f"{len(self._data) - self.offset} bytes too many from offset {self.offset} on"
            raise DataError(what, where=str(self._path), fix="is it the file that its name says?")


# Text files ---------------------------------------------------------------------------------------

# Before an image's name: its number, wxyz, translation, and its camera's number.
_POSE_FIELDS = 9


def _read_cameras_text(path: Path) -> _Cameras:
    cameras: _Cameras = {}
    for number, line in _entries(path):
        words = line.split()
        try:
            camera_id, width, height = (int(words[k]) for k in (0, 2, 3))
            params = [float(word) for word in words[4:]]
        except (IndexError, ValueError):
            raise _malformed(path, number, line, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]") from None
        if camera_id in cameras:
            raise DataError(f"camera {camera_id} occurs twice", where=f"{path}, line {number}")
        cameras[camera_id] = {"model": words[1], "width": width, "height": height, "params": params}
    return cameras


def _read_points_text(path: Path) -> _Points:
    ids, xyz = [], []
    for number, line in _entries(path):
        words = line.split(maxsplit=4)
        try:
            ids.append(np.int64(int(words[0])))
            xyz.append((float(words[1]), float(words[2]), float(words[3])))
        except (IndexError, ValueError, OverflowError):
            raise _malformed(path, number, line, "POINT3D_ID X Y Z R G B ERROR TRACK[]") from None
    return np.array(ids, dtype=np.int64), np.reshape(xyz, (-1, 3))


def _read_images_text(path: Path) -> list[_Image]:
    images: list[_Image] = []
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


def _text_view(pose: list[str], observations: str | None, where: str) -> _View:
    try:
        values, camera_id = np.array([float(word) for word in pose[:-1]]), int(pose[-1])
    except ValueError as error:
        raise DataError(f"the pose is malformed ({brief(error)})", where=where) from None
    if observations is None:
        raise damaged("the file ends before its observations", where)
    words = observations.split()
    if len(words) % 3:
        raise damaged(f"the observations are {len(words)} values, not X Y POINT3D_ID each", where)
    try:
        x, y = (np.array([float(word) for word in words[k::3]], dtype=float) for k in (0, 1))
        point_ids = np.array([int(word) for word in words[2::3]], dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise DataError(f"an observation is malformed ({brief(error)})", where=where) from None
    return _View(values, camera_id, np.stack([x, y], axis=1), point_ids)


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
    where = f"{path}, line {number}"
    return DataError(f"{quote(line)} is malformed", where=where, fix=f"expected {wanted}")


_BINARY_READERS = _read_cameras_binary, _read_points_binary, _read_images_binary
_TEXT_READERS = _read_cameras_text, _read_points_text, _read_images_text
