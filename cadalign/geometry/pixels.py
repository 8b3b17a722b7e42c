"""Places of pixels: where coordinates begin, and where a pixel goes when an image is resized."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError, quote

PIXEL_CENTRE = 0.5
"""The centre of the top-left pixel, in x and y, in OpenGL, COLMAP and NeRF programs."""

PixelOrigin = Literal["center", "corner"]
"""Place of pixel (0, 0): the centre of the top-left pixel, or the image's top-left corner."""


def shift_of(pixel_origin: object, *, where: str = "pixel_origin") -> float:
    """Coordinates of the top-left pixel's centre under a convention [px]: 0 or 0.5."""
    if not isinstance(pixel_origin, str) or pixel_origin not in get_args(PixelOrigin):
        raise InputError(
            f"{quote(pixel_origin)} is not a place of pixel (0, 0)",
            where=where,
            fix='give "center" (of the top-left pixel) or "corner" (of the image)',
        )
    return PIXEL_CENTRE if pixel_origin == "corner" else 0.0


def rescaled_pixels(pixels: FloatArray, factor: float | FloatArray) -> FloatArray:
    """Pixels (n, 2) in an image ``factor`` times as large: borders, not centres, stay in place.

    Examples
    --------
    >>> rescaled_pixels(np.array([[0.0, 9.5]]), 2).tolist()
    [[0.5, 19.5]]
    """
    return np.asarray((pixels + PIXEL_CENTRE) * factor - PIXEL_CENTRE)
