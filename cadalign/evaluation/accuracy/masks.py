"""Damages that masks of real photos have, at random."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray
from cadalign.errors import InputError, quote

DAMAGES = ("exact", "dilated", "eroded", "smoothed", "hidden", "hole", "blob")
"""Kinds of masks: without damage; with a contour 2 px outside or inside; with a contour that
wanders by 2 px; a quarter hidden by a rectangle; with a hole; with a blob of the background."""

_SHIFT = 2  # [px], of a dilated or eroded contour
_WANDER = 2.0  # [px], deviation of a smoothed contour
_WANDER_LENGTH = 5.0  # [px], over which it wanders
_HIDDEN = 0.25  # share of the area
_SIZE = 0.13  # radius of holes and blobs, relative to the root of the area


def damaged_mask(mask: npt.ArrayLike, kind: str, rng: np.random.Generator) -> BoolArray:
    """A mask (h, w) with a damage of one of the kinds `DAMAGES`.

    Raises
    ------
    InputError
        If the kind is unknown.
    """
    pixels = np.asarray(mask).astype(np.uint8)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _SHIFT + 1, 2 * _SHIFT + 1))
    if kind == "exact":
        return pixels > 0
    if kind == "dilated":
        return np.asarray(cv2.dilate(pixels, disc) > 0)
    if kind == "eroded":
        return np.asarray(cv2.erode(pixels, disc) > 0)
    if kind == "smoothed":
        return _wandering(pixels, rng)
    if kind == "hidden":
        return _hidden(pixels, rng)
    if kind == "hole":
        return _with_disc(pixels, np.argwhere(pixels > 0), 0, rng)
    if kind == "blob":
        edge = (pixels > 0) & (cv2.erode(pixels, np.ones((3, 3), np.uint8)) == 0)
        return _with_disc(pixels, np.argwhere(edge), 1, rng)
    raise InputError(f"{quote(kind)} is none of {', '.join(DAMAGES)}", where="kind")


def _wandering(pixels: npt.NDArray[np.uint8], rng: np.random.Generator) -> BoolArray:
    inside = cv2.distanceTransform(pixels, cv2.DIST_L2, 5)
    outside = cv2.distanceTransform(1 - pixels, cv2.DIST_L2, 5)
    field = cv2.GaussianBlur(rng.normal(size=pixels.shape), (0, 0), _WANDER_LENGTH)
    return np.asarray(inside - outside + field * (_WANDER / field.std()) > 0)


def _hidden(pixels: npt.NDArray[np.uint8], rng: np.random.Generator) -> BoolArray:
    """The mask without all that lies beyond a line of pixels, at a random side."""
    turns = int(rng.integers(4))
    turned = np.rot90(pixels, turns)
    shares = np.cumsum(turned.sum(axis=1)) / turned.sum()
    rest = turned.copy()
    rest[: int(np.searchsorted(shares, _HIDDEN)) + 1] = 0
    return np.rot90(rest, -turns) > 0


def _with_disc(
    pixels: npt.NDArray[np.uint8],
    centres: npt.NDArray[np.int64],
    value: int,
    rng: np.random.Generator,
) -> BoolArray:
    row, column = centres[rng.integers(len(centres))].tolist()
    drawn = pixels.copy()
    radius = round(_SIZE * float(np.sqrt(pixels.sum())))
    cv2.circle(drawn, (column, row), radius, value, thickness=-1)
    return drawn > 0
