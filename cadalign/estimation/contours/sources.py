"""Sources of the outline: a view's mask, and its photo.

A mask's contour differs from the rim by a common offset, for example of a dilated mask, and by a
registration, since conventions for pixel centres differ by half a pixel. Both are unknown, and are
integrated out together with the shape.

In a photo, the colours on both sides of the predicted outline are learned, and the outline is
detected on lines across it (`photo_lines.py`). The first rounds use long lines and blurred colours,
the last ones short lines at full resolution. The last rounds estimate the noise from the residuals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.contours.contour import (
    Contour,
    MaskImage,
    Sight,
    extraction_bias,
    find_rims,
    mask_contour,
    mask_image,
    remove_steep,
    rim_normals,
)
from cadalign.estimation.contours.outline import (
    LEAST_LOSS_SCALE,
    LEAST_OFFSET,
    MeasuredOutline,
    Noise,
    Outline,
    OutlineSource,
    OutlineSupport,
    Track,
)
from cadalign.estimation.contours.photo_lines import PhotoPyramid, outline_of, silhouette_of
from cadalign.estimation.view import View
from cadalign.geometry.camera import Camera

_LARGEST = 24.0  # [px], distance of a sample without a rim in the rank
# In the rank: least and largest deviation of samples, and number of neighbours that count as one.
_RANKED, _RANKED_CORRELATION = (0.2, 1.0), 10.0
_LEAST_SIGMA = 0.1  # [px]
_FIRST_OFFSET = 1.0  # [px], standard deviation of the common offset
_UNEVEN = 0.05  # variation of the offset between edges, relative
_EDGE = 30.0  # samples of an edge
_OF_PIXELS = 3.0  # samples that count as one with quantisation alone
_FIRST_REACH = 24.0  # [px], and the same relative to the contour's size
_RELATIVE_REACH = 0.04
_WIDE_REACH = 0.15  # without keypoints
_REACH = 6.0  # of the residuals [sigma]
_OFFSETS = 2.0  # least reach, in standard deviations of the common offset
_UNEVEN_RMS = 1.0  # [px], largest for the contour of an exact model
_INSIDE = 0.5  # probability of a mask's pixel
_OPEN_BORDER = 3  # [px], within which a mask may leave the image
_LEAST_PIECE = 0.003  # of a piece of the mask, relative to the largest
_LEAST_KEYPOINTS = 4  # needed to recognise an inverted mask


@dataclass(frozen=True, eq=False)
class MaskSource(OutlineSource):
    """The contour of a mask.

    ``slopes`` (S, 2, 2) are derivatives of its samples [px] by their rays; ``sigma`` [px] is None
    to estimate it. ``is_wide`` without keypoints: the start may be far off.
    """

    kind = "mask"
    field = "mask"
    learns_sigma = True
    good_share = 0.94
    tolerances = 3.0, 0.02, 0.06

    contour: Contour
    slopes: FloatArray
    sigma: float | None
    mask: MaskImage
    is_wide: bool
    hint: str

    @classmethod
    def from_view(
        cls, image: int, view: View, camera: Camera, *, is_exact: bool = True
    ) -> MaskSource:
        """The contour of a view's mask where the lens is valid; raises InputError without one."""
        mask = cast("FloatArray | BoolArray", view.mask_image)
        contour = mask_contour(mask, f"views[{view.number}].mask")
        rays, valid = camera.normalize_where_valid(contour.points)
        slopes = np.array([[camera.fx], [camera.fy]]) * camera.distortion_jacobian(rays[valid])
        contour = contour.select(valid)
        given = contour, slopes, view.mask_sigma, mask_image(mask, contour), view.has_mask_alone
        return cls(image, view.number, camera, is_exact, *given, _inversion_hint(view.pixels, mask))

    def first(self) -> Track:
        """Noise and reach at the start."""
        share = _WIDE_REACH if self.is_wide else _RELATIVE_REACH
        reach = max(_FIRST_REACH, share * self.contour.size)
        offset = _FIRST_OFFSET if self.is_exact else LEAST_OFFSET
        return Track(Noise(reach / 3, 1.0, offset), reach)

    def last(self, track: Track) -> Track:
        """Noise and reach of the last rounds."""
        return self._narrow(self.first()._replace(noise=track.noise, is_fine=self.is_exact))

    def outline(self, sight: Sight, track: Track) -> Outline:
        """Measure the outline of a posed surface; a fine track corrects the extraction bias."""
        rims = find_rims(sight, self.contour, track.reach)
        bias = np.zeros(len(rims.found))
        if track.is_fine:
            bias = extraction_bias(sight, self.mask, self.contour, rims)
        rims = remove_steep(self.contour, rims, bias)
        across = np.einsum("ni,nij->nj", rim_normals(self.contour, rims), self.slopes)
        return Outline(
            self.contour,
            rims.found,
            bias - rims.offset,
            np.ones(len(bias)),
            rims.points,
            rims.face,
            across,
            track.reach,
        )

    def learn(self, outline: Outline, offset: float, track: Track) -> Track:
        """Update the track's noise from the residuals before a step.

        Offsets of edges vary by a share of the common offset. On a similar surface, samples without
        a rim count with the largest residual.
        """
        residuals = outline.residuals(offset)
        if not self.is_exact:
            residuals = np.nan_to_num(residuals, nan=track.reach)
        pixels = _OF_PIXELS if track.is_fine else 1.0
        least = Noise(self.sigma or _LEAST_SIGMA, pixels, track.noise.offset)
        noise = outline.noise(residuals, least, LEAST_LOSS_SCALE)
        if self.is_exact and not track.is_fine:
            return self._narrow(track._replace(noise=noise._replace(correlation=1.0)))
        uneven = _EDGE * (_UNEVEN * noise.offset / noise.sigma) ** 2 * self.is_exact
        return track._replace(noise=noise._replace(correlation=noise.correlation + uneven))

    def _narrow(self, track: Track) -> Track:
        """Reduce the track's reach as far as its noise allows."""
        least = max(_LEAST_REACH, _OFFSETS * track.noise.offset)
        return track._replace(reach=min(track.reach, max(_REACH * track.noise.sigma, least)))

    def rank(self, found: MeasuredOutline) -> float:
        """-2 log probability for the comparison of estimates, with bounded noise."""
        residuals = np.nan_to_num(found.residuals, nan=_LARGEST)
        noise = Noise(float(np.clip(found.noise.sigma, *_RANKED)), _RANKED_CORRELATION, 0.0)
        normalization = 2 * len(residuals) / _RANKED_CORRELATION * float(np.log(noise.sigma))
        return float(noise.costs(residuals).sum()) + normalization

    def refusal(self, support: OutlineSupport) -> str:
        """The reason to leave the source out."""
        if not support.share:
            return f"no part of the model's outline comes near its contour{self.hint}"
        share = f"{100 * support.share:.0f} % of its contour"
        return f"only {share} can be the model's outline{self.hint}"

    def doubt(self, support: OutlineSupport) -> str | None:
        """The text of a warning about low support, or None.

        With keypoints, only an uneven contour raises it: an occluded object has sharp parts.
        """
        if support.share >= self.good_share:
            if not (self.is_wide and _leaves_image(self.mask[0] >= _INSIDE)):
                return None
            return (
                f"{self.where} reaches the image's border, where the object may go on: alone it "
                "may lead to another pose, give three keypoints beside it"
            )
        if not self.is_wide and not (self.is_exact and support.rms > _UNEVEN_RMS):
            return None
        return (
            f"{self.where}: only {100 * support.share:.0f} % of its contour meets the outline of "
            "the best pose found: the object may be partly hidden, the model another, or the pose "
            "wrong"
        )


def convex_hull(mask: FloatArray | BoolArray) -> BoolArray | None:
    """The convex hull of a mask (h, w) without small pieces; None if it leaves the image."""
    inside = mask >= _INSIDE
    if _leaves_image(inside):
        return None
    pieces, _ = cv2.findContours(
        inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE
    )
    largest = max(map(cv2.contourArea, pieces), default=0.0)
    kept = [piece for piece in pieces if cv2.contourArea(piece) >= _LEAST_PIECE * largest]
    filled = np.zeros(inside.shape, dtype=np.uint8)
    if kept:
        cv2.fillConvexPoly(filled, cv2.convexHull(np.concatenate(kept)), 1)
    return filled > 0


def _leaves_image(inside: BoolArray) -> bool:
    middle = inside[_OPEN_BORDER:-_OPEN_BORDER, _OPEN_BORDER:-_OPEN_BORDER]
    return bool(inside.sum() > middle.sum())


def _inversion_hint(pixels: FloatArray, mask: FloatArray | BoolArray) -> str:
    """A hint if most keypoints lie off the mask, which may be inverted; otherwise empty."""
    places = np.round(pixels).astype(int)
    u, v = places[((places >= 0) & (places < mask.shape[::-1])).all(axis=1)].T
    count, off = len(u), int((mask[v, u] < _INSIDE).sum())
    if count < _LEAST_KEYPOINTS or 2 * off <= count:
        return ""
    return f"; {off} of {count} keypoints lie off it: it may be inverted, or another object's"


# The photo ----------------------------------------------------------------------------------------


# Reaches of the lines in each round, relative to the silhouette's size.
_COARSE, _FINE = (0.16, 0.08), (0.04, 0.02, 0.02)
_LEAST_REACH = 5.0  # [px]
_REACH_CELLS = 6.4  # per reach, of a silhouette's grid
_FEWEST_CELLS, _MOST_CELLS = 80, 220  # along the longer side of a silhouette
_LEAST_OUTLIER = 2.0  # in standard deviations
# Standard deviation [px] of the common offset, from light and blur.
_OFFSET = 0.4
_FIRST = Noise(1.0, 4.0, _OFFSET)
_LEAST = Noise(0.5, 16.0, _OFFSET)  # pixels and blur correlate neighbours
_STRAY = 0.2  # share of the lines that detect other edges
_LINES_OF_PATCH = 5.0  # number of lines with independent colours
_LEAST_CONTRAST = 2.0  # [nats], of the silhouette; noise gives one
_MOST_RMS = 1.4  # [sigma], of the found lines, that raises no warning


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

    def learn(self, outline: Outline, offset: float, track: Track) -> Track:
        """Update the track's noise from the residuals, at the last level only."""
        if not track.is_fine or track.levels:
            return track
        return track._replace(noise=_noise_of(outline, outline.residuals(offset)))

    def rank(self, found: MeasuredOutline) -> float:
        """-2 log probability relative to uniform places, and to a silhouette anywhere."""
        outline, residuals = found.outline, found.residuals
        noise = _noise_of(outline, residuals)
        sigmas = noise.sigma * outline.sigmas[outline.found]
        squares = (residuals[outline.found] / sigmas) ** 2
        density = np.exp(-squares / 2) / np.sqrt(2 * np.pi) / sigmas
        # Some lines detect other edges.
        gains = np.log((1 - _STRAY) * density * 2 * outline.reach + _STRAY)
        return -2 * (float(gains.sum() / noise.correlation) + _contrast(outline))

    def support(self, found: MeasuredOutline) -> OutlineSupport:
        """Agreement with the outline; none if both sides have the same colours."""
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
    """Log likelihood [nats] of the colours, relative to a silhouette anywhere."""
    return 2 * len(outline.found) / _LINES_OF_PATCH * outline.contrast


def _noise_of(outline: Outline, residuals: FloatArray) -> Noise:
    return outline.noise(residuals, _LEAST, _LEAST_OUTLIER)
