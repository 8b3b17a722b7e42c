"""Keypoints in images from a plain CSV file.

The first line names the columns, in any order:

``u``, ``v``
    The pixel; integers are pixel centres. ``x`` and ``y`` mean the same. Empty for a keypoint that
    was not found.
``name``
    What the keypoint is called.
``semantic_id``
    What the keypoint means, a whole number; used where there is no name.
``score``
    How sure the detector is.
``visibility``
    COCO's flag: 0 not labelled, 1 hidden, 2 visible. Instead of a score.
``sigma``
    Standard deviation [px].
``image``
    The image's file name; the rows of each image make one object.

Only ``u`` and ``v`` must be there. Example::

    image,name,u,v,score
    photo.jpg,"seat, front left",351.2,204.9,0.93
    photo.jpg,"back, top left",377.0,96.4,0.71
"""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np

from cadalign.datasets.detections.image_keypoints import OCCLUDED_SCORE, ImageKeypoints
from cadalign.errors import DataError

_COLUMNS = ("image", "name", "semantic_id", "u", "v", "score", "visibility", "sigma")
_OTHER_NAMES = {"x": "u", "y": "v"}
_VISIBILITY_SCORES = {0: 0.0, 1: OCCLUDED_SCORE, 2: 1.0}


def read_csv_keypoints(path: Path) -> list[ImageKeypoints]:
    """Read a CSV file, one object for each image.

    Raises
    ------
    DataError
        If it is missing, lacks a column, or a value is invalid; names file and line.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = csv.reader(file, strict=True)
            header = _header(next(lines, []), path)
            rows = [(lines.line_num, row) for row in lines if any(cell.strip() for cell in row)]
    except FileNotFoundError:
        raise DataError("no such file", where=str(path)) from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"cannot be read ({error})", where=str(path)) from None
    by_image: dict[str | None, list[tuple[str, dict[str, str]]]] = {}
    for line, row in rows:
        where = f"{path}, line {line}"
        if len(row) != len(header):
            raise DataError(f"{len(row)} values for {len(header)} columns", where=where)
        cells = {name: cell.strip() for name, cell in zip(header, row, strict=True)}
        if not cells["u"] and not cells["v"]:
            continue
        by_image.setdefault(cells.get("image") or None, []).append((where, cells))
    if not by_image:
        raise DataError("there are no keypoints", where=str(path))
    return [_object(path, header, image, found) for image, found in by_image.items()]


def _header(cells: list[str], path: Path) -> list[str]:
    names = [_OTHER_NAMES.get(cell.strip().lower(), cell.strip().lower()) for cell in cells]
    for name in names:
        if name not in _COLUMNS:
            raise DataError(
                f"unknown column {name!r}",
                where=f"{path}, line 1",
                fix=f"known are {', '.join(_COLUMNS)}",
            )
        if names.count(name) > 1:
            raise DataError(f"the column {name!r} occurs twice", where=f"{path}, line 1")
    for name in ("u", "v"):
        if name not in names:
            raise DataError(
                f"the column {name!r} is missing",
                where=f"{path}, line 1",
                fix="the first line names the columns, such as name,u,v",
            )
    if {"score", "visibility"} <= set(names):
        raise DataError("give score or visibility, not both", where=f"{path}, line 1")
    return names


def _object(
    path: Path, header: list[str], image: str | None, found: list[tuple[str, dict[str, str]]]
) -> ImageKeypoints:
    def column(name: str) -> list[float] | None:
        return [_number(c, name, w) for w, c in found] if name in header else None

    scores = column("score")
    if "visibility" in header:
        scores = [_visibility(cells, where) for where, cells in found]
    ids = None
    if "semantic_id" in header and "name" not in header:
        ids = tuple(_whole(cells, "semantic_id", where) for where, cells in found)
    names = None
    if "name" in header:
        names = tuple(_name(cells, where) for where, cells in found)
    sigma = column("sigma")
    return ImageKeypoints(
        points_2d=np.array([[_number(c, "u", w), _number(c, "v", w)] for w, c in found]),
        scores=None if scores is None else np.array(scores),
        names=names,
        semantic_ids=ids,
        sigma=None if sigma is None else np.array(sigma),
        image=image,
        source=str(path) if image is None else f"{path}, {image}",
    )


def _number(cells: dict[str, str], name: str, where: str) -> float:
    try:
        value = float(cells[name])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DataError(f"{name} is {cells[name]!r}, not a number", where=where)
    return value


def _whole(cells: dict[str, str], name: str, where: str) -> int:
    value = _number(cells, name, where)
    if value != int(value):
        raise DataError(f"{name} is {cells[name]!r}, not a whole number", where=where)
    return int(value)


def _visibility(cells: dict[str, str], where: str) -> float:
    flag = _whole(cells, "visibility", where)
    if flag not in _VISIBILITY_SCORES:
        raise DataError(f"visibility is {flag}, not 0, 1 or 2", where=where)
    return _VISIBILITY_SCORES[flag]


def _name(cells: dict[str, str], where: str) -> str:
    if not cells["name"]:
        raise DataError("the name is empty", where=where)
    return cells["name"]
