"""A view's photo as a source of the outline: lines across it, their noise, their agreement.

Each look learns the colours on both sides of the predicted outline, and takes the places where
lines across it leave the object (`photo_lines.py`). Rounds begin with long lines of blurred colours
and end with short ones at full resolution; lengths far above the last step are left out. The last
rounds count with the noise that the residuals show.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.contours.contour import Sight
from cadalign.estimation.contours.outline import (
    MeasuredOutline,
    Noise,
    Outline,
    OutlineSource,
    OutlineSupport,
    Track,
)
from cadalign.estimation.contours.photo_lines import PhotoPyramid, outline_of, silhouette_of

# Reaches of the lines of every round, relative to the silhouette's size.
_COARSE, _FINE = (0.16, 0.08), (0.04, 0.02, 0.02)
_LEAST_REACH = 5.0  # [px]
_REACH_CELLS = 6.4  # of a silhouette in which lines are sought, that these reach across
_FEWEST_CELLS, _MOST_CELLS = 80, 220  # along the longer side of a silhouette
_LEAST_OUTLIER = 2.0  # in standard deviations
# Standard deviation [px] of the offset outwards that all of an outline has in common, where light
# and blur differ from side to side.
_OFFSET = 0.4
_FIRST = Noise(1.0, 4.0, _OFFSET)  # by lines
_LEAST = Noise(0.5, 16.0, _OFFSET)  # pixels and blur displace neighbours alike
_STRAY = 0.2  # share of the lines whose places are of other things
_LINES_OF_PATCH = 5.0  # of which the colours count as independent
_LEAST_CONTRAST = 2.0  # [nats], that colours must give the silhouette: noise gives one
_MOST_RMS = 1.4  # of the lines found, in standard deviations, above which a warning says so


@dataclass(frozen=True, eq=False)
class PhotoSource(OutlineSource):
    """The lines across an outline in a photo."""

    kind = "photo"
    field = "image"
    learns_sigma = False
    good_share = 0.75
    tolerances = 2.0, 0.01, 0.04

    photo: PhotoPyramid

    def first(self) -> Track:
        return Track(_FIRST, _COARSE[0], _COARSE[1:])

    def last(self, track: Track) -> Track:
        return Track(_FIRST, _FINE[0], _FINE[1:], is_fine=True)

    def outline(self, sight: Sight, track: Track) -> Outline | None:
        cells = round(min(max(_REACH_CELLS / track.reach, _FEWEST_CELLS), _MOST_CELLS))
        silhouette = silhouette_of(sight, cells)
        if silhouette is None:
            return None
        found = outline_of(self.photo, silhouette, max(track.reach * silhouette.size, _LEAST_REACH))
        return found if found is not None and found.found.any() else None

    def learned(self, outline: Outline, offset: float, track: Track) -> Track:
        """The track with the noise of the residuals, at the last level."""
        if not track.is_fine or track.levels:
            return track
        return track._replace(noise=_noise_of(outline, outline.residuals(offset)))

    def rank(self, found: MeasuredOutline) -> float:
        """-2 log of its probability over a silhouette, and places on lines, anywhere."""
        outline, residuals = found.outline, found.residuals
        noise = _noise_of(outline, residuals)
        sigmas = noise.sigma * outline.sigmas[outline.found]
        squares = (residuals[outline.found] / sigmas) ** 2
        density = np.exp(-squares / 2) / np.sqrt(2 * np.pi) / sigmas
        # Some places are those of other things.
        gains = np.log((1 - _STRAY) * density * 2 * outline.reach + _STRAY)
        return -2 * (float(gains.sum() / noise.correlation) + _contrast(outline))

    def support(self, found: MeasuredOutline) -> OutlineSupport:
        """Agreement with the outline, none by colours that are the same on both sides."""
        if _contrast(found.outline) < _LEAST_CONTRAST:
            return OutlineSupport()
        return super().support(found)

    def refusal(self, support: OutlineSupport) -> str:
        if not support.share:
            return "the object is not seen, or has the colours of what is around it"
        return f"it shows only {100 * support.share:.0f} % of the model's outline"

    def doubt(self, support: OutlineSupport) -> str | None:
        if support.share < self.good_share:
            return f"{self.where} shows only {100 * support.share:.0f} % of the model's outline"
        if support.rms_sigmas > _MOST_RMS:
            off = f"{support.rms_sigmas:.1f} standard deviations off the model's outline"
            return f"{self.where}: edges lie {off}: some may be another object's"
        return None


def _contrast(outline: Outline) -> float:
    """Log likelihood [nats] that the colours give the silhouette over one anywhere."""
    return 2 * len(outline.found) / _LINES_OF_PATCH * outline.contrast


def _noise_of(outline: Outline, residuals: FloatArray) -> Noise:
    return outline.noise(residuals, _LEAST, _LEAST_OUTLIER)
