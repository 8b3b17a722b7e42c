"""Options of `fit` and of the robust search: names, defaults, units and meaning.

The command line shows the text below each field as its help.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray, as_floats, as_positive, is_number, is_whole
from cadalign.errors import InputError, quote
from cadalign.geometry.camera import Camera
from cadalign.io.focal import USUAL, PriorOption, check_prior, prior_of_camera
from cadalign.solvers.constants import AEPNP, AP4P, CAUCHY, HUBER, LINEAR, UNKNOWNS, ScalePrior

METHODS = ("optimal", "aepnp", "aepnp-paper", "epnp")
FOCALS = ("known", "estimate")
STRETCHES = ("yz", "y", "z", "none")
SIMILAR_SCALE_SIGMA = 0.2
"""Default standard deviation of the log scales of an object that is only similar to its model."""
USUAL_STRETCH = 5.0
"""Factor up to which the default prior on the stretch is flat."""
BOUNDING_PRIOR = ScalePrior(0.5**-2, math.log(USUAL_STRETCH))
"""Default prior on the log scales: flat over usual stretches, so that it does not bias scales that
keypoints determine, and proper, so that undetermined scales have an optimum and a volume."""
LOSSES = {"linear": LINEAR, "huber": HUBER, "cauchy": CAUCHY}
MINIMAL_SOLVERS = {"ap4p": AP4P, "aepnp": AEPNP}

INLIER_SIGMAS = 4.0
"""Largest residual of an inlier in the robust search [sigma]."""

Sigma = float | npt.ArrayLike


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit.

    Raises
    ------
    InputError
        If a value is out of range or unknown, or options exclude each other.
    """

    method: str = "optimal"
    """Solver: optimal (maximum likelihood, searched globally), epnp (OpenCV's, without stretch),
    aepnp (linear) or aepnp-paper (linear, as published)."""
    sigma: Sigma | None = 1.0
    """Standard deviation of the keypoints [px], one per keypoint, or a 2 x 2 covariance per
    keypoint; None estimates it from the residuals, for a model that is only similar to the
    object."""
    loss: str = "linear"
    """Loss on the length of a whitened residual: linear (squared), huber or cauchy; the robust ones
    tolerate outliers."""
    loss_scale: float = 2.0
    """Scale of a robust loss [sigma]."""
    stretch: str | None = None
    """Axes whose scale is estimated: yz (the default), y, z or none."""
    stretch_sigma: float | None = None
    """Standard deviation of a Gaussian prior on the logarithm of each scale, about scale 1; the
    default prior is flat from 1/5 to 5, and falls off beyond."""
    focal: str = "known"
    """Focal length: known (the camera's) or estimate."""
    focal_prior: PriorOption = USUAL
    """Prior on the estimated focal length: usual (of usual lenses), a `FocalPrior`, for example
    from EXIF data, or None."""

    def __post_init__(self) -> None:
        _check_known("method", self.method, METHODS)
        _check_known("loss", self.loss, LOSSES)
        _check_known("focal", self.focal, FOCALS)
        _set_positive(self, "loss_scale")
        if self.stretch_sigma is not None:
            _set_positive(self, "stretch_sigma")
        if self.sigma is not None and not is_number(self.sigma):
            try:
                np.ndim(self.sigma)
            except ValueError:
                raise InputError("its entries differ in shape", where="sigma") from None
        if self.stretch is not None:
            _check_known("stretch", self.stretch, STRETCHES)
        check_prior(self.focal_prior, focal=self.focal)
        if self.focal == "known":
            object.__setattr__(self, "focal_prior", None)
        if self.method != "optimal" and (
            self.loss != "linear"
            or self.focal != "known"
            or self.stretch_sigma is not None
            or (self.stretch is not None and len(self.stretched_axes) < 2)
        ):
            raise InputError(
                f"the method {self.method!r} supports neither loss, stretch, scale prior nor "
                "an unknown focal length",
                where="method",
                fix="use the method 'optimal', or leave these options at their defaults",
            )

    def for_camera(self, camera: Camera) -> FitOptions:
        """The options for one camera, with the prior on its focal length."""
        if self.focal_prior != USUAL:
            return self
        return replace(self, focal_prior=prior_of_camera(self.focal_prior, camera))

    def for_keypoints(self, rows: Sequence[int]) -> FitOptions:
        """The options for some of the keypoints, with their standard deviations."""
        if self.sigma is None or np.ndim(self.sigma) == 0:
            return self
        return replace(self, sigma=np.asarray(self.sigma)[rows])

    @property
    def stretched_axes(self) -> str:
        """The axes whose scale is estimated."""
        if self.stretch == "none":
            return ""
        return self.stretch or "yz"

    @property
    def free(self) -> FloatArray:
        """1 for each of the solvers' 8 unknowns that is estimated, 0 for the others."""
        free = np.ones(UNKNOWNS)
        for place, axis in enumerate("yz"):
            free[6 + place] = float(axis in self.stretched_axes)
        return free

    @property
    def prior_weight(self) -> float:
        """Inverse variance of the Gaussian prior on the log scales; 0 without one."""
        return 0.0 if self.stretch_sigma is None else float(self.stretch_sigma) ** -2

    @property
    def scale_prior(self) -> ScalePrior:
        """The prior on the log scales; the default only bounds them."""
        if self.stretch_sigma is None:
            return BOUNDING_PRIOR
        return ScalePrior(self.prior_weight, 0.0)

    @property
    def unknowns(self) -> int:
        """Number of estimated unknowns."""
        return 6 + len(self.stretched_axes) + (self.focal == "estimate")

    @property
    def estimated_unknowns(self) -> IntArray:
        """Rows of the estimated unknowns in a result's covariance."""
        stretched = [6 + "xyz".index(axis) for axis in self.stretched_axes]
        return np.array([*range(6), *stretched, *[9][: self.focal == "estimate"]])

    def prior_equations(self, scale: FloatArray) -> int:
        """Number of equations from priors on the focal length and the estimated ``scale`` (3,).

        A scale beyond the flat part of the default prior counts as one equation.
        """
        count = int(self.focal_prior is not None)
        if self.stretch_sigma is not None:
            return count + len(self.stretched_axes)
        return count + int((np.abs(np.log(scale)) > BOUNDING_PRIOR.width).sum())

    @property
    def min_points(self) -> int:
        """Least number of keypoints for the method."""
        if self.method == "optimal":
            prior = len(self.stretched_axes) if self.stretch_sigma is not None else 0
            prior += self.focal_prior is not None
            return (self.unknowns - prior + 1) // 2
        return 4 if self.method == "epnp" else 6


@dataclass(frozen=True)
class RansacOptions:
    """Options of the robust search (LO-RANSAC) for keypoints with outliers.

    Raises
    ------
    InputError
        If a value is out of range or unknown.
    """

    max_reproj_error: float | None = None
    """Largest reprojection error of an inlier [px]; default: 4 sigma plus the projected uncertainty
    of the model, or, if sigma is estimated, a value from the residuals."""
    max_iterations: int = 10_000
    """Largest number of samples. With few points, each subset is tried once instead."""
    min_iterations: int = 100
    """Least number of samples."""
    success_prob: float = 0.9999
    """Probability that the search draws a sample without outliers before it ends."""
    seed: int = 0
    """Seed of the samples; the same seed gives the same result, bit for bit."""
    minimal: str = "ap4p"
    """Minimal solver: ap4p on 4 points, or the linear aepnp on 6 as in the AEPnP paper.
    Both fail if all keypoints lie in one plane."""
    refine: bool = True
    """Optimise each new best hypothesis locally, and the last one on all its inliers; otherwise
    return the best hypothesis of the minimal solver."""

    def __post_init__(self) -> None:
        if self.max_reproj_error is not None:
            _set_positive(self, "max_reproj_error")
        for name, least in (("max_iterations", 1), ("min_iterations", 0), ("seed", 0)):
            value = getattr(self, name)
            if not is_whole(value) or not least <= value < 2**63:
                raise InputError(f"{quote(value)} is not an integer >= {least}", where=name)
            object.__setattr__(self, name, int(value))
        if not isinstance(self.refine, bool | np.bool_):
            raise InputError(f"{quote(self.refine)} is neither True nor False", where="refine")
        if not is_number(self.success_prob) or not 0 < self.success_prob < 1:
            what = f"{quote(self.success_prob)} is not between 0 and 1"
            raise InputError(what, where="success_prob")
        _check_known("minimal", self.minimal, MINIMAL_SOLVERS)

    def threshold(self, sigma: Sigma | None) -> float:
        """Largest reprojection error [px] of an inlier, for keypoints of this sigma."""
        if self.max_reproj_error is not None:
            return self.max_reproj_error
        if sigma is None or np.ndim(sigma) == 0:
            return INLIER_SIGMAS * (1.0 if sigma is None else float(cast(float, sigma)))
        spread = np.asarray(sigma, dtype=np.float64)
        variances = spread**2 if spread.ndim == 1 else spread.trace(axis1=-2, axis2=-1) / 2
        return INLIER_SIGMAS * float(np.sqrt(variances.mean()))


def _check_known(name: str, value: object, known: Collection[str]) -> None:
    if not isinstance(value, str) or value not in known:
        fix = f"known are {', '.join(known)}"
        raise InputError(f"unknown {name} {quote(value)}", where=name, fix=fix)


def _set_positive(options: FitOptions | RansacOptions, name: str) -> None:
    object.__setattr__(options, name, as_positive(getattr(options, name), name=name))


SIGMA_HELP = (
    "give a positive number, one per keypoint, or a 2 x 2 covariance per keypoint, in pixels"
)


def pixel_information(sigma: Any, count: int) -> FloatArray:
    """Inverse covariances (n, 2, 2) of n keypoints [px^-2]; checks sigma."""
    dimensions = np.ndim(sigma)
    if dimensions < 2:
        shape: tuple[int | None, ...] = () if dimensions == 0 else (count,)
        deviations = as_floats(sigma, name="sigma", shape=shape)
        if not (deviations > 0).all():
            raise InputError("has values that are not positive", where="sigma", fix=SIGMA_HELP)
        with np.errstate(over="ignore", divide="ignore"):  # infinite for a tiny sigma
            weights = np.broadcast_to((1.0 / deviations) ** 2, (count,))
        return np.asarray(weights[:, None, None] * np.eye(2))
    covariances = as_floats(sigma, name="sigma", shape=(count, 2, 2))
    definite = (np.linalg.eigvalsh(covariances)[:, 0] > 0) & (
        np.abs(covariances[:, 0, 1] - covariances[:, 1, 0])
        <= 1e-9 * np.abs(covariances).max(axis=(1, 2))
    )
    if not definite.all():
        raise InputError(
            f"the covariance of keypoint {np.flatnonzero(~definite)[0]} is not symmetric and "
            "positive definite",
            where="sigma",
            fix=SIGMA_HELP,
        )
    return np.asarray(np.linalg.inv(covariances))
