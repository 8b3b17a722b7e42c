"""Masks of objects as COCO writes them: polygons, and run lengths, compressed or not.

A ``segmentation`` is a list of polygons ``[x, y, x, y, ...]`` in a frame whose origin is the
top-left corner of the image, or ``{"size": [height, width], "counts": ...}``: lengths of runs of
pixels outside and inside in turn, column by column, as a list or as COCO's text, which holds the
difference of every length from the last but one in groups of five bits.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from cadalign.arrays import BoolArray
from cadalign.errors import DataError
from cadalign.io.documents import Count, Finite, ForeignDocument, convert

_FIX = "give COCO polygons, or the run lengths of a mask of this image"
_FIRST, _LAST = 48, 111  # characters of compressed run lengths
_MOST_BITS = 35  # of a length: more than any image has pixels
_MOST_PIXELS = 2**28
_Polygon = Annotated[list[Finite], Meta(min_length=6)]


class _Runs(ForeignDocument):
    size: tuple[Count, Count]
    counts: list[Count] | str


def decode_segmentation(segmentation: Any, *, width: int, height: int) -> BoolArray:
    """Decode the ``segmentation`` of a COCO annotation or result, (height, width) bool.

    It is a list or a dictionary, as in the JSON. Raises DataError if it is neither, or of another
    image size, or the mask is empty.

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
        polygons = convert(segmentation, list[_Polygon], "segmentation")
        mask = _fill(polygons, width, height)
    if not mask.any():
        raise DataError("the mask is empty", where="segmentation", fix=_FIX)
    return mask


def _decode_runs(runs: _Runs, width: int, height: int) -> BoolArray:
    if runs.size != (height, width):
        what = f"the mask is {runs.size[1]} x {runs.size[0]}, the image {width} x {height}"
        raise DataError(what, where="segmentation.size", fix=_FIX)
    is_text = isinstance(runs.counts, str)
    counts = _decompress(runs.counts) if isinstance(runs.counts, str) else runs.counts
    if sum(counts) != width * height or min(counts, default=0) < 0:
        what = f"the runs have {sum(counts)} pixels, the image {width * height}"
        if is_text:
            what += "; is the text whole?"
        raise DataError(what, where="segmentation.counts", fix=_FIX)
    inside = np.arange(len(counts)) % 2 == 1
    return np.ascontiguousarray(np.repeat(inside, counts).reshape(width, height).T)


def _decompress(text: str) -> list[int]:
    """Run lengths of COCO's text; see ``rleFrString`` in its ``maskApi.c``."""
    counts: list[int] = []
    value = shift = 0
    for place, character in enumerate(text):
        bits = ord(character) - _FIRST
        if not 0 <= bits <= _LAST - _FIRST or shift > _MOST_BITS:
            what = f"character {place} is not of compressed run lengths"
            raise DataError(what, where="segmentation.counts", fix=_FIX)
        value |= (bits & 0x1F) << shift
        shift += 5
        if bits & 0x20:
            continue
        if bits & 0x10:
            value -= 1 << shift
        counts.append(value + (counts[-2] if len(counts) > 2 else 0))
        value = shift = 0
    if shift:
        raise DataError("the text is cut short", where="segmentation.counts", fix=_FIX)
    return counts


def _fill(polygons: Sequence[Sequence[float]], width: int, height: int) -> BoolArray:
    """Pixels (height, width) inside any of the polygons."""
    from pycocotools import mask  # takes a while to import

    for number, polygon in enumerate(polygons):
        where = f"segmentation[{number}]"
        if len(polygon) % 2:
            raise DataError(f"{len(polygon)} numbers are not x, y of points", where=where, fix=_FIX)
        points = np.reshape(polygon, (-1, 2))
        # Its memory grows with the polygon's length, which far points would make large.
        if (np.abs(points) > 2 * max(width, height)).any():
            raise DataError("has points far outside of the image", where=where, fix=_FIX)
    if not polygons:
        return np.zeros((height, width), dtype=bool)
    runs = mask.merge(
        mask.frPyObjects([list(map(float, each)) for each in polygons], height, width)
    )
    with warnings.catch_warnings(action="ignore"):  # its of NumPy's newer conventions
        return np.asarray(mask.decode(runs) != 0)
