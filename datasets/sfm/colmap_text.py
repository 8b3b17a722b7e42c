"""COLMAP's text files, see https://colmap.github.io/format.html.

Readers raise `DataError` with the file and the line.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from cadalign.datasets.sfm.colmap_model import CameraTable, ColmapImage, ColmapPoints, ColmapView
from cadalign.errors import DataError, quote
from cadalign.io.files import reading

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
            raise _malformed(
                path,
                number,
                line,
                "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of observations",
            )
        # The observations' line follows in any case; it is empty where there are none.
        _, observations = next(lines, (0, None))
        name = words[-1].strip()
        where = f"{path}, image {name}"
        images.append((name, partial(_read_view, words[1:-1], observations, where)))
    return images


def _read_view(pose: list[str], observations: str | None, where: str) -> ColmapView:
    try:
        values = np.array([float(word) for word in pose[:-1]])
        camera_id = int(pose[-1])
    except ValueError as error:
        raise DataError(f"the pose is malformed ({error})", where=where) from None
    if observations is None:
        raise DataError(
            "the file ends before its observations", where=where, fix="get the whole file"
        )
    words = observations.split()
    if len(words) % 3:
        raise DataError(
            f"the observations are {len(words)} values, not X Y POINT3D_ID each",
            where=where,
            fix="the file is cut short or damaged; get it again",
        )
    try:
        x = np.array([float(word) for word in words[0::3]], dtype=float)
        y = np.array([float(word) for word in words[1::3]], dtype=float)
        point_ids = np.array([int(word) for word in words[2::3]], dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise DataError(f"an observation is malformed ({error})", where=where) from None
    return ColmapView(values[:4], values[4:], camera_id, np.stack([x, y], axis=1), point_ids)


def _entries(path: Path) -> Iterator[tuple[int, str]]:
    """The lines that are neither empty nor comments, with their numbers from 1."""
    for number, line in enumerate(_lines(path), start=1):
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            yield number, stripped


def _lines(path: Path) -> list[str]:
    # Not splitlines, which would also split names at exotic separators.
    with reading(path):
        lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
    return lines[:-1] if lines[-1] == "" else lines


def _malformed(path: Path, number: int, line: str, wanted: str) -> DataError:
    what = f"{quote(line)} is malformed"
    return DataError(what, where=f"{path}, line {number}", fix=f"expected {wanted}")
