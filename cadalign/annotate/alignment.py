"""Live alignment: a fit to the pairs of a document after every change."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cadalign.annotate.document import FocalChoice, Priors
from cadalign.annotate.photos import Intrinsics
from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import CadalignError, DegenerateError
from cadalign.estimation.fit import fit
from cadalign.estimation.focal import FocalPrior
from cadalign.estimation.result import Result
from cadalign.estimation.uncertainty.misfit import find_outliers
from cadalign.estimation.uncertainty.tested import Rows
from cadalign.geometry.camera import Camera

LEAST_PAIRS = 4
LEAST_SIGMA = 1.0  # of clicks [px]
_ROBUST_ROUNDS = 3
_ROBUST_SHARE = 2.0  # of the median residual
# Of clicks on natural points of a model that is not quite the object [longer sides of the photo],
# and the weight of that expectation against residuals, as that of so many equations.
_EXPECTED_NOISE = 0.005
_NOISE_EQUATIONS = 4
_FIRST_NOISE = 4.0  # over the expected one
_NOISE_ROUNDS = 12
_UNKNOWNS = 8  # of pose and stretch
_NOISE_TOLERANCE = 0.02
LIKELY_STRETCH = 0.25
"""Standard deviation of the logarithm of each scale about 1, until another one is chosen."""
_LIKELY_STRETCH = 0.3  # standard deviation of its logarithm, if the pairs leave it open


@dataclass(frozen=True, eq=False)
class LiveAlignment:
    """Alignment of the pairs placed so far.

    It is provisional if the pairs alone did not suffice: stretch or focal length were assumed.
    """

    result: Result | None  # at the given sigma; None without enough pairs, or degenerate ones
    cautious: Result | None  # as shown and saved: at a sigma that explains the residuals
    message: str  # reason for a missing result, or an assumption that was made
    outliers: dict[int, float]  # see `find_outliers`
    sigma: float  # of the pairs [px], larger if the residuals are
    provisional: bool
    fit_options: Mapping[str, Any]  # with which, and the priors, `cadalign fit` finds ``cautious``

    @property
    def shown(self) -> Result | None:
        """The result that is shown and saved."""
        return self.cautious

    @property
    def counts(self) -> BoolArray:
        """Marks the pairs (n,), all of which count."""
        return np.ones(len(self.residuals), dtype=bool)

    @property
    def also_used(self) -> tuple[str, ...]:
        """Evidence beyond the pairs, of which there is none here."""
        return ()

    @property
    def residuals(self) -> FloatArray:
        """Projected minus placed points (n, 2) [px] of the result that is shown."""
        return np.empty((0, 2)) if self.cautious is None else self.cautious.residuals

    @classmethod
    def missing(cls, message: str) -> LiveAlignment:
        """No alignment, for the reason that the message gives."""
        return cls(None, None, message, {}, LEAST_SIGMA, provisional=False, fit_options={})


def align(
    points_3d: FloatArray,
    points_2d: FloatArray,
    sigma: FloatArray | None,
    intrinsics: Intrinsics,
    choice: FocalChoice,
    priors: Priors | None = None,
) -> LiveAlignment:
    """Fit the model to the complete pairs: (n, 3), (n, 2) [px] and (n,) [px], by default 1.

    By default there is no prior but that of the photo's EXIF data on an estimated focal length.
    """
    count = len(points_3d)
    if count < LEAST_PAIRS:
        missing = LEAST_PAIRS - count
        return LiveAlignment.missing(
            f"{missing} more pair{'s' if missing > 1 else ''} to the first alignment"
        )
    priors = priors or Priors(focal=intrinsics.prior)
    focal_prior = None if choice.known else priors.focal
    fitter = _Fitter(points_3d, points_2d, intrinsics, choice, priors.stretch, focal_prior)
    if priors.stretch is not None:
        return _align_with_prior(fitter, sigma)
    given = LEAST_SIGMA if sigma is None else sigma
    message = ""
    if not choice.known and count <= LEAST_PAIRS:
        fitter = replace(fitter, choice=replace(choice, known=True))
        message = "With 4 pairs the focal length is assumed; it is estimated from 5 pairs on."
    try:
        result = fitter.fit(given)
    except DegenerateError as error:
        message = f"The stretch shown is assumed: {error.what}. Add a pair elsewhere."
        fitter = replace(fitter, scale_prior_sigma=_LIKELY_STRETCH)
        try:
            result = fitter.fit(given)
        except CadalignError:
            return LiveAlignment.missing(f"No alignment yet: {error.what}.")
    except CadalignError as error:
        return LiveAlignment.missing(f"No alignment: {error}.")
    unknowns = _UNKNOWNS + (result.focal == "estimate")
    estimated = _estimate_sigma(result, sigma, redundancy=2 * count - unknowns)
    cautious, options = result, dict[str, Any]()
    if estimated > LEAST_SIGMA:
        # A model that is only similar to the object has larger residuals than the clicks' noise.
        scaled = None if sigma is None else estimated * sigma
        options = {"sigma": None if scaled is None else scaled.tolist()}
        try:
            cautious = fitter.fit(scaled)
        except CadalignError as error:
            return LiveAlignment.missing(f"No alignment: {error}.")
    return LiveAlignment(
        result=result,
        cautious=cautious,
        message=message,
        outliers=find_outliers(points_3d, points_2d, fitter.fit_rows, unknowns=unknowns),
        sigma=max(LEAST_SIGMA, estimated),
        provisional=bool(message),
        fit_options={} if message else options,
    )


def _align_with_prior(fitter: _Fitter, sigma: FloatArray | None) -> LiveAlignment:
    """Fit with a prior on the stretch, at the largest sigma that explains the residuals."""
    weights = np.ones(len(fitter.points_3d)) if sigma is None else sigma
    reason = ""
    for attempt, assumed in fitter.attempts():
        try:
            result, factor = _settle(attempt, weights)
        except DegenerateError as error:
            reason = error.what
            continue
        except CadalignError as error:
            return LiveAlignment.missing(f"No alignment: {error}.")
        unknowns = _UNKNOWNS + (result.focal == "estimate")
        given = fitter.points_3d, fitter.points_2d
        return LiveAlignment(
            result=result,
            cautious=result,
            message=assumed,
            outliers=find_outliers(*given, attempt.fit_rows, unknowns=unknowns),
            sigma=factor,
            provisional=bool(assumed),
            fit_options={"sigma": factor if sigma is None else (factor * sigma).tolist()},
        )
    return LiveAlignment.missing(f"No alignment yet: {reason}.")


def _settle(fitter: _Fitter, weights: FloatArray) -> tuple[Result, float]:
    """Fit at the factor of the weights (n,) [px] that explains the residuals; and that factor.

    It is the fixed point of its estimate, reached from above, so that residuals first count as
    noise, and as a stretch only where the noise does not explain them.
    """
    noise = ExpectedNoise.of(fitter.intrinsics.camera)
    factor = _FIRST_NOISE * noise.sigma
    result = fitter.fit(factor * weights)
    # The focal length is searched for again at the end alone, which takes most of the time.
    near = fitter if fitter.choice.known else fitter.at_focal(result.camera.fx)
    for _ in range(_NOISE_ROUNDS):
        squares = float(((result.residuals / weights[:, None]) ** 2).sum())
        before = factor
        factor = noise.with_residuals(squares, redundancy=2 * len(weights) - 8)
        if abs(factor / before - 1) < _NOISE_TOLERANCE:
            break
        result = near.fit(factor * weights)
    factor = max(LEAST_SIGMA, factor)
    return fitter.fit(factor if (weights == 1).all() else factor * weights), factor


@dataclass(frozen=True)
class ExpectedNoise:
    """Deviation of clicks on natural points of a model that is not quite the object [px]."""

    sigma: float

    @classmethod
    def of(cls, *cameras: Camera) -> ExpectedNoise:
        """That of the cameras' photos, on average."""
        sides = [max(camera.width, camera.height) for camera in cameras]
        return cls(_EXPECTED_NOISE * sum(sides) / len(sides))

    def with_residuals(self, squares: float, *, redundancy: int) -> float:
        """The deviation in view of residuals, by their sum of squares and their redundancy."""
        expected = _NOISE_EQUATIONS * self.sigma**2
        return math.sqrt((squares + expected) / (redundancy + _NOISE_EQUATIONS))


def _estimate_sigma(result: Result, sigma: FloatArray | None, *, redundancy: int) -> float:
    """Estimate the common factor of the sigmas, by default 1 px, from the residuals."""
    if redundancy <= 0:
        return 0.0
    whitened = result.residuals if sigma is None else result.residuals / sigma[:, None]
    return math.sqrt(float((whitened**2).sum()) / redundancy)


@dataclass(frozen=True, eq=False)
class _Fitter:
    """`cadalign.fit` with the annotator's options, on all pairs or on some."""

    points_3d: FloatArray
    points_2d: FloatArray
    intrinsics: Intrinsics
    choice: FocalChoice
    scale_prior_sigma: float | None
    focal_prior: FocalPrior | None
    stretch: str | None = None

    def attempts(self) -> Iterator[tuple[_Fitter, str]]:
        """Fits to try, the best first, down to what is left where the pairs do not suffice."""
        yield self, ""
        fitter = self
        if not self.choice.known:
            prior = self.focal_prior
            fitter = self.at_focal(self.intrinsics.camera.fx if prior is None else prior.focal)
            yield fitter, "The focal length is assumed: add a pair elsewhere to have it estimated."
        rigid = replace(fitter, scale_prior_sigma=None, stretch="none")
        yield rigid, "The model is shown unstretched: add a pair elsewhere."

    def at_focal(self, pixels: float) -> _Fitter:
        """The same at a known focal length."""
        return replace(self, choice=FocalChoice(known=True, pixels=pixels), focal_prior=None)

    def fit(self, sigma: float | FloatArray | None) -> Result:
        """Fit all pairs as `cadalign fit` does, with one sigma or (n,) [px], or to be estimated."""
        return self._fit(np.arange(len(self.points_3d)), sigma, "linear")

    def fit_rows(self, rows: Rows, robust: bool) -> Result:
        """Fit some pairs; see `cadalign.estimation.uncertainty.misfit.FitRows`."""
        result = self._fit(rows, LEAST_SIGMA, "linear")
        if robust:
            # sigma=None iterates until nothing changes, which takes ten times as long.
            for _ in range(_ROBUST_ROUNDS):
                median = float(np.median(np.linalg.norm(result.residuals, axis=1)))
                sigma = max(LEAST_SIGMA, median / _ROBUST_SHARE)
                result = self._fit(rows, sigma, "cauchy")
        return result

    def _fit(self, rows: Rows, sigma: float | FloatArray | None, loss: str) -> Result:
        return fit(
            self.points_3d[rows],
            self.points_2d[rows],
            self.intrinsics.with_focal(self.choice),
            sigma=sigma,
            loss=loss,
            scale_prior_sigma=self.scale_prior_sigma,
            stretch=self.stretch,
            focal="known" if self.choice.known else "estimate",
            focal_prior=None if self.choice.known else self.focal_prior,
        )
