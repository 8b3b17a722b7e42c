"""The focal length that a photo's EXIF data state."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping
from typing import Any

from cadalign.io.images import open_photo

logger = logging.getLogger("cadalign")

_SHORTEST, _LONGEST = 0.1, 50.0  # focal lengths that a camera has [longer sides of the image]
_FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)
# EXIF tags, and the length of their units [mm].
_EXIF_IFD = 0x8769
_FOCAL_LENGTH = 0x920A
_DIGITAL_ZOOM = 0xA404
_FOCAL_LENGTH_35MM = 0xA405
_PLANE_X_RESOLUTION = 0xA20E
_PLANE_UNIT = 0xA210
_PIXEL_X_DIMENSION = 0xA002
_PIXEL_Y_DIMENSION = 0xA003
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}


def read_focal(path: str | os.PathLike[str]) -> float | None:
    """Read the focal length [px]; None where the photo does not say.

    One that no camera has is ignored with a warning. Raises DataError if the file is missing or not
    an image.
    """
    with open_photo(path) as image:
        tags, size = image.getexif().get_ifd(_EXIF_IFD), image.size
    focal, side = _focal_in_pixels(tags, *size), max(size)
    if focal is None or _SHORTEST * side < focal < _LONGEST * side:
        return focal
    text = "%s: the EXIF data state a focal length of %.4g px, which no camera has; ignored"
    logger.warning(text, path, focal)
    return None


def _focal_in_pixels(tags: Mapping[int, Any], width: int, height: int) -> float | None:
    """The focal length [px] that EXIF tags state; None where they do not."""
    equivalent = _positive(tags, _FOCAL_LENGTH_35MM)
    if equivalent is not None:  # which has the digital zoom in it
        return equivalent / _FULL_FRAME_DIAGONAL_MM * math.hypot(width, height)
    millimetres, density = _positive(tags, _FOCAL_LENGTH), _positive(tags, _PLANE_X_RESOLUTION)
    x = _positive(tags, _PIXEL_X_DIMENSION) or float(width)
    y = _positive(tags, _PIXEL_Y_DIMENSION) or float(height)
    is_cropped = abs(x * height - y * width) > 0.01 * y * width  # since it was taken
    if millimetres is None or density is None or is_cropped:
        return None
    zoom = max(_positive(tags, _DIGITAL_ZOOM) or 1.0, 1.0)
    unit = _UNIT_MM.get(tags.get(_PLANE_UNIT, 2), 25.4)
    return millimetres * zoom * density / unit * width / x


def _positive(tags: Mapping[int, Any], tag: int) -> float | None:
    """A tag's value; None where it is missing or no positive number: 0 says that it is unknown."""
    try:
        value = float(tags.get(tag, 0.0))
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return value if 0 < value < math.inf else None
