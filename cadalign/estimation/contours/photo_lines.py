"""Detect a model's outline in a photo on lines across the predicted outline.

The statistics of region-based tracking: M. Stoiber, M. Pfanne, K. H. Strobl, R. Triebel,
A. Albu-Schaeffer, "SRT3D: A sparse region-based 3D object tracking approach for the real world",
IJCV 130, 2022 (arXiv 2110.12715). Histograms of the colours on both sides of the predicted outline
give each pixel's probability to show the object. Together with a smoothed step function, the pixels
of a line give the posterior of the place where the line leaves the object.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.estimation.contours.contour import (
    Contour,
    Sight,
    contour_of,
    find_rims,
    remove_steep,
    rim_normals,
)
from cadalign.estimation.contours.outline import Outline
from cadalign.geometry.alignment import bounds_corners
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import PIXEL_CENTRE, rescaled_pixels
from cadalign.io.images import ByteImage

_BINS = 16  # of a channel
_FLOOR = 1e-4  # share of unseen colours
_AMPLITUDE = 0.43  # of the step; the rest of 0.5 is unmodelled noise
_SLOPE = 0.6  # half width of the step, in steps along the line
_LEAST_PRECISION = 0.1  # of a usable line, relative to the prior
_OF_STEPS = 1 / 12  # variance of a place within a step
_LEAST_SIDE = 2.0  # steps on either side of an edge
_QUANTUM = 3.0  # variance of three channels from quantisation and noise
_NEIGHBOUR = 0.45  # weight of a neighbour's log likelihoods
_STRAY = 1e-3  # probability of a crossing anywhere on a line, whatever its colours


def bins_of(colors: ByteImage) -> IntArray:
    """Bin indices (...) of colours (..., 3)."""
    cells = (colors // (256 // _BINS)).astype(np.int64)
    return np.asarray((cells[..., 0] * _BINS + cells[..., 1]) * _BINS + cells[..., 2])


_PADDED = np.pad(np.eye(_BINS), [(1, 1), (0, 0)], mode="edge")
_SMOOTHING = (_PADDED[:-2] + 2 * _PADDED[1:-1] + _PADDED[2:]) / 4  # of bins, by neighbouring ones


def _histogram(bins: IntArray) -> FloatArray:
    counts = np.bincount(bins, minlength=_BINS**3).astype(np.float64)
    for _ in range(3):  # smooth red, green and blue in turn
        counts = (_SMOOTHING @ counts.reshape(_BINS, -1)).T
    shares = counts.ravel() / max(counts.sum(), 1.0)
    return np.asarray((1 - _FLOOR) * shares + _FLOOR / _BINS**3)


def regions_of(inside: IntArray, outside: IntArray) -> tuple[FloatArray, float]:
    """Odds by bins, and contrast, from the bins of the colours inside and outside.

    Odds are P(object) - P(background); the contrast is the mutual information of side and colour
    [nats], log 2 at most.
    """
    own, other = _histogram(inside), _histogram(outside)
    both = (own + other) / 2
    contrast = (own * np.log(own / both) + other * np.log(other / both)).sum() / 2
    return (own - other) / (2 * both), float(contrast)


def changes_of(odds: FloatArray, valid: BoolArray) -> FloatArray:
    """Log likelihoods (S, 2 K + 1) of leaving the object at each step, by the ``valid`` odds."""
    steps = np.arange(odds.shape[1])
    gaps = steps[:, None] - steps  # of the crossing (rows) from the pixels (columns)
    step = _AMPLITUDE * np.tanh(gaps / (2 * _SLOPE))
    known = np.where(valid, odds, 0.0)
    return np.asarray(np.log(0.5 + step * known[:, None, :]).sum(axis=2))


def add_neighbours(logs: FloatArray, are_neighbours: BoolArray) -> FloatArray:
    """Add a share of the log likelihoods (S, 2 K + 1) of the neighbouring lines.

    Neighbours have nearly the same displacement, and help to choose between crossings. Since their
    colours are correlated, the sum is divided by the root of its weights.
    """
    total = np.logaddexp.reduce(logs, axis=1, keepdims=True)
    bounded = np.logaddexp(logs - total, np.log(_STRAY / logs.shape[1]))
    shares = _NEIGHBOUR * are_neighbours[:, None]
    found, weights = bounded.copy(), np.ones((len(bounded), 1))
    for own, other in ((slice(1, None), slice(-1)), (slice(-1), slice(1, None))):
        found[own] += shares * bounded[other]
        weights[own] += shares
    return np.asarray(found / np.sqrt(weights))


def crossings_of(logs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places (S,) [steps outwards] and variances (S,) from log likelihoods (S, 2 K + 1).

    The uniform prior is divided out: a line without contrast has an infinite variance.
    """
    count = logs.shape[1]
    steps = np.arange(count) - count // 2
    likely = np.exp(logs - logs.max(axis=1, keepdims=True))
    likely /= likely.sum(axis=1, keepdims=True)
    mean = likely @ steps
    variance = likely @ steps**2 - mean**2 + _OF_STEPS
    prior = 1 / float((steps**2).mean())
    precision = 1 / variance - prior
    is_usable = precision > _LEAST_PRECISION * prior
    safe = np.where(is_usable, precision, 1.0)
    places = mean / variance / safe
    is_usable &= np.abs(places) < count / 2
    return np.where(is_usable, places, 0.0), np.where(is_usable, 1 / safe, np.inf)


def edges_of(colors: FloatArray, valid: BoolArray, step: float) -> FloatArray:
    """Log likelihoods (S, 2 K + 1) of a change of the colours (S, 2 K + 1, c) at each step.

    For constant colours on both sides with noise of unknown level, the likelihood of n pixels is
    E^(-n / 2), with the sum of squares E about both means. A step is ``step`` pixels long.
    """
    weights = valid.astype(np.float64)
    values = weights[..., None] * colors
    total = weights.sum(axis=1, keepdims=True)
    before, first = _sums_before(weights), _sums_before(values)
    after, second = total - before, values.sum(axis=1, keepdims=True) - first
    usable = (before >= _LEAST_SIDE) & (after >= _LEAST_SIDE)
    between = (first**2).sum(axis=2) / np.where(usable, before, 1.0)
    between += (second**2).sum(axis=2) / np.where(usable, after, 1.0)
    squares = (values * colors).sum(axis=(1, 2))
    # A line with an unknown side has no edge.
    error = squares[:, None] - np.where(usable, between, np.inf).min(axis=1, keepdims=True)
    error = np.where(usable, squares[:, None] - between, error) + _QUANTUM * total
    found = -total * min(step, 1.0) / 2 * np.log(np.maximum(error, 1e-9))
    return np.where(usable.any(axis=1, keepdims=True), found, 0.0)


def _sums_before(values: FloatArray) -> FloatArray:
    """Sums along lines (S, 2 K + 1, ...) before each step; the step itself counts half."""
    return np.asarray(np.cumsum(values, axis=1) - values / 2)


STEPS = 10
"""Steps of a line to either side."""
_BAND = 2.5  # width of the sampled background, in reaches
_LEAST_PIXELS = 30
_RIM_REACH = 2.0  # cells
_BORDER = 2.0  # [px]
_EDGE_STEP = 1.0  # [px], longest step at which edges are used
_SMALLEST = 64  # [px], side of the smallest level of the pyramid


class PhotoPyramid(NamedTuple):
    """An image pyramid of a photo; each level is half as wide as the last."""

    camera: Camera
    levels: tuple[ByteImage, ...]

    def colors(self, points: FloatArray, step: float) -> ByteImage:
        """Colours (h, w, 3) at pixels (h, w, 2), averaged over about a ``step`` [px]."""
        level = min(int(np.log2(max(step, 1.0))), len(self.levels) - 1)
        x, y = np.moveaxis(rescaled_pixels(points, 0.5**level), -1, 0).astype(np.float32)
        border = cv2.BORDER_REPLICATE
        found = cv2.remap(self.levels[level], x, y, cv2.INTER_LINEAR, borderMode=border)
        return np.asarray(found, dtype=np.uint8)


def photo_of(camera: Camera, pixels: ByteImage) -> PhotoPyramid:
    levels = [pixels]
    while min(levels[-1].shape[:2]) > _SMALLEST:
        height, width = levels[-1].shape[:2]
        size = (width // 2, height // 2)
        even = levels[-1][: 2 * size[1], : 2 * size[0]]
        smaller = cv2.resize(even, size, interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(smaller, dtype=np.uint8))
    return PhotoPyramid(camera, tuple(levels))


class Silhouette(NamedTuple):
    """The silhouette of a posed surface on a grid of the image, and its rims.

    The cell (0, 0) of ``inside`` (h, w) lies at the pixel ``corner``; cells are ``cell`` px apart.
    Samples of the ``contour`` lie on the rims; ``points`` (S, 3) are on triangles ``face`` (S,).
    """

    inside: BoolArray
    corner: FloatArray
    cell: float
    contour: Contour
    across: FloatArray
    points: FloatArray
    face: IntArray

    @property
    def size(self) -> float:
        """Square root of the area [px]."""
        return float(np.sqrt(self.inside.sum()) * self.cell)

    def contains(self, points: FloatArray) -> BoolArray:
        """True (...) for pixels (..., 2) inside."""
        columns, rows = np.moveaxis(np.rint((points - self.corner) / self.cell), -1, 0)
        return np.asarray(map_coordinates(self.inside, [rows, columns], order=0))


def silhouette_of(sight: Sight, cells: int) -> Silhouette | None:
    """The silhouette with ``cells`` cells along its longer side; None without visible rims."""
    box = _box_in_image(sight)
    if box is None:
        return None
    low, high = box
    cell = max(1.0, float((high - low).max()) / cells)
    # A margin for smoothing, and for colours of the background.
    corner = low - 4 * cell
    width, height = (np.ceil((high - low) / cell).astype(int) + 9).tolist()
    inside = _covered_cells(sight, corner, cell, (height, width))
    rough = contour_of(inside)
    if not len(rough.points):
        return None
    contour = rough._replace(points=corner + cell * rough.points)
    rims = remove_steep(contour, find_rims(sight, contour, _RIM_REACH * cell))
    on_rim = contour._replace(points=contour.offset_points(rims.offset))
    across = rim_normals(on_rim, rims._replace(offset=np.zeros(len(rims.offset))))
    within = (on_rim.points > _BORDER) & (
        on_rim.points < [sight.camera.width - 3, sight.camera.height - 3]
    )
    kept = rims.found & within.all(axis=1)
    if not kept.any():
        return None
    found = on_rim.select(kept), across[kept], rims.points[kept], rims.face[kept]
    return Silhouette(inside, corner, cell, *found)


def _covered_cells(
    sight: Sight, corner: FloatArray, cell: float, shape: tuple[int, int]
) -> BoolArray:
    """Cells (h, w) that the object covers, rendered at half resolution except near the outline."""
    height, width = shape
    every_second = np.stack(np.meshgrid(np.arange(0, width, 2), np.arange(0, height, 2)), axis=-1)
    coarse = sight.covers(corner + cell * every_second).astype(np.uint8)
    near = cv2.morphologyEx(coarse, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    inside, open_cells = (
        each.repeat(2, axis=0).repeat(2, axis=1)[:height, :width] > 0 for each in (coarse, near)
    )
    open_cells[::2, ::2] = False
    rows, columns = np.nonzero(open_cells)
    inside[rows, columns] = sight.covers(corner + cell * np.column_stack([columns, rows]))
    return inside


def _box_in_image(sight: Sight) -> tuple[FloatArray, FloatArray] | None:
    """Corners of the object's bounding box in the image; None if it is outside."""
    camera, seen = sight.camera, sight.pose.apply(bounds_corners(*sight.caster.bounds))
    size = np.array([camera.width, camera.height]) - 1.0
    if (seen[:, 2] <= 0).any():
        return np.zeros(2), size
    pixels = camera.project(seen)
    low, high = np.clip([pixels.min(axis=0), pixels.max(axis=0)], 0, size)
    return None if (high - low < 2).any() else (low, high)


def outline_of(photo: PhotoPyramid, silhouette: Silhouette, reach: float) -> Outline | None:
    """The outline on lines of length ``reach`` [px] to each side; None with too few pixels."""
    step = reach / STEPS
    inside, outside = _side_colors(photo, silhouette, reach, step)
    if min(len(inside), len(outside)) < _LEAST_PIXELS:
        return None
    odds, contrast = regions_of(inside, outside)
    contour = silhouette.contour
    steps = step * np.arange(-STEPS, STEPS + 1)
    pixels = contour.points[:, None] + steps[:, None] * contour.normals[:, None]
    colors = photo.colors(pixels, step)
    valid = _visible_pixels(photo, silhouette, pixels)
    logs = changes_of(odds[bins_of(colors)], valid)
    if step <= _EDGE_STEP:
        logs += edges_of(colors.astype(np.float64), valid, step)
        logs = add_neighbours(logs, contour.neighbours(np.ones(len(logs), dtype=bool)))
    places, variances = crossings_of(logs)
    found = np.isfinite(variances)
    sigmas = step * np.sqrt(np.where(found, variances, 1.0))
    rays, _ = photo.camera.normalize_where_valid(contour.points)
    focal = np.array([[photo.camera.fx], [photo.camera.fy]])
    slopes = focal * photo.camera.distortion_jacobian(rays)
    return Outline(
        contour,
        found,
        step * places,
        sigmas,
        silhouette.points,
        silhouette.face,
        np.einsum("ni,nij->nj", silhouette.across, slopes),
        reach,
        contrast,
    )


def _side_colors(
    photo: PhotoPyramid, silhouette: Silhouette, reach: float, step: float
) -> tuple[IntArray, IntArray]:
    """Colour bins well inside the silhouette, and outside near the outline."""
    cell = silhouette.cell
    room = int(np.ceil(_BAND * reach / cell))
    inside = np.pad(silhouette.inside, room).astype(np.uint8)
    depth, height = (
        cell * np.asarray(cv2.distanceTransform(side, cv2.DIST_L2, 3))
        for side in (inside, 1 - inside)
    )
    margin = min(reach / 4, float(depth.max()) / 2)
    rows, columns = np.indices(inside.shape)
    pixels = silhouette.corner + cell * (np.stack([columns, rows], axis=-1) - room)
    colors = photo.colors(pixels, step)
    seen = photo.camera.contains(pixels, margin=PIXEL_CENTRE)
    own = seen & (depth > margin)
    other = seen & (height > margin) & (height < _BAND * reach)
    return bins_of(colors[own]), bins_of(colors[other])


def _visible_pixels(photo: PhotoPyramid, silhouette: Silhouette, pixels: FloatArray) -> BoolArray:
    """True for pixels (S, 2 K + 1, 2) until a line leaves the image or re-enters the object."""
    kept = silhouette.contains(pixels) == (np.arange(2 * STEPS + 1) < STEPS)
    kept &= photo.camera.contains(pixels, margin=PIXEL_CENTRE)
    kept[:, STEPS - 1 : STEPS + 2] = True  # cells are coarser than the rim
    for half in (kept[:, STEPS::-1], kept[:, STEPS:]):
        np.logical_and.accumulate(half, axis=1, out=half)
    return np.asarray(kept)
