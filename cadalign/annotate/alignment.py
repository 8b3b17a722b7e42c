"""The live alignment: fitted to the pairs of a document after every change."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from cadalign.annotate.contradictions import Rows, find_contradictions
from cadalign.annotate.document import FocalChoice
from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, DegenerateError
from cadalign.fitting.fit import fit
from cadalign.fitting.focal.prior import FocalPrior
from cadalign.fitting.result import FitResult
from cadalign.geometry.camera import Camera

LEAST_PAIRS = 4
_LEAST_SIGMA = 1.0
_ROBUST_ROUNDS = 3
_ROBUST_SHARE = 2.0  # of the median residual
_LIKELY_STRETCH = 0.3  # standard deviation of its logarithm, where the pairs do not tell it


@dataclass(frozen=True)
class Lens:
    """What is known of the camera that took a photo.

    Parameters
    ----------
    camera : Camera
        The calibrated camera; without one, image size, principal point, and a likely focal length.
    calibrated : bool
        Whether that focal length was given.
    prior : FocalPrior, optional
        What the photo's EXIF data say of it.
    note : str
        Where the focal length comes from, in words.
    """

    camera: Camera
    calibrated: bool
    prior: FocalPrior | None = None
    note: str = ""

    def with_focal(self, choice: FocalChoice) -> Camera:
        """The camera with the focal length that was typed, if one was."""
        if choice.pixels is None:
            return self.camera
        return self.camera.with_focal(choice.pixels)

    def to_write(self, choice: FocalChoice) -> Camera:
        """The camera for an observation file: without a focal length where that is estimated."""
        if choice.known:
            return self.with_focal(choice)
        camera = self.camera
        return Camera.without_focal(
            camera.width,
            camera.height,
            cx=camera.cx,
            cy=camera.cy,
            distortion=camera.distortion,
        )


@dataclass(frozen=True, eq=False)
class LiveAlignment:
    """What the pairs say.

    Parameters
    ----------
    result : FitResult, optional
        As `cadalign fit` finds it; None without enough pairs, or if they determine nothing.
    camera : Camera, optional
        The camera that it was found with.
    message : str
        Why there is no result, or what to know about it; may be empty.
    contradictions : dict of int to float
        See `find_contradictions`.
    sigma : float
        The pairs' standard deviation: 1 px, or more where the residuals say so.
    provisional : bool
        Whether it needed more than the pairs say: a stretch near 1, or a likely focal length.
    """

    result: FitResult | None = None
    camera: Camera | None = None
    message: str = ""
    contradictions: dict[int, float] = field(default_factory=dict)
    sigma: float = _LEAST_SIGMA
    provisional: bool = False

    @property
    def cautious(self) -> FitResult | None:
        """The result with a covariance that goes by the residuals, where they exceed 1 px.

        A model that is only similar to the object does not fit to the pixels' noise; the
        deviations shown are not to claim that it does.
        """
        if self.result is None or self.result.covariance is None:
            return self.result
        return replace(self.result, covariance=self.result.covariance * self.sigma**2)


def align(
    points_3d: FloatArray,
    points_2d: FloatArray,
    sigma: FloatArray | None,
    lens: Lens,
    choice: FocalChoice,
) -> LiveAlignment:
    """Fit the model to the complete pairs.

    Parameters
    ----------
    points_3d : (n, 3) float
    points_2d : (n, 2) float
        [px]
    sigma : (n,) float, optional
        Standard deviations [px]; by default 1 px each.
    lens : Lens
    choice : FocalChoice
    """
    count = len(points_3d)
    if count < LEAST_PAIRS:
        missing = LEAST_PAIRS - count
        return LiveAlignment(
            message=f"{missing} more pair{'s' if missing > 1 else ''} to the first alignment"
        )
    fitter = _Fitter(points_3d, points_2d, sigma, lens, choice)
    message = ""
    if not choice.known and count <= LEAST_PAIRS:
        fitter = replace(fitter, choice=replace(choice, known=True))
        message = "With 4 pairs the focal length is assumed; the fifth pair begins to tell it."
    try:
        result, camera = fitter.fit()
    except DegenerateError as error:
        message = f"Only a likely stretch is shown: {error.what}. Add a pair elsewhere."
        fitter = replace(fitter, scale_prior_sigma=_LIKELY_STRETCH)
        try:
            result, camera = fitter.fit()
        except CadalignError:
            return LiveAlignment(message=f"No alignment yet: {error.what}.")
    except CadalignError as error:
        return LiveAlignment(message=f"No alignment: {error}.")
    unknowns = len(result.covariance) if result.covariance is not None else 8
    squares = float((result.residuals**2).sum()) if sigma is None else _whitened(result, sigma)
    redundancy = 2 * count - unknowns
    estimated = np.sqrt(squares / redundancy) if redundancy > 0 else 0.0
    return LiveAlignment(
        result=result,
        camera=camera,
        message=message,
        contradictions=find_contradictions(
            points_3d, points_2d, fitter.fit_rows, unknowns=unknowns
        ),
        sigma=max(_LEAST_SIGMA, float(estimated)),
        provisional=bool(message),
    )


@dataclass(frozen=True, eq=False)
class _Fitter:
    """The one place that calls `cadalign.fit`, and knows whether the focal length is estimated."""

    points_3d: FloatArray
    points_2d: FloatArray
    sigma: FloatArray | None
    lens: Lens
    choice: FocalChoice
    scale_prior_sigma: float | None = None

    def fit(self) -> tuple[FitResult, Camera]:
        """As `cadalign fit` does."""
        return self._fit(np.arange(len(self.points_3d)), 1.0 if self.sigma is None else self.sigma)

    def fit_rows(self, rows: Rows, robust: bool) -> tuple[FitResult, Camera]:
        """See `cadalign.annotate.contradictions.FitRows`."""
        result, camera = self._fit(rows, _LEAST_SIGMA)
        if robust:
            # sigma=None goes on until nothing changes, which takes ten times as long.
            for _ in range(_ROBUST_ROUNDS):
                median = float(np.median(np.linalg.norm(result.residuals, axis=1)))
                sigma = max(_LEAST_SIGMA, median / _ROBUST_SHARE)
                result, camera = self._fit(rows, sigma, loss="cauchy")
        return result, camera

    def _fit(
        self, rows: Rows, sigma: float | FloatArray | None, *, loss: str = "linear"
    ) -> tuple[FitResult, Camera]:
        result = fit(
            self.points_3d[rows],
            self.points_2d[rows],
            self.lens.with_focal(self.choice),
            sigma=sigma,
            loss=loss,
            scale_prior_sigma=self.scale_prior_sigma,
            focal="known" if self.choice.known else "estimate",
            focal_prior=None if self.choice.known else self.lens.prior,
        )
        return result, result.camera


def _whitened(result: FitResult, sigma: FloatArray) -> float:
    return float(((result.residuals / sigma[:, None]) ** 2).sum())
