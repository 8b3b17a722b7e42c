"""Read COCO keypoints, detectors' variants of them, and COCO masks.

docs/how_to/detectors.md describes the supported forms.
"""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, is_number
from cadalign.datasets.image_keypoints import ImageKeypoints
from cadalign.datasets.records import collect_error
from cadalign.errors import DataError, InputError, quote
from cadalign.io.documents import (
    Count,
    Finite,
    ForeignDocument,
    Text,
    convert,
    name_file,
    read_json,
)
from cadalign.io.kinds import DETECTOR

logger = logging.getLogger("cadalign")

_FIX = "give COCO's keypoint JSON, or a detector's; see the page on detectors in cadalign's docs"
_Id = int | str
_LARGEST = 2**31  # width or height of an image


class _AxisKeypoints(ForeignDocument):
    """The keypoints of one object as ultralytics writes them."""

    x: list[float | None]
    y: list[float | None]
    visible: list[float | None] | None = None


class _Object(ForeignDocument):
    keypoints: list[Any] | _AxisKeypoints | None = None
    score: Any = None
    confidence: Any = None
    image_id: _Id | None = None
    category_id: _Id | None = None
    num_keypoints: Any = None
    segmentation: Any = None


class _Image(ForeignDocument):
    id: _Id
    file_name: Text | None = None
    width: Any = None
    height: Any = None

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height; None if either is missing or invalid."""
        given = (self.width, self.height)
        if given == (None, None):
            return None
        if all(is_number(each) and 1 <= each <= _LARGEST for each in given):
            return int(self.width), int(self.height)
        logger.warning("images: %s x %s is not an image size; ignored", *map(quote, given))
        return None


class _Category(ForeignDocument):
    id: _Id
    keypoints: list[Text] | None = None

    def __post_init__(self) -> None:
        names = self.keypoints or []
        for row, name in enumerate(names):
            if names.index(name) != row:
                raise InputError(f"{quote(name)} occurs twice", where=f"keypoints[{row}]")


_Entry = TypeVar("_Entry", _Image, _Category)


class _File(ForeignDocument):
    annotations: list[Any]
    images: list[_Image] | None = None
    categories: list[_Category] | None = None


def read_coco_keypoints(path: Path, problems: dict[str, DataError] | None) -> list[ImageKeypoints]:
    """Read a file of any supported form; returns an entry for each object in each image.

    `cadalign.datasets.read_image_keypoints` describes ``problems``.
    """
    data, objects = read_json(path, DETECTOR), []
    with name_file(path):
        file = _parse_file(data)
        images, categories = _by_id(file.images, "images"), _by_id(file.categories, "categories")
    for row, entry in enumerate(file.annotations):
        where = f"[{row}]" if isinstance(data, list) else f"annotations[{row}]"
        with collect_error(f"{path}: {where}", problems), name_file(path):
            found = _parse_annotation(entry, where, images, categories)
            if found is not None:
                objects.append(replace(found, source=f"{path}: {where}"))
    third = np.concatenate([np.empty(0), *(o.scores for o in objects if o.scores is not None)])
    if np.isin(third, (0, 1, 2)).all() and (third == 2).any():
        # COCO's visibility flags: 0 not labelled, 1 labelled but hidden, 2 visible.
        objects = [o if o.scores is None else replace(o, scores=o.scores / 2) for o in objects]
    if not objects:
        none = DataError("there are no keypoints", where=str(path))
        raise next(iter((problems or {}).values()), none)
    return objects


def _parse_file(data: Any) -> _File:
    """Parse the file's lists; a detector's result has neither images nor categories."""
    if isinstance(data, list):
        return _File(data)
    if not isinstance(data, dict) or "annotations" not in data:
        raise DataError("there are no annotations", fix=_FIX)
    found: _File = convert(data, _File)
    return found


def _by_id(entries: Sequence[_Entry] | None, where: str) -> dict[_Id, _Entry]:
    """Map ids to images or categories; raises DataError if two of them share an id."""
    found: dict[_Id, _Entry] = {}
    for row, entry in enumerate(entries or ()):
        if found.setdefault(entry.id, entry) != entry:
            what = f"the id {quote(entry.id)} occurs twice"
            fix = "give each entry its own id; were several files merged?"
            raise DataError(what, where=f"{where}[{row}].id", fix=fix)
    return found


def _parse_annotation(
    data: Any, where: str, images: dict[_Id, _Image], categories: dict[_Id, _Category]
) -> ImageKeypoints | None:
    """Parse an annotation; None if none of its keypoints is labelled."""
    entry: _Object = convert(data, _Object, where)
    if entry.num_keypoints == 0:
        return None
    category = None if entry.category_id is None else categories.get(entry.category_id)
    found = _image_keypoints(entry, where, names=None if category is None else category.keypoints)
    if not images:
        return found
    if entry.image_id is None:
        raise DataError("missing", where=f"{where}.image_id")
    image = images.get(entry.image_id)
    if image is None:
        raise DataError(f"there is no image {quote(entry.image_id)}", where=f"{where}.image_id")
    called = image.file_name or found.image
    return replace(found, image=called, size=image.size, images=len(images))


def _image_keypoints(entry: _Object, where: str, *, names: list[str] | None) -> ImageKeypoints:
    place = f"{where}.keypoints"
    points, third = _parse_points(entry, place)
    if names is not None and len(names) != len(points):
        what = f"{len(points)} keypoints, but the category names {len(names)}"
        raise DataError(what, where=place)
    if third is not None and len(third) != len(points):
        raise DataError(f"{len(third)} scores for {len(points)} keypoints", where=place)
    given = (_number(entry, name, where) for name in ("score", "confidence"))
    return ImageKeypoints(
        points_2d=points,
        scores=None if third is None else np.array(third, dtype=float),
        names=None if names is None else tuple(names),
        image=None if entry.image_id is None else str(entry.image_id),
        score=next((score for score in given if score is not None), None),
        segmentation=entry.segmentation or None,
        source=where,
    )


def _parse_points(entry: _Object, where: str) -> tuple[FloatArray, Any]:
    """Parse pixels (k, 2), and visibility flags or scores (k,) or None."""
    value = entry.keypoints
    if value is None:
        raise DataError("missing", where=where, fix=_FIX)
    if isinstance(value, _AxisKeypoints):
        if len(value.x) != len(value.y):
            raise DataError(f"{len(value.y)} values, but x has {len(value.x)}", where=f"{where}.y")
        return np.array([value.x, value.y], dtype=float).T.copy(), value.visible  # NaN for None
    flat = np.array(convert(value, list[float | None], where=where), dtype=float)
    if not len(flat) or len(flat) % 3:
        what = f"expected x, y and visibility or score of each keypoint, got {len(flat)} numbers"
        raise DataError(what, where=where, fix=_FIX)
    numbers = np.reshape(flat, (-1, 3))
    return np.ascontiguousarray(numbers[:, :2]), numbers[:, 2]


def _number(entry: _Object, name: str, where: str) -> float | None:
    """An optional number of an object; a value of another type is ignored with a warning."""
    value = getattr(entry, name)
    if value is None or is_number(value):
        return None if value is None else float(value)
    logger.warning("%s.%s: %s is not a number; ignored", where, name, quote(value))
    return None


# Masks ------------------------------------------------------------------------------------------

_MASK_FIX = "give COCO polygons, or the run lengths of a mask of this image"
_WHOLE_RUNS = re.compile("[0-o]*[0-O]")  # compressed text that does not end within a number
_MOST_PIXELS = 2**28
_LEAST_NUMBERS = 6  # of a polygon


class _Runs(ForeignDocument):
    """A mask as run lengths: pixels outside and inside alternate, column by column."""

    size: tuple[Count, Count]
    counts: list[Count] | str


def decode_segmentation(segmentation: Any, *, width: int, height: int) -> BoolArray:
    """Decode the ``segmentation`` of a COCO annotation or result, (height, width) bool.

    ``segmentation`` is parsed JSON in one of two forms. One is a list of polygons
    ``[x, y, x, y, ...]``, with the origin at the top-left corner of the image. The other is
    ``{"size": [height, width], "counts": ...}``, with run lengths as a list or as COCO's
    compressed text. Raises DataError if it has another form or image size, or the mask is empty.

    Examples
    --------
    >>> square = [[1.0, 0.0, 3.0, 0.0, 3.0, 2.0, 1.0, 2.0]]
    >>> decode_segmentation(square, width=4, height=2).astype(int).tolist()
    [[0, 1, 1, 0], [0, 1, 1, 0]]
    >>> runs = {"size": [2, 4], "counts": [2, 4, 2]}
    >>> decode_segmentation(runs, width=4, height=2).astype(int).tolist()
    [[0, 1, 1, 0], [0, 1, 1, 0]]
    """
    if width * height > _MOST_PIXELS:
        raise DataError(f"an image of {width} x {height} pixels is too large for a mask")
    if isinstance(segmentation, dict):
        mask = _decode_runs(convert(segmentation, _Runs, "segmentation"), width, height)
    else:
        given = convert(segmentation, list[list[Finite]], "segmentation")
        mask = _fill_polygons(given, width, height)
    if not mask.any():
        raise DataError("the mask is empty", where="segmentation", fix=_MASK_FIX)
    return mask


def _decode_runs(runs: _Runs, width: int, height: int) -> BoolArray:
    from pycocotools import mask as coco  # takes a while to import

    if runs.size != (height, width):
        what = f"the mask is {runs.size[1]} x {runs.size[0]}, the image {width} x {height}"
        raise DataError(what, where="segmentation.size", fix=_MASK_FIX)
    where, size = "segmentation.counts", {"size": [height, width]}
    if isinstance(runs.counts, str):
        # pycocotools reads beyond the end of text that ends within a number.
        coded = size | {"counts": runs.counts.encode()}
        inside = _decode_pixels(coded) if _WHOLE_RUNS.fullmatch(runs.counts) else None
        # pycocotools leaves pixels after the last run uninitialised.
        if inside is None or coco.encode(np.asfortranarray(inside))["counts"] != coded["counts"]:
            what = "the compressed run lengths are not a complete mask of this image"
            raise DataError(what, where=where, fix=_MASK_FIX)
        return np.asarray(inside != 0)
    if sum(runs.counts) != width * height:
        what = f"the runs have {sum(runs.counts)} pixels, the image has {width * height}"
        raise DataError(what, where=where, fix=_MASK_FIX)
    return np.asarray(
        _decode_pixels(coco.frPyObjects(size | {"counts": runs.counts}, height, width)) != 0
    )


def _decode_pixels(coded: dict[str, Any]) -> npt.NDArray[np.uint8] | None:
    """Decode compressed run lengths; None if they cover more pixels than the image has."""
    from pycocotools import mask as coco  # takes a while to import

    with suppress(ValueError), warnings.catch_warnings(action="ignore"):  # of NumPy's conventions
        return np.asarray(coco.decode(coded))
    return None


def _fill_polygons(polygons: Sequence[Sequence[float]], width: int, height: int) -> BoolArray:
    """Mask (height, width) of the pixels inside any of the polygons."""
    from pycocotools import mask as coco  # takes a while to import

    for number, polygon in enumerate(polygons):
        where = f"segmentation[{number}]"
        if len(polygon) % 2 or len(polygon) < _LEAST_NUMBERS:
            what = f"expected x, y of three or more points, got {len(polygon)} numbers"
            raise DataError(what, where=where, fix=_MASK_FIX)
        points = np.reshape(polygon, (-1, 2))
        # pycocotools' memory grows with the length of the outline.
        if (np.abs(points) > 2 * max(width, height)).any():
            raise DataError("has points far outside the image", where=where, fix=_MASK_FIX)
    if not polygons:
        return np.zeros((height, width), dtype=bool)
    each = [list(map(float, polygon)) for polygon in polygons]
    return np.asarray(_decode_pixels(coco.merge(coco.frPyObjects(each, height, width))) != 0)
