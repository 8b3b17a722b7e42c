"""What a mask or a photo measures at a model's outline, and what such a source has to do."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.estimation.contours.contour import Contour, Sight
from cadalign.estimation.contours.noise import Noise
from cadalign.estimation.contours.surface import PosedSurface
from cadalign.estimation.uncertainty.summary import EvidenceSummary
from cadalign.estimation.warning import EstimateWarning
from cadalign.geometry.camera import Camera

REGISTRATION = 0.3
"""Standard deviation of a contour's registration along x and y [px]."""


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
        """What is measured at the outline of a posed surface; None where nothing is."""

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
