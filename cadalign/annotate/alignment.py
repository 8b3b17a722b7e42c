"""Live alignment: a fit to the pairs of a document after every change."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cadalign.annotate.document import FocalChoice
from cadalign.annotate.photos import Intrinsics
from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, DegenerateError
from cadalign.fitting.fit import fit
from cadalign.fitting.outliers import Rows, find_outliers
from cadalign.fitting.result import FitResult

LEAST_PAIRS = 4
LEAST_SIGMA = 1.0  # of clicks [px]
_ROBUST_ROUNDS = 3
_ROBUST_SHARE = 2.0  # of the median residual
_LIKELY_STRETCH = 0.3  # standard deviation of its logarithm, if the pairs leave it open


@dataclass(frozen=True, eq=False)
class LiveAlignment:
    """Alignment of the pairs placed so far.

    It is provisional if the pairs alone did not suffice: stretch or focal length were assumed.
    """

    result: FitResult | None  # at the given sigma; None without enough pairs, or degenerate ones
    cautious: FitResult | None  # as shown and saved: at a sigma that explains the residuals
    message: str  # reason for a missing result, or an assumption that was made
    outliers: dict[int, float]  # see `find_outliers`
    sigma: float  # of the pairs [px], larger if the residuals are
    provisional: bool
    fit_options: Mapping[str, Any]  # with which `cadalign fit` finds ``cautious``

    @property
    def shown(self) -> FitResult | None:
        """The result that is shown and saved."""
        return self.cautious

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
) -> LiveAlignment:
    """Fit the model to the complete pairs: (n, 3), (n, 2) [px] and (n,) [px], by default 1."""
    count = len(points_3d)
    if count < LEAST_PAIRS:
        missing = LEAST_PAIRS - count
        return LiveAlignment.missing(
            f"{missing} more pair{'s' if missing > 1 else ''} to the first alignment"
        )
    fitter = _Fitter(points_3d, points_2d, intrinsics, choice, None)
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
    unknowns = 8 if result.covariance is None else len(result.covariance)
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


def _estimate_sigma(result: FitResult, sigma: FloatArray | None, *, redundancy: int) -> float:
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

    def fit(self, sigma: float | FloatArray | None) -> FitResult:
        """Fit all pairs as `cadalign fit` does, with one sigma or (n,) [px], or to be estimated."""
        return self._fit(np.arange(len(self.points_3d)), sigma, "linear")

    def fit_rows(self, rows: Rows, robust: bool) -> FitResult:
        """Fit some pairs; see `cadalign.fitting.outliers.FitRows`."""
        result = self._fit(rows, LEAST_SIGMA, "linear")
        if robust:
            # sigma=None iterates until nothing changes, which takes ten times as long.
            for _ in range(_ROBUST_ROUNDS):
                median = float(np.median(np.linalg.norm(result.residuals, axis=1)))
                sigma = max(LEAST_SIGMA, median / _ROBUST_SHARE)
                result = self._fit(rows, sigma, "cauchy")
        return result

    def _fit(self, rows: Rows, sigma: float | FloatArray | None, loss: str) -> FitResult:
        return fit(
            self.points_3d[rows],
            self.points_2d[rows],
            self.intrinsics.with_focal(self.choice),
            sigma=sigma,
            loss=loss,
            scale_prior_sigma=self.scale_prior_sigma,
            focal="known" if self.choice.known else "estimate",
            focal_prior=None if self.choice.known else self.intrinsics.prior,
        )
