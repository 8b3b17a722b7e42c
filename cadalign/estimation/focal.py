"""Search range and priors of an unknown focal length, from EXIF data for example."""

from __future__ import annotations

import logging
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np

from cadalign.arrays import FloatArray, as_positive
from cadalign.errors import InputError, brief
from cadalign.estimation.warning import EstimateWarning
from cadalign.geometry.camera import Camera

logger = logging.getLogger("cadalign")

SHORTEST, LONGEST = 0.1, 50.0
"""Over the longer side of the image: fields of view from 157 to 1 degrees."""
_GRID = (0.15, 0.22, 0.3, 0.4, 0.55, 0.72, 0.95, 1.25, 1.65, 2.3, 3.3, 5.0, 10.0, 30.0)

USUAL: Final = "usual"
"""In the place of a prior: that of usual lenses, `FocalPrior.of_usual_lenses`."""
_USUAL_FOCAL = 1.2  # over the longer side of the image
_USUAL_SIGMA = 0.6
_EXIF_SIGMA = 0.05  # roundings, focusing, and corrections of the lens inside the camera
_SAME_LENS = 0.01
_CONTRADICTION = 1.25
_CONTRADICTING_SIGMAS = 3.0
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


@dataclass(frozen=True)
class FocalPrior:
    """Prior on a focal length: a Gaussian on its logarithm.

    Parameters
    ----------
    focal : float
        The horizontal focal length [px].
    relative_sigma : float
        Its standard deviation, relative: 0.05 is 5 %.
    source : str
        What it was taken from, for the texts of results.

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
    source: str = field(default="", compare=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("focal", "relative_sigma"):
            value = getattr(self, name)
            object.__setattr__(self, name, as_positive(value, name=f"focal_prior.{name}"))

    def is_like(self, other: FocalPrior) -> bool:
        """True if both can be of one lens: the focal lengths differ by less than 1 %."""
        return abs(math.log(self.focal / other.focal)) < _SAME_LENS

    def __str__(self) -> str:
        """The focal length with its standard deviation and source."""
        return f"{self.focal:.4g} px +- {100 * self.relative_sigma:.2g} %" + (
            f", {self.source}" if self.source else ""
        )

    @classmethod
    def of_usual_lenses(cls, width: int, height: int) -> FocalPrior:
        """The prior on the focal length of a photo of which nothing but the size is known.

        Its mean is 1.2 times the longer side, the guess of COLMAP and openMVG where a photo does
        not say, and its 95 % range, 0.37 to 3.9 times the longer side, is that of lenses of 13 to
        140 mm (35 mm equivalent): wide phones to telephoto lenses. It holds 99 % of the
        distribution of photos' focal lengths, log-normal above 14 mm, that Hold-Geoffroy et al.
        draw from, "A Perceptual Measure for Deep Single Image Camera Calibration", CVPR 2018.

        Parameters
        ----------
        width, height : int
            Image size [px].

        Examples
        --------
        >>> print(FocalPrior.of_usual_lenses(640, 480))
        768 px +- 60 %, usual lenses
        """
        return cls(_USUAL_FOCAL * max(width, height), _USUAL_SIGMA, "usual lenses")

    @classmethod
    def from_exif(
        cls, path: str | os.PathLike[str], *, relative_sigma: float = _EXIF_SIGMA
    ) -> FocalPrior | None:
        """Read a photo's focal length from its EXIF data.

        From the 35 mm equivalent (taken along the diagonal, as CIPA defines it), otherwise from the
        focal length, times the digital zoom, and the pixels' size on the sensor, or else the
        sensor's width, where the camera's model is known. A photo turned upright has the same focal
        length. Values that cannot be right, such as a focal length of 0, are ignored with a warning
        (logger "cadalign").

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
            exif = image.getexif()
            tags = {_MODEL: exif.get(_MODEL), **exif.get_ifd(_EXIF_IFD)}
            width, height = image.size
        focal = _focal_in_pixels(tags, width, height, str(path))
        return None if focal is None else cls(focal, relative_sigma, "the photo's EXIF data")


PriorOption = FocalPrior | Literal["usual"] | None
"""Prior on an unknown focal length: one's own, that of usual lenses, or none."""


def prior_of_camera(prior: PriorOption, camera: Camera) -> FocalPrior | None:
    """The prior on the focal length of a camera."""
    if prior == USUAL:
        return FocalPrior.of_usual_lenses(camera.width, camera.height)
    assert not isinstance(prior, str)
    return prior


def check_prior(prior: object, *, focal: str) -> None:
    """Refuse what is no prior, and one on a known focal length."""
    if prior is None or (isinstance(prior, str) and prior == USUAL):
        return
    if not isinstance(prior, FocalPrior):
        what = f"expected a cadalign.FocalPrior, 'usual' or None, got {type(prior).__name__}"
        raise InputError(what, where="focal_prior")
    if focal != "estimate":
        raise InputError(
            "given for a known focal length",
            where="focal_prior",
            fix='give focal="estimate" with it',
        )


def check_estimable(cameras: Sequence[Camera]) -> None:
    """Refuse to estimate the focal length of a wide lens."""
    for camera in cameras:
        if camera.is_wide:
            what = f"the focal length of a {camera.lens} lens is not estimated"
            raise InputError(what, where="focal", fix='calibrate it, and give focal="known"')


def focal_bounds(camera: Camera) -> tuple[float, float]:
    """The range in which the focal length is searched for [px]."""
    side = max(camera.width, camera.height)
    return SHORTEST * side, LONGEST * side


def log_focal_range(
    camera: Camera, prior: PriorOption, unit: float = 1.0
) -> tuple[float, float, float, float]:
    """Bounds of a log focal length, which a prior may widen, and its mean and weight.

    Focal lengths are in ``unit`` [px].
    """
    prior = prior_of_camera(prior, camera)
    low, high = (math.log(bound / unit) for bound in focal_bounds(camera))
    if prior is None:
        return low, high, 0.0, 0.0
    mean = math.log(prior.focal / unit)
    return min(low, mean), max(high, mean), mean, prior.relative_sigma**-2


def focal_grid(camera: Camera, prior: PriorOption) -> FloatArray:
    """Focal lengths from which the search starts [px]; with a prior those near it, and it."""
    prior = prior_of_camera(prior, camera)
    grid = np.array(_GRID) * max(camera.width, camera.height)
    if prior is None:
        return grid
    near = np.abs(np.log(grid / prior.focal)) < max(4 * prior.relative_sigma, 0.5)
    return np.sort(np.append(grid[near], prior.focal))


def focal_doubt(camera: Camera, prior: PriorOption) -> EstimateWarning | None:
    """Warning about a camera whose estimated focal length is doubtful, or None."""
    prior = prior_of_camera(prior, camera)
    if prior is not None:
        off = math.log(camera.fx / prior.focal)
        if abs(off) > _CONTRADICTING_SIGMAS * prior.relative_sigma:
            return EstimateWarning(
                "focal",
                f"the keypoints contradict the focal length's prior: {camera.fx:.4g} px "
                f"instead of {prior}",
            )
    if np.isclose(camera.fx, focal_bounds(camera), rtol=1e-6).any():
        return EstimateWarning(
            "focal",
            f"the focal length is the end of the searched range ({camera.fx:.4g} px): "
            "the keypoints fit best at one that no camera has",
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
