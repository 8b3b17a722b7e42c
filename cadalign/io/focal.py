"""Priors on focal lengths, and the focal length that a photo's EXIF data state."""

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
"""Focal lengths that a camera has [longer sides of the image]: 157 to 1 degrees are seen."""
USUAL: Final = "usual"
"""In the place of a prior: that of usual lenses, `FocalPrior.of_usual_lenses`."""
_USUAL_FOCAL = 1.2  # over the longer side of the image
_USUAL_SIGMA = 0.6
_EXIF_SIGMA = 0.05  # roundings, focusing, and corrections of the lens inside the camera
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
    def from_exif(cls, path: str | os.PathLike[str]) -> FocalPrior | None:
        """Read a photo's focal length from its EXIF data.

        From the 35 mm equivalent, taken along the diagonal, as CIPA defines it. A photo turned
        upright has the same focal length. One that no camera has is ignored with a warning (logger
        "cadalign").

        Parameters
        ----------
        path : str or path-like
            The photo.

        Returns
        -------
        FocalPrior or None
            None where the photo does not say.

        Raises
        ------
        DataError
            If the file is missing or not an image.
        """
        from PIL.ExifTags import IFD, Base

        from cadalign.io.images import open_photo  # a known focal length needs no reader of images

        with open_photo(path) as image:
            found, size = image.getexif().get_ifd(IFD.Exif), image.size
        equivalent = found.get(Base.FocalLengthIn35mmFilm, 0)
        if not is_number(equivalent) or equivalent <= 0:  # 0 says that it is unknown
            return None
        focal = equivalent / _FULL_FRAME_DIAGONAL_MM * math.hypot(*size)
        if SHORTEST < focal / max(size) < LONGEST:
            return cls(focal, source="the photo's EXIF data")
        text = "%s: the EXIF data state a focal length of %.4g px, which no camera has; ignored"
        logger.warning(text, path, focal)
        return None


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
