"""Read files of image keypoints: COCO-like JSON or CSV; see docs/how_to/detectors.md."""

from __future__ import annotations

import csv
import io
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.datasets.coco import read_coco_keypoints
from cadalign.datasets.image_keypoints import ImageKeypoints
from cadalign.datasets.records import collect_error
from cadalign.errors import DataError, InputError, brief, quote
from cadalign.io.documents import name_file
from cadalign.io.files import as_path, read_text

_NUMBERS = ("u", "v", "semantic_id", "score", "sigma")
_COLUMNS = ("u", "v", "image", "name", "semantic_id", "score", "sigma")
_ALIASES = {"x": "u", "y": "v"}
_MISSING = ("", "nan", "none", "null", "na", "n/a")
"""Texts that programs write as the pixel of a keypoint that was not found."""
_MISSING_VALUES = {"u": "0", "v": "0", "score": "0", "sigma": "1"}


def read_image_keypoints(
    path: str | os.PathLike[str], *, problems: dict[str, DataError] | None = None
) -> list[ImageKeypoints]:
    """Read a file of image keypoints: COCO's JSON, a detector's variant of it, or CSV.

    Parameters
    ----------
    path : str or path-like
        A .csv or JSON file as described in docs/how_to/detectors.md.
    problems : dict of str to DataError, optional
        Receives the error of each object that could not be read, by its place in the file. If it
        is omitted, or no object could be read, the first error is raised.

    Returns
    -------
    list of ImageKeypoints
        One for each object in each image, in file order.

    Raises
    ------
    DataError
        If the file is missing, malformed or of an unknown kind; names file and field.
    """
    path = as_path(path)
    read = _read_csv if path.suffix.lower() == ".csv" else read_coco_keypoints
    return read(path, problems)


def _read_csv(path: Path, problems: dict[str, DataError] | None) -> list[ImageKeypoints]:
    """Read a CSV file, which has one object per image."""
    by_image: dict[str | None, list[tuple[str, list[str]]]] = {}
    try:
        lines = csv.reader(io.StringIO(read_text(path)), strict=True)
        header = _parse_header(next(lines, []), f"{path}, line 1")
        for line in lines:
            cells = {name: cell.strip() for name, cell in zip(header, line, strict=False)}
            if any(cells.values()):
                row = f"{path}, line {lines.line_num}", line
                by_image.setdefault(cells.get("image") or None, []).append(row)
    except csv.Error as error:
        raise DataError(f"cannot be read ({brief(error)})", where=str(path)) from None
    objects = []
    for image, rows in by_image.items():
        source = str(path) if image is None else f"{path}, {image}"
        with collect_error(source, problems):
            read = [_parse_row(header, line, where) for where, line in rows]
            objects.append(_join_rows(read, image, source))
    if not objects:
        none = DataError("there are no keypoints", where=str(path))
        raise next(iter((problems or {}).values()), none)
    return objects


def _parse_header(cells: list[str], where: str) -> list[str]:
    names = [_ALIASES.get(cell.strip().lower(), cell.strip().lower()) for cell in cells]
    for name in names:
        if name not in _COLUMNS:
            what = f"unknown column {quote(name)}"
            raise DataError(what, where=where, fix=f"known are {', '.join(_COLUMNS)}")
        if names.count(name) > 1:
            raise DataError(f"the column {name!r} occurs twice", where=where)
    for name in ("u", "v"):
        if name not in names:
            fix = "the first line names the columns, such as name,u,v"
            raise DataError(f"the column {name!r} is missing", where=where, fix=fix)
    return names


def _parse_row(header: list[str], line: list[str], where: str) -> dict[str, Any]:
    """Parse one line; a missing pixel becomes NaN."""
    if len(line) != len(header):
        raise DataError(f"{len(line)} values for {len(header)} columns", where=where)
    cells = {name: cell.strip() for name, cell in zip(header, line, strict=True)}
    is_missing = all(cells[name].lower() in _MISSING for name in ("u", "v"))
    if is_missing:
        cells = cells | {name: text for name, text in _MISSING_VALUES.items() if name in cells}
    with name_file(where):
        row = {
            name: _parse_number(name, cell) if name in _NUMBERS else cell
            for name, cell in cells.items()
        }
        if row.get("name") == "":
            raise InputError("the name is empty", where="name")
        if row.get("semantic_id", 0) % 1:  # pandas writes 2.0 in columns with gaps
            raise InputError(f"{row['semantic_id']} is not a whole number", where="semantic_id")
    return row | dict.fromkeys(("u", "v"), np.nan) if is_missing else row


def _parse_number(name: str, cell: str) -> float:
    with suppress(ValueError):
        if np.isfinite(value := float(cell)):
            return value
    raise InputError(f"{quote(cell)} is not a finite number", where=name)


def _join_rows(rows: list[dict[str, Any]], image: str | None, source: str) -> ImageKeypoints:
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    scores = columns.get("score")
    names, ids, sigma = (columns.get(name) for name in ("name", "semantic_id", "sigma"))
    return ImageKeypoints(
        points_2d=np.column_stack([columns["u"], columns["v"]]),
        scores=None if scores is None else np.array(scores),
        names=None if names is None else tuple(names),
        ids=None if ids is None or names is not None else tuple(map(int, ids)),
        sigma=None if sigma is None else np.array(sigma),
        image=image,
        source=source,
    )
