"""Priors on focal lengths, and the focal length in a photo's EXIF data."""

from __future__ import annotations

import logging
import math
import os
from dataclasses import dataclass, field
from typing import Final, Literal

from cadalign.arrays import as_positive, is_number
from cadalign.errors import InputError
from cadalign.geometry.camera import Camera

logger = logging.getLogger("cadalign")

SHORTEST, LONGEST = 0.1, 50.0
"""Range of plausible focal lengths [longer side of the image]: fields of view of 157 to 1 deg."""
USUAL: Final = "usual"
"""Option for the prior of usual lenses, `FocalPrior.from_size`."""
_USUAL_FOCAL = 1.2  # over the longer side of the image
_USUAL_SIGMA = 0.6
_EXIF_SIGMA = 0.05  # rounding, focusing, and lens corrections inside the camera
_SAME_LENS = 0.01
_FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)


@dataclass(frozen=True)
class FocalPrior:
    """Prior on a focal length: a Gaussian on its logarithm.

    Parameters
    ----------
    focal : float
        The horizontal focal length [px].
    relative_sigma : float
        Its relative standard deviation: 0.05 is 5 %.
    source : str
        Origin of the value, shown with results.

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
        """True if both may describe one lens: the focal lengths differ by less than 1 %."""
        return abs(math.log(self.focal / other.focal)) < _SAME_LENS

    def __str__(self) -> str:
        """Format the focal length with its standard deviation and source."""
        return f"{self.focal:.4g} px +- {100 * self.relative_sigma:.2g} %" + (
            f", {self.source}" if self.source else ""
        )

    @classmethod
    def from_size(cls, width: int, height: int) -> FocalPrior:
        """Build the prior for a photo of which only the size is known.

        Its mean is 1.2 times the longer side, the default of COLMAP and openMVG for photos without
        EXIF data. Its 95 % range, 0.37 to 3.9 times the longer side, corresponds to lenses of 13 to
        140 mm (35 mm equivalent), from wide-angle phones to telephoto lenses. This range holds 99 %
        of the distribution in Hold-Geoffroy et al., "A Perceptual Measure for Deep Single Image
        Camera Calibration", CVPR 2018: log-normal above 14 mm.

        Parameters
        ----------
        width, height : int
            Image size [px].

        Examples
        --------
        >>> print(FocalPrior.from_size(640, 480))
        768 px +- 60 %, usual lenses
        """
        return cls(_USUAL_FOCAL * max(width, height), _USUAL_SIGMA, "usual lenses")

    @classmethod
    def from_exif(cls, path: str | os.PathLike[str]) -> FocalPrior | None:
        """Read a photo's focal length from its EXIF data.

        It is computed from the 35 mm equivalent along the diagonal, as CIPA defines it, and holds
        for the photo turned upright, too. An implausible value is ignored with a warning (logger
        "cadalign").

        Parameters
        ----------
        path : str or path-like
            The photo.

        Returns
        -------
        FocalPrior or None
            None if the photo has no focal length.

        Raises
        ------
        DataError
            If the file is missing or not an image.
        """
        from PIL.ExifTags import IFD, Base

        from cadalign.io.images import open_photo  # imported only when needed

        with open_photo(path) as image:
            found, size = image.getexif().get_ifd(IFD.Exif), image.size
        equivalent = found.get(Base.FocalLengthIn35mmFilm, 0)
        if not is_number(equivalent) or equivalent <= 0:  # 0 means unknown
            return None
        focal = equivalent / _FULL_FRAME_DIAGONAL_MM * math.hypot(*size)
        if SHORTEST < focal / max(size) < LONGEST:
            return cls(focal, source="the photo's EXIF data")
        text = "%s: the EXIF focal length of %.4g px is implausible and ignored"
        logger.warning(text, path, focal)
        return None


PriorOption = FocalPrior | Literal["usual"] | None
"""Prior on an unknown focal length: a given prior, the prior of usual lenses, or none."""


def prior_of_camera(prior: PriorOption, camera: Camera) -> FocalPrior | None:
    """Return the prior on a camera's focal length."""
    if prior == USUAL:
        return FocalPrior.from_size(camera.width, camera.height)
    assert not isinstance(prior, str)
    return prior


def check_prior(prior: object, *, focal: str) -> None:
    """Raise InputError if ``prior`` is not a prior, or is given for a known focal length."""
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
