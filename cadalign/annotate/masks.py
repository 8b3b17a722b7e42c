"""Pixels of a photo: masks from strokes, boxes and files, and corners that clicks snap to."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.annotate.evidence import MaskDrawing, Point2
from cadalign.arrays import BoolArray
from cadalign.errors import InputError
from cadalign.io.images import read_grey

_SHIFT = 4  # bits of parts of a pixel in OpenCV's drawing
_LONGEST_CUT = 800  # side of the photo in which a box is cut out [px]
_CUT_ROUNDS = 5
_LEAST_BOX = 4.0  # [px]
_MARGIN = 8  # around the reach, for the derivatives [px]
_QUALITY = 0.3  # of a corner, over the best one within reach
_CONTRAST = 3.0  # least standard deviation of grey values within reach
_WINDOW = 3
_DRIFT = 4.0  # that the refinement may move a corner [px]


def draw_mask(drawing: MaskDrawing, width: int, height: int) -> BoolArray:
    """The pixels (h, w) of a mask.

    Examples
    --------
    >>> from cadalign.annotate.evidence import Stroke
    >>> square = Stroke(points=((1, 1), (3, 1), (3, 3), (1, 3)))
    >>> draw_mask(MaskDrawing(strokes=(square,)), 6, 5).sum().item()
    9
    """
    mask = np.zeros((height, width), dtype=np.uint8)
    if drawing.base is not None:
        mask[:] = read_grey(Path(drawing.base)) != 0
    for stroke in drawing.strokes:
        value = int(stroke.adds)
        if stroke.runs:
            mask[decode_runs(stroke.runs, width, height)] = value
            continue
        points = np.round(np.array(stroke.points) * 2**_SHIFT).astype(np.int32)
        if stroke.radius is None:
            cv2.fillPoly(mask, [points], value, shift=_SHIFT)
            continue
        thickness = max(1, round(2 * stroke.radius))
        cv2.polylines(mask, [points], False, value, thickness, shift=_SHIFT)
        for end in (points[0], points[-1]):
            radius = round(stroke.radius * 2**_SHIFT)
            cv2.circle(mask, end.tolist(), radius, value, cv2.FILLED, shift=_SHIFT)
    return mask.astype(bool)


def encode_runs(mask: BoolArray) -> tuple[int, ...]:
    """The numbers of pixels outside and inside in turn, row by row.

    Examples
    --------
    >>> encode_runs(np.array([[False, True], [True, False]]))
    (1, 2, 1)
    """
    flat = np.concatenate([[False], mask.ravel()])
    changes = np.flatnonzero(flat[1:] != flat[:-1])
    return tuple(np.diff(np.concatenate([[0], changes, [mask.size]])).tolist())


def decode_runs(runs: tuple[int, ...], width: int, height: int) -> BoolArray:
    """The pixels (h, w) of `encode_runs`; raises InputError if there are more or fewer."""
    if any(run < 0 for run in runs) or sum(runs) != width * height:
        raise InputError(
            f"not the {width} x {height} pixels of the photo",
            where="mask",
            fix="give a mask of the photo's size",
        )
    inside = np.arange(len(runs)) % 2 == 1
    return np.repeat(inside, runs).reshape(height, width)


def cut_out(photo: npt.NDArray[np.uint8], corners: npt.NDArray[np.float64]) -> BoolArray:
    """Segment the object in a box of the photo (h, w, 3) by its colours.

    GrabCut: Rother, Kolmogorov, Blake, "GrabCut: interactive foreground extraction using iterated
    graph cuts" (2004). ``corners`` (2, 2) are two of the box [px]. Raises InputError if the box is
    too small, fills the photo, or holds nothing that differs.
    """
    height, width = photo.shape[:2]
    scale = min(1.0, _LONGEST_CUT / max(width, height))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
    low, high = np.clip(np.sort(corners, axis=0), 0, (width - 1, height - 1))
    if (high - low).min() < _LEAST_BOX:
        raise InputError("the box is too small", where="box", fix="draw it around the object")
    left, top = np.floor(low * scale).astype(int).tolist()
    right, bottom = np.ceil(high * scale).astype(int).tolist()
    labels = np.full(small.shape[:2], cv2.GC_BGD, dtype=np.uint8)
    labels[top : bottom + 1, left : right + 1] = cv2.GC_PR_FGD
    if not (labels == cv2.GC_BGD).any():
        raise InputError(
            "the box fills the photo", where="box", fix="draw it close around the object"
        )
    cv2.setRNGSeed(0)
    colors = np.zeros((2, 1, 65))
    image = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    cv2.grabCut(
        image, labels, (0, 0, 1, 1), colors[0], colors[1], _CUT_ROUNDS, cv2.GC_INIT_WITH_MASK
    )
    found = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8)
    if not found.any():
        raise InputError(
            "nothing in the box differs from what is around it",
            where="box",
            fix="paint the object, or draw a polygon",
        )
    whole = cv2.resize(255 * found, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(whole >= 128)


def nearest_corner(image: npt.NDArray[np.uint8], uv: Point2, *, reach: float) -> Point2 | None:
    """The nearest corner of a photo (h, w, 3) within ``reach`` [px], to parts of a pixel.

    Shi, Tomasi, "Good features to track" (1994), refined by the gradients about it. None without
    one.

    Examples
    --------
    >>> photo = np.zeros((40, 40, 3), dtype=np.uint8)
    >>> photo[20:, 20:] = 255
    >>> u, v = nearest_corner(photo, (22.0, 18.0), reach=6)
    >>> abs(u - 19.5) < 0.6, abs(v - 19.5) < 0.6
    (True, True)
    """
    height, width = image.shape[:2]
    size = int(np.ceil(reach)) + _MARGIN
    left, top = max(0, round(uv[0]) - size), max(0, round(uv[1]) - size)
    right, bottom = min(width, round(uv[0]) + size + 1), min(height, round(uv[1]) + size + 1)
    patch = cv2.cvtColor(np.ascontiguousarray(image[top:bottom, left:right]), cv2.COLOR_RGB2GRAY)
    rows, columns = np.indices(patch.shape)
    inside = np.hypot(columns + left - uv[0], rows + top - uv[1]) <= reach
    if not inside.any() or np.std(patch[inside]) < _CONTRAST:
        return None
    mask = np.where(inside, 255, 0).astype(np.uint8)
    found = cv2.goodFeaturesToTrack(patch, 16, _QUALITY, 3.0, mask=mask)
    if found is None:
        return None  # type: ignore[unreachable]
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.01)
    refined = cv2.cornerSubPix(patch, found.copy(), (_WINDOW, _WINDOW), (-1, -1), stop)
    drift = np.linalg.norm(refined - found, axis=2)
    places = np.where(drift[..., None] <= _DRIFT, refined, found)[:, 0] + (left, top)
    gaps = np.linalg.norm(places - uv, axis=1)
    u, v = places[int(np.argmin(gaps))].tolist()
    return min(max(u, -0.5), width - 0.5), min(max(v, -0.5), height - 0.5)
