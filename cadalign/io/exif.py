"""The focal length that a photo's EXIF data state."""

from __future__ import annotations

import logging
import math
import os
import re
from collections.abc import Mapping
from typing import Any

from cadalign.errors import brief
from cadalign.io.images import open_photo

logger = logging.getLogger("cadalign")

_SHORTEST, _LONGEST = 0.1, 50.0  # focal lengths that a camera has [longer sides of the image]
_CONTRADICTION = 1.25  # ratio of two statements of one focal length
_FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)
# EXIF tags, and the length of their units [mm].
_EXIF_IFD = 0x8769
_MODEL = 0x0110
_FOCAL_LENGTH = 0x920A
_DIGITAL_ZOOM = 0xA404
_FOCAL_LENGTH_35MM = 0xA405
_PLANE_X_RESOLUTION = 0xA20E
_PLANE_UNIT = 0xA210
_PIXEL_X_DIMENSION = 0xA002
_PIXEL_Y_DIMENSION = 0xA003
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_SENSOR_WIDTHS_MM = (
    (r"canon eos (5ds?r?|6d|r|rp|r[1356])( mark \w+|m\d)?$", 36.0),
    (r"canon eos (\d{2,4}d\b|rebel|kiss|m\d*\b|r(7|10|50|100)$)", 22.3),
    (r"nikon (d[3456][sx]?|d[678]\d\d[aes]?|z ?[56789f](_\d|ii)?)$", 35.9),
    (r"nikon (d\d+\w?|z ?(30|50|fc)(_\d)?)$", 23.5),
    (r"ilce-(1|7\w*|9\w*)$", 35.7),
    (r"ilce-\d{4}|nex-\w+$", 23.5),
    (r"x-(t|e|h|pro)\d+\w*$|x100\w*$", 23.5),
    (r"e-(m|p|pl|pm)\d\w*$|dmc-g\w+$|dc-g\w+$", 17.3),
    (r"dsc-rx100\w*$|fc6310\w*$|l1d-20c$", 13.2),
    (r"hero\d", 6.17),
)
"""Widths of sensors by patterns of camera models' names in EXIF data, from their makers' data."""


def read_focal(path: str | os.PathLike[str]) -> float | None:
    """Read the focal length [px]; None where the photo does not say.

    Values that cannot be right are ignored with a warning. Raises DataError if the file is missing
    or not an image.
    """
    with open_photo(path) as image:
        exif = image.getexif()
        tags = {_MODEL: exif.get(_MODEL), **exif.get_ifd(_EXIF_IFD)}
        width, height = image.size
    return _focal_in_pixels(tags, width, height, str(path))


def _focal_in_pixels(tags: Mapping[int, Any], width: int, height: int, where: str) -> float | None:
    """The focal length that EXIF tags state, or None, with a warning where they can't be right."""
    equivalent = _positive(tags, _FOCAL_LENGTH_35MM, "FocalLengthIn35mmFilm", where)
    millimetres = _positive(tags, _FOCAL_LENGTH, "FocalLength", where)
    density = _positive(tags, _PLANE_X_RESOLUTION, "FocalPlaneXResolution", where)
    focals = []
    if equivalent is not None:
        focals.append(equivalent / _FULL_FRAME_DIAGONAL_MM * math.hypot(width, height))
    original = _original_width(tags, width, height)
    if millimetres is not None and original is not None:
        # The 35 mm equivalent holds the digital zoom already, the lens's own focal length does not.
        millimetres *= max(_positive(tags, _DIGITAL_ZOOM, "DigitalZoomRatio", where) or 1.0, 1.0)
        name = str(tags.get(_MODEL) or "").strip("\0 ").lower()
        sensors = [each for pattern, each in _SENSOR_WIDTHS_MM if re.match(pattern, name)]
        if density is not None:
            unit = _UNIT_MM.get(tags.get(_PLANE_UNIT, 2), 25.4)
            focals.append(millimetres * density / unit * width / original)
        elif equivalent is None and sensors:
            focals.append(millimetres / sensors[0] * max(width, height))
    side = max(width, height)
    if any(not _SHORTEST * side < focal < _LONGEST * side for focal in focals):
        named = ", ".join(f"{focal:.4g} px" for focal in focals)
        logger.warning(
            "%s: the EXIF data state a focal length of %s, which no camera has; ignored",
            where,
            named,
        )
        return None
    if len(focals) == 2 and not 1 / _CONTRADICTION < focals[0] / focals[1] < _CONTRADICTION:
        logger.warning(
            "%s: the EXIF data contradict themselves, the focal length is %.4g px by its 35 mm "
            "equivalent and %.4g px by the sensor's resolution; ignored",
            where,
            *focals,
        )
        return None
    return focals[0] if focals else None


def _positive(tags: Mapping[int, Any], tag: int, name: str, where: str) -> float | None:
    """A tag's value; None where it is missing, or, with a warning, where it is nonsense."""
    if tag not in tags:
        return None
    try:
        value = float(tags[tag])
    except (TypeError, ValueError, ZeroDivisionError):
        value = math.nan
    if 0 < value < math.inf:
        return value
    if tag in (_FOCAL_LENGTH_35MM, _DIGITAL_ZOOM) and value == 0:
        return None  # EXIF's way to say that it is not known, or not used
    logger.warning("%s: the EXIF data state %s %s; ignored", where, name, brief(tags[tag]))
    return None


def _original_width(tags: Mapping[int, Any], width: int, height: int) -> float | None:
    """The width of the photo as it was taken [px]; None where it was cropped since."""
    x, y = tags.get(_PIXEL_X_DIMENSION, width), tags.get(_PIXEL_Y_DIMENSION, height)
    try:
        same_shape = abs(x * height - y * width) <= 0.01 * y * width
        return float(x) if same_shape and x > 0 else None
    except (TypeError, ValueError):
        return None
