"""COCO: keypoints in images, read from its JSON and what detectors make of it; masks.

The forms that are read are described in docs/how_to/detectors.md.
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
from cadalign.datasets.records import leaving_out
from cadalign.errors import DataError, InputError, quote
from cadalign.io.documents import Count, Finite, ForeignDocument, Text, convert, in_file, read_json
from cadalign.io.kinds import DETECTOR

logger = logging.getLogger("cadalign")

_FIX = "is it COCO's keypoint JSON, or a detector's? see cadalign's page on keypoints of detectors"
_Id = int | str
_LARGEST = 2**31  # width or height of an image


class _ByAxis(ForeignDocument):
    """The keypoints of one object as ultralytics writes them."""

    x: list[float | None]
    y: list[float | None]
    visible: list[float | None] | None = None


class _Object(ForeignDocument):
    """One object of any form."""

    keypoints: list[Any] | _ByAxis | None = None
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
        """Width and height; None where either is missing or is none."""
        given = (self.width, self.height)
        if given == (None, None):
            return None
        if all(is_number(each) and 1 <= each <= _LARGEST for each in given):
            return int(self.width), int(self.height)
        logger.warning("images: %s x %s is not a size; left out", *map(quote, given))
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
    """COCO's annotations."""

    annotations: list[Any]
    images: list[_Image] | None = None
    categories: list[_Category] | None = None


def read_coco_keypoints(path: Path, problems: dict[str, DataError] | None) -> list[ImageKeypoints]:
    """Read any of the forms, one entry for each object in each image.

    For ``problems`` see `cadalign.datasets.read_image_keypoints`.
    """
    data, objects = read_json(path, DETECTOR), []
    with in_file(path):
        file = _file_of(data)
        images, categories = _by_id(file.images, "images"), _by_id(file.categories, "categories")
    for row, entry in enumerate(file.annotations):
        where = f"[{row}]" if isinstance(data, list) else f"annotations[{row}]"
        with leaving_out(f"{path}: {where}", problems), in_file(path):
            found = _annotated(entry, where, images, categories)
            if found is not None:
                objects.append(replace(found, source=f"{path}: {where}"))
    third = np.concatenate([np.empty(0), *(o.scores for o in objects if o.scores is not None)])
    if np.isin(third, (0, 1, 2)).all() and (third == 2).any():
        # COCO's flags of a whole file: 0 not labelled, 1 labelled but hidden, 2 visible.
        objects = [o if o.scores is None else replace(o, scores=o.scores / 2) for o in objects]
    if not objects:
        none = DataError("there are no keypoints", where=str(path))
        raise next(iter((problems or {}).values()), none)
    return objects


def _file_of(data: Any) -> _File:
    """The file's parts; results of detectors are annotations without images and categories."""
    if isinstance(data, list):
        return _File(data)
    if not isinstance(data, dict):
        raise DataError(f"{quote(data)} is not an object or a list", fix=_FIX)
    if "annotations" not in data:
        raise DataError("missing", where="annotations", fix=_FIX)
    found: _File = convert(data, _File)
    return found


def _by_id(entries: Sequence[_Entry] | None, where: str) -> dict[_Id, _Entry]:
    """Images or categories by their ids; raises DataError for an id of two."""
    found: dict[_Id, _Entry] = {}
    for row, entry in enumerate(entries or ()):
        if found.setdefault(entry.id, entry) != entry:
            what = f"{quote(entry.id)} is the id of another entry, too"
            fix = "give each an id of its own; are these several files joined to one?"
            raise DataError(what, where=f"{where}[{row}].id", fix=fix)
    return found


def _annotated(
    data: Any, where: str, images: dict[_Id, _Image], categories: dict[_Id, _Category]
) -> ImageKeypoints | None:
    """The keypoints of an annotation; None where none of them is labelled."""
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
    points, third = _points(entry, place)
    if names is not None and len(names) != len(points):
        what = f"{len(points)} keypoints, but the category names {len(names)}"
        raise DataError(what, where=place)
    if third is not None and len(third) != len(points):
        raise DataError(f"{len(third)} scores of {len(points)} keypoints", where=place)
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


def _points(entry: _Object, where: str) -> tuple[FloatArray, Any]:
    """Pixels (k, 2), and visibility flags or scores (k,) if there are any."""
    value = entry.keypoints
    if value is None:
        raise DataError("missing", where=where, fix=_FIX)
    if isinstance(value, _ByAxis):
        if len(value.x) != len(value.y):
            raise DataError(f"{len(value.y)} values, but x has {len(value.x)}", where=f"{where}.y")
        return np.column_stack([_floats(value.x), _floats(value.y)]), value.visible
    flat = _floats(convert(value, list[float | None], where=where))
    if not len(flat) or len(flat) % 3:
        what = f"{len(flat)} numbers are not x, y and visibility or score of keypoints"
        raise DataError(what, where=where, fix=_FIX)
    numbers = np.reshape(flat, (-1, 3))
    return np.ascontiguousarray(numbers[:, :2]), numbers[:, 2]


def _floats(values: Any) -> FloatArray:
    """Numbers as an array, NaN for None."""
    return np.array(values, dtype=float)


def _number(entry: _Object, name: str, where: str) -> float | None:
    """A number that an object can do without; what is none is warned of and left out."""
    value = getattr(entry, name)
    if value is None or is_number(value):
        return None if value is None else float(value)
    logger.warning("%s.%s: %s is not a number; left out", where, name, quote(value))
    return None


# Masks ------------------------------------------------------------------------------------------

_MASK_FIX = "give COCO polygons, or the run lengths of a mask of this image"
_WHOLE_RUNS = re.compile("[0-o]*[0-O]")  # compressed, the last group being a length's last
_MOST_PIXELS = 2**28
_LEAST_NUMBERS = 6  # of a polygon


class _Runs(ForeignDocument):
    """A mask as lengths of runs of pixels outside and inside in turn, column by column."""

    size: tuple[Count, Count]
    counts: list[Count] | str


def decode_segmentation(segmentation: Any, *, width: int, height: int) -> BoolArray:
    """Decode the ``segmentation`` of a COCO annotation or result, (height, width) bool.

    It is, as in the JSON, a list of polygons ``[x, y, x, y, ...]`` in a frame whose origin is the
    top-left corner of the image, or ``{"size": [height, width], "counts": ...}``: lengths of runs
    as a list or as COCO's text. Raises DataError if it is neither, or of another image size, or the
    mask is empty.

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
        mask = _fill(_polygons(segmentation), width, height)
    if not mask.any():
        raise DataError("the mask is empty", where="segmentation", fix=_MASK_FIX)
    return mask


def _polygons(segmentation: Any) -> list[list[float]]:
    """Polygons, without those of fewer than three points that stand beside others."""
    given = convert(segmentation, list[list[Finite]], "segmentation")
    kept = [polygon for polygon in given if len(polygon) >= _LEAST_NUMBERS]
    if given and not kept:
        what = f"{quote(given[0])} is not a polygon of three or more points"
        raise DataError(what, where="segmentation[0]", fix=_MASK_FIX)
    if len(kept) < len(given):
        text = "segmentation: %d of %d polygons have fewer than three points; left out"
        logger.warning(text, len(given) - len(kept), len(given))
    return kept


def _decode_runs(runs: _Runs, width: int, height: int) -> BoolArray:
    from pycocotools import mask as coco  # takes a while to import

    if runs.size != (height, width):
        what = f"the mask is {runs.size[1]} x {runs.size[0]}, the image {width} x {height}"
        raise DataError(what, where="segmentation.size", fix=_MASK_FIX)
    where, size = "segmentation.counts", {"size": [height, width]}
    if isinstance(runs.counts, str):
        # Behind a last group that announces another one, pycocotools reads on.
        coded = size | {"counts": runs.counts.encode()}
        inside = _decoded(coded) if _WHOLE_RUNS.fullmatch(runs.counts) else None
        # Pixels behind the last run are what was in the memory.
        if inside is None or coco.encode(np.asfortranarray(inside))["counts"] != coded["counts"]:
            what = "is not the text of a whole mask of this image"
            raise DataError(what, where=where, fix=_MASK_FIX)
        return np.asarray(inside != 0)
    if sum(runs.counts) != width * height:
        what = f"the runs have {sum(runs.counts)} pixels, the image {width * height}"
        raise DataError(what, where=where, fix=_MASK_FIX)
    return np.asarray(
        _decoded(coco.frPyObjects(size | {"counts": runs.counts}, height, width)) != 0
    )


def _decoded(coded: dict[str, Any]) -> npt.NDArray[np.uint8] | None:
    """The pixels of compressed run lengths; None where these are of more than there are."""
    from pycocotools import mask as coco  # takes a while to import

    with suppress(ValueError), warnings.catch_warnings(action="ignore"):  # of NumPy's conventions
        return np.asarray(coco.decode(coded))
    return None


def _fill(polygons: Sequence[Sequence[float]], width: int, height: int) -> BoolArray:
    """Pixels (height, width) inside any of the polygons."""
    from pycocotools import mask as coco  # takes a while to import

    for number, polygon in enumerate(polygons):
        where = f"segmentation[{number}]"
        if len(polygon) % 2:
            what = f"{len(polygon)} numbers are not x, y of points"
            raise DataError(what, where=where, fix=_MASK_FIX)
        points = np.reshape(polygon, (-1, 2))
        # Its memory grows with the polygon's length, which far points would make large.
        if (np.abs(points) > 2 * max(width, height)).any():
            raise DataError("has points far outside of the image", where=where, fix=_MASK_FIX)
    if not polygons:
        return np.zeros((height, width), dtype=bool)
    each = [list(map(float, polygon)) for polygon in polygons]
    return np.asarray(_decoded(coco.merge(coco.frPyObjects(each, height, width))) != 0)
