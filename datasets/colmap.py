"""Read COLMAP's sparse models in text form: photos with known poses and observed points.

Schönberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016. The format is described at
https://colmap.github.io/format.html.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.datasets.correspondences import (
    Correspondences,
    CorrespondenceSet,
    require_files,
    rigid_pose,
)
from cadalign.errors import DataError, brief, quote
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import PIXEL_CENTRE
from cadalign.geometry.rotations import rotation_from_quat_wxyz
from cadalign.io.documents import name_file
from cadalign.io.files import as_path, damage_error, read_text

_FILES = ("cameras.txt", "images.txt", "points3D.txt")
_SUBFOLDER = "sparse/0"
_CONVERT = "colmap model_converter --output_type TXT writes them from .bin files"
_INVALID_POINT = -1  # the point id of an observation without a point
_MOST_BYTES = 2**37  # size limit of a file: models of cities have billions of observations
# Fields before an image's name: its id, quaternion wxyz, translation, camera id.
_POSE_FIELDS = 9


class _Image(NamedTuple):
    """One image's entry; its numbers are parsed on access."""

    name: str
    pose: list[str]  # the words after the image's id and before its name
    observations: str | None  # None if the file ends before them


class Colmap(CorrespondenceSet):
    """The photos of a COLMAP model in text form, sorted by name.

    Convert binary models with ``colmap model_converter --output_type TXT``. Observations without a
    point are left out. An image's pose and observations are checked on access; see
    `CorrespondenceSet`.

    Parameters
    ----------
    path : str or path-like
        A folder with ``cameras.txt``, ``images.txt`` and ``points3D.txt``, in it or in its
        ``sparse/0``.

    Raises
    ------
    DataError
        If files are missing, cut short or malformed, or a name or id occurs twice. Access to an
        image raises it if the image observes points that don't exist, or
        `cadalign.Camera.from_dict` does not support its camera's model.

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
    marks = (*_FILES, *(f"{_SUBFOLDER}/{name}" for name in _FILES))
    signature = f"cameras.txt, images.txt and points3D.txt, also in {_SUBFOLDER} ({_CONVERT})"

    def __init__(self, path: str | os.PathLike[str]) -> None:
        root = as_path(path)
        below = root / _SUBFOLDER
        folder = below if below.is_dir() and not (root / "images.txt").is_file() else root
        files = require_files(folder, _FILES, fix=f"give the folder of COLMAP's text; {_CONVERT}")
        self._camera_file, image_file, self._point_file = files
        self._cameras = _read_cameras(self._camera_file)
        ids, xyz = _read_points(self._point_file)
        order = np.argsort(ids, kind="stable")
        self._images = sorted(_read_images(image_file), key=lambda image: image.name)
        self._point_ids, self._points = ids[order], xyz[order]
        twice = self._point_ids[1:][self._point_ids[1:] == self._point_ids[:-1]]
        if len(twice):
            raise DataError(f"point {twice[0]} occurs twice", where=str(self._point_file))
        names = [image.name for image in self._images]
        for name, next_name in pairwise(names):
            if name == next_name:
                what = f"the image {name!r} occurs twice"
                raise DataError(what, where=str(image_file), fix="remove one of them")
        super().__init__(image_file, names)

    def read(self, position: int) -> Correspondences:
        """Read the image at a position, counted from 0."""
        image = self._images[position]
        where = f"{self.root}, image {brief(image.name)}"
        try:
            pose, camera_id = np.array(image.pose[:-1], dtype=float), int(image.pose[-1])
        except ValueError as error:
            raise DataError(f"the pose is malformed ({brief(error)})", where=where) from None
        points_2d, point_ids = _parse_observations(image.observations, where)
        rows = point_ids != _INVALID_POINT
        return Correspondences(
            id=image.name,
            points_3d=self._points[self._point_rows(point_ids[rows], image.name)],
            points_2d=points_2d[rows] - PIXEL_CENTRE,
            camera=self._camera(camera_id, image.name),
            cam_from_world=rigid_pose(rotation_from_quat_wxyz(pose[:4]), pose[4:]),
        )

    def _point_rows(self, point_ids: IntArray, name: str) -> IntArray:
        rows = np.searchsorted(self._point_ids, point_ids)
        known = rows < len(self._point_ids)
        known[known] = self._point_ids[rows[known]] == point_ids[known]
        missing = np.unique(point_ids[~known])
        if len(missing):
            what = f"{len(missing)} of the points that it observes do not exist, the first is point"
            raise self._mismatch(f"{what} {missing[0]}", self._point_file, name)
        return rows

    def _camera(self, camera_id: int, name: str) -> Camera:
        if camera_id not in self._cameras:
            raise self._mismatch(f"there is no camera {camera_id}", self._camera_file, name)
        with name_file(f"{self._camera_file}, camera {camera_id}"):
            return Camera.from_dict(self._cameras[camera_id])

    def _mismatch(self, what: str, file: Path, name: str) -> DataError:
        where = f"{self.root}, {brief(name)}"
        return DataError(what, where=where, fix=f"give the {file.name} of this model")


def _read_cameras(path: Path) -> dict[int, dict[str, Any]]:
    """Read the cameras by id, in the form for `Camera.from_dict`."""
    cameras: dict[int, dict[str, Any]] = {}
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


def _read_points(path: Path) -> tuple[IntArray, FloatArray]:
    """Read ids (m,) and coordinates (m, 3) of all points, in file order."""
    ids, xyz = [], []
    for number, line in _entries(path):
        words = line.split(maxsplit=4)
        try:
            ids.append(np.int64(int(words[0])))
            xyz.append((float(words[1]), float(words[2]), float(words[3])))
        except (IndexError, ValueError, OverflowError):
            raise _malformed(path, number, line, "POINT3D_ID X Y Z R G B ERROR TRACK[]") from None
    return np.array(ids, dtype=np.int64), np.reshape(xyz, (-1, 3))


def _read_images(path: Path) -> list[_Image]:
    images: list[_Image] = []
    lines = enumerate(_lines(path), start=1)
    for number, line in lines:
        words = line.split(maxsplit=_POSE_FIELDS)
        if not words or words[0].startswith("#"):
            continue
        if len(words) <= _POSE_FIELDS:
            wanted = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of observations"
            raise _malformed(path, number, line, wanted)
        # The next line has the observations, also if it is empty.
        _, observations = next(lines, (0, None))
        images.append(_Image(words[-1].strip(), words[1:-1], observations))
    return images


def _parse_observations(observations: str | None, where: str) -> tuple[FloatArray, IntArray]:
    """Parse COLMAP's pixels (n, 2), with centres at (0.5, 0.5), and their point ids (n,)."""
    if observations is None:
        raise damage_error("the file ends before its observations", where)
    words = observations.split()
    if len(words) % 3:
        raise damage_error(f"the observations have {len(words)} values, not three per point", where)
    try:
        x, y = (np.array([float(word) for word in words[k::3]], dtype=float) for k in (0, 1))
        point_ids = np.array([int(word) for word in words[2::3]], dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise DataError(f"an observation is malformed ({brief(error)})", where=where) from None
    return np.stack([x, y], axis=1), point_ids


def _entries(path: Path) -> Iterator[tuple[int, str]]:
    """Yield lines with their numbers from 1, without empty lines and comments."""
    for number, line in enumerate(_lines(path), start=1):
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            yield number, stripped


def _lines(path: Path) -> list[str]:
    # splitlines would also split names at Unicode separators.
    lines = read_text(path, most=_MOST_BYTES, errors="replace").split("\n")
    return lines[:-1] if lines[-1] == "" else lines


def _malformed(path: Path, number: int, line: str, wanted: str) -> DataError:
    where = f"{path}, line {number}"
    return DataError(f"{quote(line)} is malformed", where=where, fix=f"expected {wanted}")
