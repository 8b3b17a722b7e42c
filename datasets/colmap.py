"""COLMAP's sparse models in text form: photos with known poses and the points they see.

Schönberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016. The files are described at
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
from cadalign.io.documents import in_file
from cadalign.io.files import as_path, damaged, read_text

_FILES = ("cameras.txt", "images.txt", "points3D.txt")
_BELOW = "sparse/0"
_TO_TEXT = "colmap model_converter --output_type TXT writes them from .bin files"
_INVALID_POINT = -1  # of an observation that belongs to no point
_MOST_BYTES = 2**37  # of one file: models of cities have billions of observations
# Before an image's name: its number, wxyz, translation, and its camera's number.
_POSE_FIELDS = 9


class _Image(NamedTuple):
    """One image's entry, whose numbers are read when they are asked for."""

    name: str
    pose: list[str]  # the words of `_POSE_FIELDS`
    observations: str | None  # None where the file ends before them


class Colmap(CorrespondenceSet):
    """The photos of a COLMAP model in text form, sorted by name.

    Binary models become text by ``colmap model_converter --output_type TXT``. Observations that
    belong to no point are left out. Poses and observations are checked image by image, when they
    are asked for; see `CorrespondenceSet`.

    Parameters
    ----------
    path : str or path-like
        The folder with ``cameras.txt``, ``images.txt`` and ``points3D.txt``, or one that holds
        them in ``sparse/0``.

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
    marks = (*_FILES, *(f"{_BELOW}/{name}" for name in _FILES))
    signature = f"cameras.txt, images.txt and points3D.txt, also in {_BELOW} ({_TO_TEXT})"

    def __init__(self, path: str | os.PathLike[str]) -> None:
        root = as_path(path)
        below = root / _BELOW
        folder = below if below.is_dir() and not (root / "images.txt").is_file() else root
        files = require_files(folder, _FILES, fix=f"give the folder of COLMAP's text; {_TO_TEXT}")
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
        """Read the image of a number from 0."""
        image = self._images[position]
        where = f"{self.root}, image {brief(image.name)}"
        try:
            pose, camera_id = np.array(image.pose[:-1], dtype=float), int(image.pose[-1])
        except ValueError as error:
            raise DataError(f"the pose is malformed ({brief(error)})", where=where) from None
        points_2d, point_ids = _observed(image.observations, where)
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


def _read_cameras(path: Path) -> dict[int, dict[str, Any]]:
    """The cameras by number, in the form that `Camera.from_dict` reads."""
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
    """Numbers (m,) and coordinates (m, 3) of all points, in file order."""
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
        # The observations' line follows in any case; it is empty where there are none.
        _, observations = next(lines, (0, None))
        images.append(_Image(words[-1].strip(), words[1:-1], observations))
    return images


def _observed(observations: str | None, where: str) -> tuple[FloatArray, IntArray]:
    """COLMAP's pixels (n, 2), whose centres are at (0.5, 0.5), and the numbers of their points."""
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
    return np.stack([x, y], axis=1), point_ids


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
