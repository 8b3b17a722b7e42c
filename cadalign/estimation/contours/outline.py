"""Measurements of a mask or a photo at a model's outline, their noise, and the sources of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.estimation.contours.contour import Contour, Sight
from cadalign.estimation.contours.surface import PosedSurface
from cadalign.estimation.uncertainty.summary import EvidenceSummary
from cadalign.estimation.warning import EstimateWarning
from cadalign.geometry.camera import Camera

LOSS_SCALE = 2.4
"""Scale of Cauchy's loss, in standard deviations: it then keeps 95 % of the information."""
LEAST_LOSS_SCALE = 1.0
"""Least scale of Cauchy's loss [px]: where pixels end, they displace a contour by up to that."""
LEAST_OFFSET = 0.1
"""Least standard deviation of the offset that all of a contour has in common [px]."""
REGISTRATION = 0.3
"""Standard deviation of a contour's registration along x and y [px]."""
_LEAST_OWN = 0.3  # [px], standard deviation of the part that is the model's
_FIRST_SHARE, _LARGEST_SHARE = 0.8, 0.99  # of a contour, that is the model's
_ROUNDS = 30
_TO_SIGMA = 1.4826  # from the median of absolute values to the standard deviation of a Gaussian
_OUTLYING = 3.5  # in standard deviations
_MOST_LAGS = 100
_LEAST_PAIRS = 20
_ALIKE = 0.2  # change of a variance's logarithm


class Noise(NamedTuple):
    """Noise of a contour's samples.

    Their standard deviation ``sigma`` [px], or its factor where samples have their own, the number
    of neighbours that count as one, and the standard deviation of the ``offset`` [px] that all have
    in common.
    """

    sigma: float
    correlation: float
    offset: float

    @property
    def loss_scale(self) -> float:
        """Scale of Cauchy's loss, in standard deviations of a sample."""
        return max(LOSS_SCALE, LEAST_LOSS_SCALE / self.sigma)

    def cost(self, residual: float) -> float:
        """Cost of one sample's residual [px]."""
        square = self.loss_scale**2
        return float(square / self.correlation * np.log1p((residual / self.sigma) ** 2 / square))

    def is_like(self, other: Noise) -> bool:
        """True if samples weigh about the same."""
        weights = self.sigma**2 * self.correlation / (other.sigma**2 * other.correlation)
        offsets = (self.offset / other.offset) ** 2
        return bool(max(abs(np.log(weights)), abs(np.log(offsets))) < _ALIKE)


def robust_deviation(residuals: FloatArray) -> float:
    """Deviation of residuals (n,) about 0, outliers among them; 0 for none."""
    return _TO_SIGMA * float(np.median(np.abs(residuals))) if len(residuals) else 0.0


def trimmed_deviation(residuals: FloatArray, least: float) -> float:
    """Root mean square of residuals (n,) about 0 without outliers, which exceed ``least``.

    It is 0 for none.
    """
    if not len(residuals):
        return 0.0
    kept = residuals[np.abs(residuals) < max(_OUTLYING * robust_deviation(residuals), least)]
    return float(np.sqrt((kept**2).mean()))


def correlation_length(contour: Contour, residuals: FloatArray, kept: BoolArray) -> float:
    """Number of neighbouring samples that count as one, at least 1.

    The integrated autocorrelation ``1 + 2 sum of rho`` of the residuals (S,) that are ``kept``, up
    to the first lag without positive correlation (Geyer, "Practical Markov chain Monte Carlo",
    1992).
    """
    values = np.where(kept, residuals, 0.0)
    variance = float((values**2).sum() / max(kept.sum(), 1))
    if not variance > 0:
        return 1.0
    total = 1.0
    for lag in range(1, _MOST_LAGS):
        pairs = contour.neighbours(kept, lag)
        count = int(pairs.sum())
        if count < _LEAST_PAIRS:
            break
        rho = float((values[lag:] * values[:-lag])[pairs].sum() / count / variance)
        if rho <= 0:
            break
        total += 2 * rho
    return total


def influence_length(
    contour: Contour, residuals: FloatArray, kept: BoolArray, scale: float
) -> float:
    """The `correlation_length` of the residuals' influence under Cauchy's loss of a scale.

    Runs of outliers have it, too.
    """
    influence = residuals / (1 + (residuals / scale) ** 2)
    return correlation_length(contour, influence, kept)


def cost_of_contour(residuals: FloatArray, reach: float) -> float:
    """The mean of -log density of a contour's distances (S,) from a rim, at most ``reach`` [px].

    Part of the contour is an occluder's, and lies anywhere within the reach; the rest is Gaussian.
    Its share and standard deviation are the likeliest, by expectation and maximisation (Dempster,
    Laird and Rubin, "Maximum likelihood from incomplete data via the EM algorithm", 1977).
    """
    squares, elsewhere = residuals**2, 1 / (2 * reach)
    share, variance = _FIRST_SHARE, max(float(np.median(squares)), _LEAST_OWN**2)
    for _ in range(_ROUNDS):
        own = share * np.exp(-squares / (2 * variance)) / np.sqrt(2 * np.pi * variance)
        density = own + (1 - share) * elsewhere
        belongs = own / density
        share = min(float(belongs.mean()), _LARGEST_SHARE)
        variance = max(float(belongs @ squares / max(belongs.sum(), 1e-9)), _LEAST_OWN**2)
    return float(-np.log(density).mean())


class Outline(NamedTuple):
    """Measurements at S samples of a model's outline in one view.

    ``points`` (S, 3) on the model's rim, in its frame before the stretch, lie on the triangles
    ``face`` (S,). The source's contour is by ``places`` (S,) [px] outwards of the rim, along the
    normals of ``contour``, where it is ``found`` (S,); ``sigmas`` (S,) are the relative standard
    deviations of these. Rays that move by ``across`` (S, 2) [1/px] over its square move the image
    by one pixel outwards. Contours are sought within the ``reach`` [px]. The ``contrast`` is that
    of the colours inside and outside [nats].
    """

    contour: Contour
    found: BoolArray
    places: FloatArray
    sigmas: FloatArray
    points: FloatArray
    face: IntArray
    across: FloatArray
    size: float
    reach: float
    contrast: float = 0.0

    def residuals(self, own: FloatArray, noise: Noise) -> FloatArray:
        """Places (S,) [px] without the offset that all have in common, ``own`` (3,) as `Place`."""
        return np.where(self.found, self.places - own[0] * noise.offset, np.nan)


class MeasuredOutline(NamedTuple):
    """An outline at an estimate: the coefficients ``own`` (3,) of its modes, and its noise."""

    outline: Outline
    own: FloatArray
    noise: Noise

    @property
    def residuals(self) -> FloatArray:
        """See `Outline`."""
        return self.outline.residuals(self.own, self.noise)


class Track(NamedTuple):
    """Noise and reach of a source on the way to its outline.

    The reach of a mask is in pixels; that of a photo is relative to the silhouette's size, and
    ``levels`` are the next ones, after so many ``rounds``. A track ``is_fine`` near its end.
    """

    noise: Noise
    reach: float
    levels: tuple[float, ...] = ()
    rounds: int = 0
    is_fine: bool = False
    is_settled: bool = False


class OutlineSupport(NamedTuple):
    """Agreement of a source with a model's outline.

    The ``share`` of the samples within the tolerance, 0 where the source tells nothing; the number
    ``agreeing`` of those that do, their root mean square distance ``rms`` [px] and ``rms_sigmas``.
    """

    share: float = 0.0
    agreeing: int = 0
    rms: float = float("nan")
    rms_sigmas: float = float("nan")


@dataclass(frozen=True, eq=False)
class OutlineSource(ABC):
    """A mask or a photo: rows of evidence that depend on the state.

    It is that of the view in place ``image``, whose ``number`` is the user's. The ``camera`` is
    that of the evidence's rays. The surface ``is_exact``, or only similar to the object's. Costs of
    sources that are ``is_comparable`` compare at several states.
    """

    kind: ClassVar[Literal["mask", "photo"]]
    field: ClassVar[str]
    is_comparable: ClassVar[bool]
    good_share: ClassVar[float]
    """Share of the outline that agrees, below which a warning says so."""

    image: int
    number: int
    camera: Camera
    is_exact: bool

    @property
    def where(self) -> str:
        """Name of its argument."""
        return f"views[{self.number}].{self.field}"

    @property
    def learns_offset(self) -> bool:
        """True if the deviation of the offset that all of it has in common is estimated."""
        return self.is_comparable and self.is_exact

    @abstractmethod
    def first(self, *, is_wide: bool = False) -> Track:
        """Noise and reach at the start, which ``is_wide`` says may be far off."""

    @abstractmethod
    def last(self, track: Track) -> Track:
        """Noise and reach of the last rounds."""

    @abstractmethod
    def outline(self, sight: Sight, surface: PosedSurface, track: Track) -> Outline | None:
        """The outline of a posed surface as it is measured; None where nothing is."""

    @abstractmethod
    def learned(self, outline: Outline, own: FloatArray, track: Track) -> Track:
        """The track with the noise that residuals show before a step."""

    @abstractmethod
    def advanced(self, track: Track, outline: Outline | None, moved: float) -> Track:
        """The track after a step that moved the outline so far [px]."""

    @abstractmethod
    def rank(self, found: MeasuredOutline, correlation: float | None) -> float:
        """-2 log of the probability of what was measured, to compare estimates.

        So many of a mask's samples as the ``correlation`` count as one, if it is given.
        """

    @abstractmethod
    def support(self, found: MeasuredOutline) -> OutlineSupport:
        """The agreement with an outline."""

    @abstractmethod
    def refusal(self, support: OutlineSupport) -> str:
        """The reason to leave the source out, for its support is too low."""

    @abstractmethod
    def doubt(self, support: OutlineSupport) -> str | None:
        """A warning about an estimate that little but the outlines determines."""

    def warning(self, text: str) -> EstimateWarning:
        """A warning about it."""
        return EstimateWarning(self.kind, text, self.number)

    def summary(self, support: OutlineSupport) -> EvidenceSummary:
        """The line of the result's evidence."""
        figures = support.agreeing, support.rms_sigmas, support.rms
        share = None if self.is_comparable else support.share
        return EvidenceSummary(self.kind, self.number, *figures, "px", share)
