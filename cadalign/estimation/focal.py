"""Search range and priors of an unknown focal length, from EXIF data for example."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray, as_positive
from cadalign.errors import brief
from cadalign.geometry.camera import Camera

logger = logging.getLogger("cadalign")

SHORTEST, LONGEST = 0.1, 50.0
"""Over the longer side of the image: fields of view from 157 to 1 degrees."""
_GRID = (0.15, 0.22, 0.3, 0.4, 0.55, 0.72, 0.95, 1.25, 1.65, 2.3, 3.3, 5.0, 10.0, 30.0)

_EXIF_SIGMA = 0.05  # roundings, focusing, and corrections of the lens inside the camera
_SAME_LENS = 0.01
_CONTRADICTION = 1.25
_CONTRADICTING_SIGMAS = 3.0
_FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)
# EXIF tags, and the length of their units [mm].
_EXIF_IFD = 0x8769
_FOCAL_LENGTH = 0x920A
_FOCAL_LENGTH_35MM = 0xA405
_PLANE_X_RESOLUTION = 0xA20E
_PLANE_UNIT = 0xA210
_PIXEL_X_DIMENSION = 0xA002
_PIXEL_Y_DIMENSION = 0xA003
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}


@dataclass(frozen=True)
class FocalPrior:
    """Prior on a focal length: a Gaussian on its logarithm.

    Parameters
    ----------
    focal : float
        The horizontal focal length [px].
    relative_sigma : float
        Its standard deviation, relative: 0.05 is 5 %.

    Raises
    ------
    InputError
        If a value is not positive.

    Examples
    --------
    >>> FocalPrior(935.0)
    FocalPrior(focal=935.0, relative_sigma=0.05)
    """

    focal: float
    relative_sigma: float = _EXIF_SIGMA

    def __post_init__(self) -> None:
        for name in ("focal", "relative_sigma"):
            value = getattr(self, name)
            object.__setattr__(self, name, as_positive(value, name=f"focal_prior.{name}"))

    def is_like(self, other: FocalPrior) -> bool:
        """True if both can be of one lens: the focal lengths differ by less than 1 %."""
        return abs(math.log(self.focal / other.focal)) < _SAME_LENS

    @classmethod
    def from_exif(
        cls, path: str | os.PathLike[str], *, relative_sigma: float = _EXIF_SIGMA
    ) -> FocalPrior | None:
        """Read a photo's focal length from its EXIF data.

        From the 35 mm equivalent (taken along the diagonal, as CIPA defines it), otherwise from the
        focal length and the pixels' size on the sensor. Values that cannot be right, such as a
        focal length of 0, are ignored with a warning (logger "cadalign").

        Parameters
        ----------
        path : str or path-like
            The photo.
        relative_sigma : float
            How far to trust it.

        Returns
        -------
        FocalPrior or None
            None where the photo does not say.

        Raises
        ------
        DataError
            If the file is missing or not an image.
        """
        from cadalign.io.images import open_photo  # only here: a known focal length needs none

        with open_photo(path) as image:
            tags = dict(image.getexif().get_ifd(_EXIF_IFD))
            width, height = image.size
        focal = _focal_in_pixels(tags, width, height, str(path))
        return None if focal is None else cls(focal, relative_sigma)


def focal_bounds(camera: Camera) -> tuple[float, float]:
    """The range in which the focal length is searched for [px]."""
    side = max(camera.width, camera.height)
    return SHORTEST * side, LONGEST * side


def log_focal_range(
    camera: Camera, prior: FocalPrior | None, unit: float = 1.0
) -> tuple[float, float, float, float]:
    """Bounds of a log focal length, which a prior may widen, and its mean and weight.

    Focal lengths are in ``unit`` [px].
    """
    low, high = (math.log(bound / unit) for bound in focal_bounds(camera))
    if prior is None:
        return low, high, 0.0, 0.0
    mean = math.log(prior.focal / unit)
    return min(low, mean), max(high, mean), mean, prior.relative_sigma**-2


def focal_grid(camera: Camera, prior: FocalPrior | None) -> FloatArray:
    """Focal lengths from which the search starts [px]; with a prior those near it, and it."""
    grid = np.array(_GRID) * max(camera.width, camera.height)
    if prior is None:
        return grid
    near = np.abs(np.log(grid / prior.focal)) < max(4 * prior.relative_sigma, 0.5)
    return np.sort(np.append(grid[near], prior.focal))


def focal_doubt(camera: Camera, prior: FocalPrior | None) -> str | None:
    """Warning about a camera whose estimated focal length is doubtful, or None."""
    if prior is not None:
        off = math.log(camera.fx / prior.focal)
        if abs(off) > _CONTRADICTING_SIGMAS * prior.relative_sigma:
            return (
                f"the keypoints contradict the focal length's prior: {camera.fx:.4g} px "
                f"instead of {prior.focal:.4g} px +-{100 * prior.relative_sigma:.2g} %"
            )
    if np.isclose(camera.fx, focal_bounds(camera), rtol=1e-6).any():
        return (
            f"the focal length is the end of the searched range ({camera.fx:.4g} px): "
            "the keypoints fit best at one that no camera has"
        )
    return None


def _focal_in_pixels(tags: Mapping[int, Any], width: int, height: int, where: str) -> float | None:
    """The focal length that EXIF tags state, or None, with a warning where they can't be right."""
    equivalent = _positive(tags, _FOCAL_LENGTH_35MM, "FocalLengthIn35mmFilm", where)
    millimetres = _positive(tags, _FOCAL_LENGTH, "FocalLength", where)
    density = _positive(tags, _PLANE_X_RESOLUTION, "FocalPlaneXResolution", where)
    focals = []
    if equivalent is not None:
        focals.append(equivalent / _FULL_FRAME_DIAGONAL_MM * math.hypot(width, height))
    if millimetres is not None and density is not None:
        unit = _UNIT_MM.get(tags.get(_PLANE_UNIT, 2), 25.4)
        original = _original_width(tags, width, height)
        if original is not None:
            focals.append(millimetres * density / unit * width / original)
    side = max(width, height)
    if any(not SHORTEST * side < focal < LONGEST * side for focal in focals):
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
    if tag == _FOCAL_LENGTH_35MM and value == 0:  # EXIF's way to say that it is not known
        return None
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
