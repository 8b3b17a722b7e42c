"""Contours of masks: samples with sub-pixel places and normals, accuracy of their residuals."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import InputError

SPACING = 2.0
"""Distance of neighbouring samples along the contour [px]."""

_SMOOTHING = 1.0  # [px], of the image whose level line is the contour
_NORMAL_SMOOTHING = 2.0  # [px], of the image whose gradient is the normal
_BORDER = 3.0  # [px], within which the image's border shapes the contour
_LEAST_AREA = 0.003  # of a piece or hole, relative to the largest piece
_LEAST_PIXELS = 12
_REACH = 2.0  # [px], between a boundary pixel and the level line
_STEP = 0.25


Image = npt.NDArray[np.float32]
_TO_SIGMA = 1.4826  # from the median of absolute values to the deviation of a Gaussian
_OUTLYING = 3.5  # in deviations
_MOST_LAGS = 100
_LEAST_PAIRS = 20


class Contour(NamedTuple):
    """Samples of a mask's contour, S of them, curve after curve in their order along each.

    ``points`` (S, 2) [px], unit ``normals`` (S, 2) from the object outwards, and the number
    ``curve`` (S,) of the closed curve or stretch of one that a sample belongs to: neighbours of one
    curve are `SPACING` apart.
    """

    points: FloatArray
    normals: FloatArray
    curve: IntArray

    @property
    def size(self) -> float:
        """Geometric mean of the extents [px]."""
        return float(np.sqrt(np.prod(np.ptp(self.points, axis=0))))

    def taken(self, chosen: BoolArray | IntArray) -> Contour:
        """The samples that a mask or numbers choose."""
        return Contour(self.points[chosen], self.normals[chosen], self.curve[chosen])


def contour_of(probability: FloatArray | BoolArray) -> Contour:
    """Samples of the contour of a mask (h, w) of probabilities.

    The contour is the level line 0.5 of the smoothed mask: smoothing takes the stairs of a binary
    mask away. Small pieces and holes are dropped, and samples near the image's border, where the
    object may go on outside.
    """
    image = np.ascontiguousarray(probability, dtype=np.float32)
    level = smoothed(image)
    soft = _blurred(image, _NORMAL_SMOOTHING)
    slope_x: Image = np.asarray(cv2.Sobel(soft, cv2.CV_32F, 1, 0, ksize=3), dtype=np.float32)
    slope_y: Image = np.asarray(cv2.Sobel(soft, cv2.CV_32F, 0, 1, ksize=3), dtype=np.float32)
    points, normals, curves = [np.empty((0, 2))], [np.empty((0, 2))], [np.empty(0, dtype=int)]
    count = 0
    for chain in _chains(level):
        places, outwards = _on_level(chain, level, slope_x, slope_y)
        for piece, directions in _inside(*_resampled(places, outwards), image.shape):
            points.append(piece)
            normals.append(directions)
            curves.append(np.full(len(piece), count))
            count += 1
    return Contour(np.concatenate(points), np.concatenate(normals), np.concatenate(curves))


def smoothed(image: Image) -> Image:
    """The image (h, w) whose level line 0.5 is the contour of a mask."""
    return _blurred(image, _SMOOTHING)


def _blurred(image: Image, sigma: float) -> Image:
    return np.asarray(
        cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE), dtype=np.float32
    )


def _chains(level: Image) -> list[FloatArray]:
    """Boundary pixels (n, 2) of all pieces and holes that are large enough, in their order."""
    found, _ = cv2.findContours(
        (level >= 0.5).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE
    )
    if not found:
        return []
    areas = [cv2.contourArea(chain) for chain in found]
    least = max(_LEAST_AREA * max(areas), _LEAST_PIXELS)
    return [
        chain.reshape(-1, 2).astype(np.float64)
        for chain, area in zip(found, areas, strict=True)
        if area >= least
    ]


def _on_level(
    chain: FloatArray, level: Image, slope_x: Image, slope_y: Image
) -> tuple[FloatArray, FloatArray]:
    """Points (n, 2) of the level line next to boundary pixels (n, 2), and outward normals."""
    normals = -np.column_stack([sampled(slope_x, chain), sampled(slope_y, chain)])
    length = np.linalg.norm(normals, axis=1)
    kept = length > 1e-6
    chain, normals = chain[kept], normals[kept] / length[kept, None]
    steps = np.arange(-_STEP, _REACH + _STEP / 2, _STEP)
    along = chain[:, None] + steps[:, None] * normals[:, None]
    values = sampled(level, along.reshape(-1, 2)).reshape(len(chain), len(steps))
    falls = (values[:, :-1] >= 0.5) & (values[:, 1:] < 0.5)
    first = falls.argmax(axis=1)
    rows = np.flatnonzero(falls.any(axis=1))
    before, after = values[rows, first[rows]], values[rows, first[rows] + 1]
    places = steps[first[rows]] + _STEP * (before - 0.5) / (before - after)
    points = chain[rows] + places[:, None] * normals[rows]
    outwards = -np.column_stack([sampled(slope_x, points), sampled(slope_y, points)])
    outwards /= np.maximum(np.linalg.norm(outwards, axis=1, keepdims=True), 1e-12)
    return points, outwards


def sampled(image: Image, points: FloatArray) -> FloatArray:
    """Values (n,) of an image at points (n, 2), bilinear."""
    return interpolated(image, points).astype(np.float64)


def interpolated(image: Image, points: FloatArray) -> Image:
    """Values (n,) or colours (n, c) of an image (h, w) or (h, w, c) at points (n, 2), bilinear."""
    single = points.astype(np.float32)
    blocks = [
        cv2.remap(
            image,
            np.ascontiguousarray(part[:, :1]),
            np.ascontiguousarray(part[:, 1:]),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )[:, 0]
        for part in np.array_split(single, max(1, -(-len(single) // 30_000)))  # OpenCV takes 32,767
        if len(part)
    ]
    return np.concatenate([*blocks, np.empty((0, *image.shape[2:]), dtype=image.dtype)])


def _resampled(points: FloatArray, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Samples `SPACING` apart along a closed curve of points (n, 2)."""
    if len(points) < 3:
        return np.empty((0, 2)), np.empty((0, 2))
    ring = np.vstack([points, points[:1]])
    lengths = np.linalg.norm(np.diff(ring, axis=0), axis=1)
    places = np.concatenate([[0.0], np.cumsum(lengths)])
    count = round(places[-1] / SPACING)
    wanted = (np.arange(count) + 0.5) * (places[-1] / max(count, 1))
    around = np.vstack([normals, normals[:1]])
    samples = [np.interp(wanted, places, ring[:, axis]) for axis in range(2)]
    outwards = np.column_stack([np.interp(wanted, places, around[:, axis]) for axis in range(2)])
    outwards /= np.maximum(np.linalg.norm(outwards, axis=1, keepdims=True), 1e-12)
    return np.column_stack(samples), outwards


def _inside(
    points: FloatArray, normals: FloatArray, shape: tuple[int, ...]
) -> list[tuple[FloatArray, FloatArray]]:
    """The stretches of a closed curve that stay away from the image's border."""
    if not len(points):
        return []
    size = np.array([shape[1], shape[0]]) - 1
    off_border = (points > _BORDER) & (points < size - _BORDER)
    kept: BoolArray = np.asarray(off_border.all(axis=1))
    if kept.all():
        return [(points, normals)]
    shift = -int(np.argmin(kept))  # begin outside, so that no stretch is cut in two
    order = np.roll(np.arange(len(points)), shift)
    ends = np.flatnonzero(np.diff(kept[order].astype(int))) + 1
    return [(points[part], normals[part]) for part in np.split(order, ends) if kept[part[0]]]


def mask_contour(mask: FloatArray | BoolArray, where: str) -> Contour:
    """The contour of a checked mask (h, w).

    Raises InputError if it is empty or covers all of the image, or all of its contour lies at the
    image's border.
    """
    inside = mask if mask.dtype == bool else mask >= 0.5
    if not inside.any():
        fix = "give the mask of the object, or None"
        raise InputError("contains no pixel of the object", where=where, fix=fix)
    if inside.all():
        fix = "give the mask of the object alone, or None"
        raise InputError("covers all of the image, so that it has no contour", where=where, fix=fix)
    contour = contour_of(mask)
    if not len(contour.points):
        raise InputError(
            "no part of its contour is larger than a few pixels and off the image's border",
            where=where,
            fix="give a photo in which more of the object's outline is seen, or None",
        )
    return contour


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
        pairs = kept[lag:] & kept[:-lag] & (contour.curve[lag:] == contour.curve[:-lag])
        count = int(pairs.sum())
        if count < _LEAST_PAIRS:
            break
        rho = float((values[lag:] * values[:-lag])[pairs].sum() / count / variance)
        if rho <= 0:
            break
        total += 2 * rho
    return total
