"""Contours of masks, and rims: points on a contour's normals where a model's silhouette ends.

Smoothing rounds corners off, and pixels quantise a contour. To remove this bias, the model's
silhouette is rendered in the same pixels, and its contour is extracted likewise: the difference of
the two contours has no bias.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment, model_rays
from cadalign.geometry.camera import Camera
from cadalign.geometry.raycaster import RayCaster

SPACING = 2.0
"""Distance between neighbouring samples along the contour [px]."""

_SMOOTHING = 1.0  # [px], of the image whose level line is the contour
_NORMAL_SMOOTHING = 2.0  # [px], of the image whose gradient is the normal
_BORDER = 3.0  # [px], distance from the image's border without samples
_LEAST_AREA = 0.003  # of a piece or hole, relative to the largest piece
_LEAST_PIXELS = 12
# A longer contour is noise, and slow: in pixels, and in diagonals of its bounding box.
_LONGEST, _MOST_DIAGONALS = 80_000.0, 45.0
REACH = 2.0
"""Largest distance of a level line from a boundary pixel, or from a rim [px]."""
_STEP = 0.25
_LONGEST_STEP = 1.5  # [px], between rays on a normal: thinner parts may be missed
_MOST_STEPS = 24  # to either side
_PRECISION = 0.05  # [px], of a rim
_STEEPEST = 1.2  # tangent of the angle between rim and contour above which these don't match
_BAND = 5  # width [px] of the band about a rim that is rendered
_MARGIN = 8  # [px], about the rims, for reach and smoothing
_LEAST_COSINE = 0.3  # between rim and contour


Image = npt.NDArray[np.float32]


class Contour(NamedTuple):
    """Samples ``points`` (S, 2) [px] of a mask's contour, `SPACING` apart on each ``curve`` (S,).

    The unit ``normals`` (S, 2) point away from the object.
    """

    points: FloatArray
    normals: FloatArray
    curve: IntArray

    @property
    def size(self) -> float:
        """Geometric mean of the extents [px]."""
        return float(np.sqrt(np.prod(np.ptp(self.points, axis=0))))

    def offset_points(self, places: FloatArray) -> FloatArray:
        return np.asarray(self.points + places[..., None] * self.normals)

    def neighbours(self, kept: BoolArray, lag: int = 1) -> BoolArray:
        """True (S - lag,) where a sample and the one ``lag`` before it on its curve are kept."""
        same = self.curve[lag:] == self.curve[:-lag]
        return np.asarray(kept[lag:] & kept[:-lag] & same)

    def select(self, chosen: BoolArray | IntArray) -> Contour:
        return Contour(self.points[chosen], self.normals[chosen], self.curve[chosen])


def contour_of(probability: FloatArray | BoolArray) -> Contour:
    """Samples of the level line 0.5 of a smoothed mask (h, w) of probabilities.

    Small pieces, small holes, and samples near the image's border are dropped: the object may
    extend beyond it.
    """
    image = np.ascontiguousarray(probability, dtype=np.float32)
    level = smooth(image)
    soft = smooth(image, _NORMAL_SMOOTHING)
    slope_x: Image = np.asarray(cv2.Sobel(soft, cv2.CV_32F, 1, 0, ksize=3), dtype=np.float32)
    slope_y: Image = np.asarray(cv2.Sobel(soft, cv2.CV_32F, 0, 1, ksize=3), dtype=np.float32)
    points, normals, curves = [np.empty((0, 2))], [np.empty((0, 2))], [np.empty(0, dtype=int)]
    count = 0
    for chain in _chains(level):
        places, outwards = _level_line(chain, level, slope_x, slope_y)
        if len(places) < 3:
            continue
        for piece, directions in _clip_to_image(*_resample(places, outwards), image.shape):
            points.append(piece)
            normals.append(directions)
            curves.append(np.full(len(piece), count))
            count += 1
    return Contour(np.concatenate(points), np.concatenate(normals), np.concatenate(curves))


def interpolate(image: Image, points: FloatArray) -> FloatArray:
    """Interpolate an image (h, w) at points (n, 2) bilinearly; extend its border.

    `cv2.remap` rounds to 1/32 px, which is too coarse for contours.
    """
    places = np.fmin(np.fmax(points, 0.0), np.subtract(image.shape[::-1], 1))  # 0 for NaN
    values = map_coordinates(image, places.T[::-1], order=1, mode="nearest", output=np.float64)
    return np.asarray(values)


def smooth(image: Image, sigma: float = _SMOOTHING) -> Image:
    """Smooth a mask (h, w); the level line 0.5 is its contour."""
    return np.asarray(
        cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE), dtype=np.float32
    )


def _chains(level: Image) -> list[FloatArray]:
    """Ordered boundary pixels (n, 2) of all pieces and holes that are large enough."""
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


def _level_line(
    chain: FloatArray, level: Image, slope_x: Image, slope_y: Image
) -> tuple[FloatArray, FloatArray]:
    """Points (n, 2) of the level line next to boundary pixels (n, 2), and outward normals."""
    normals = -np.column_stack([interpolate(slope_x, chain), interpolate(slope_y, chain)])
    length = np.linalg.norm(normals, axis=1)
    kept = length > 1e-6
    chain, normals = chain[kept], normals[kept] / length[kept, None]
    places = crossings(level, chain, normals, np.zeros(len(chain)), -_STEP)
    known = np.isfinite(places)
    points = chain[known] + places[known, None] * normals[known]
    outwards = -np.column_stack([interpolate(slope_x, points), interpolate(slope_y, points)])
    return points, _unit_rows(outwards)


def _unit_rows(vectors: FloatArray) -> FloatArray:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(lengths, 1e-12))


def crossings(
    level: Image,
    points: FloatArray,
    normals: FloatArray,
    offsets: FloatArray,
    first: float = -REACH,
) -> FloatArray:
    """Places (S,) of exits from a level line on normals, nearest to ``offsets`` (S,); or NaN."""
    steps = np.arange(first, REACH + _STEP / 2, _STEP)
    places = offsets + steps[:, None]
    along = points + places[..., None] * normals
    values = interpolate(level, along.reshape(-1, 2)).reshape(places.shape)
    nearest, is_left = _nearest_exits(values >= 0.5, steps)
    every = np.arange(len(offsets))
    before, after = values[nearest, every], values[nearest + 1, every]
    with np.errstate(divide="ignore", invalid="ignore"):
        found = places[nearest, every] + _STEP * (before - 0.5) / (before - after)
    return np.where(is_left, found, np.nan)


def _nearest_exits(inside: BoolArray, steps: FloatArray) -> tuple[IntArray, BoolArray]:
    """Index (S,) of the last step inside before the exit nearest to 0, and True if there is one."""
    exits = inside[:-1] & ~inside[1:]
    middles = np.abs(steps[:-1] + steps[1:])
    nearest = np.where(exits, middles[:, None], np.inf).argmin(axis=0)
    return nearest, exits[nearest, np.arange(inside.shape[1])]


def _resample(points: FloatArray, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Samples `SPACING` apart along a closed curve of points (n, 2)."""
    rows = np.hstack([points, normals])
    ring = np.vstack([rows, rows[:1]])
    lengths = np.linalg.norm(np.diff(ring[:, :2], axis=0), axis=1)
    places = np.concatenate([[0.0], np.cumsum(lengths)])
    count = round(places[-1] / SPACING)
    wanted = (np.arange(count) + 0.5) * (places[-1] / max(count, 1))
    samples = np.column_stack([np.interp(wanted, places, column) for column in ring.T])
    return samples[:, :2], _unit_rows(samples[:, 2:])


def _clip_to_image(
    points: FloatArray, normals: FloatArray, shape: tuple[int, ...]
) -> list[tuple[FloatArray, FloatArray]]:
    size = np.array([shape[1], shape[0]]) - 1
    off_border = (points > _BORDER) & (points < size - _BORDER)
    kept: BoolArray = np.asarray(off_border.all(axis=1))
    if kept.all():
        return [(points, normals)]
    shift = -int(np.argmin(kept))  # begin outside, so that no part is cut in two
    order = np.roll(np.arange(len(points)), shift)
    ends = np.flatnonzero(np.diff(kept[order].astype(int))) + 1
    return [(points[part], normals[part]) for part in np.split(order, ends) if kept[part[0]]]


def mask_contour(mask: FloatArray | BoolArray, where: str) -> Contour:
    """The contour of a mask (h, w); raises InputError if it has none, or one of noise."""
    contour = contour_of(mask)
    if not len(contour.points):
        what = "no part of its contour is larger than a few pixels and off the image's border"
        fix = (
            "give the mask of the object alone, in a photo that shows more of its outline, or None"
        )
        raise InputError(what, where=where, fix=fix)
    length = SPACING * len(contour.points)
    diagonal = float(np.linalg.norm(np.ptp(contour.points, axis=0)))
    if length > max(SPACING, min(_LONGEST, _MOST_DIAGONALS * diagonal)):
        what = f"has a contour of {length:,.0f} px, longer than an object's: the mask is noisy"
        fix = "remove specks and holes, or give a smaller image"
        raise InputError(what, where=where, fix=fix)
    return contour


class Rims(NamedTuple):
    """Rims on the normals of S samples, where ``found`` (S,).

    ``offset`` (S,) [px] is the distance outwards of the contour; ``points`` (S, 3) are in the
    model's frame before its stretch, on triangles ``face`` (S,).
    """

    found: BoolArray
    offset: FloatArray
    points: FloatArray
    face: IntArray


class Sight(NamedTuple):
    """A surface at a pose in front of a camera."""

    caster: RayCaster
    camera: Camera
    pose: Alignment

    def covers(self, pixels: FloatArray) -> BoolArray:
        """True (...) where pixels (..., 2) show the object."""
        origin, directions, valid = self._rays(pixels)
        covered = self.caster.hit_mask(origin, directions)
        covered &= valid
        return np.asarray(covered.reshape(pixels.shape[:-1]))

    def hits(self, pixels: FloatArray) -> tuple[IntArray, FloatArray]:
        """Triangles (S,), -1 for none, and surface points (S, 3) at pixels (S, 2)."""
        origin, directions, valid = self._rays(pixels)
        face, depth = self.caster.first_hits(origin, directions)
        seen = valid & (face >= 0)
        return np.where(seen, face, -1), origin + np.where(seen, depth, 0.0)[:, None] * directions

    def _rays(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray | np.bool_]:
        flat, camera = pixels.reshape(-1, 2).astype(float), self.camera
        origin, model_from_ray = model_rays(self.pose)
        if camera.distortion or camera.is_wide:
            flat, valid = camera.normalize_where_valid(flat)
            return origin, flat @ model_from_ray[:, :2].T + model_from_ray[:, 2], valid
        by_pixel = model_from_ray[:, :2] / (camera.fx, camera.fy)  # one affine map, which is faster
        first = model_from_ray[:, 2] - by_pixel @ (camera.cx, camera.cy)
        return origin, flat @ by_pixel.T + first, np.True_


def find_rims(sight: Sight, contour: Contour, reach: float) -> Rims:
    """Exits from the object on normals, nearest to the contour within ``reach`` [px]."""
    count = len(contour.points)
    intervals = 2 * min(int(np.ceil(reach / _LONGEST_STEP)), _MOST_STEPS)
    steps = np.linspace(-reach, reach, intervals + 1)
    first, found = _rim_intervals(sight, contour, steps)
    rows = np.flatnonzero(found)
    some = contour.select(rows)
    inner, outer = steps[first[rows]], steps[first[rows] + 1]
    for _ in range(int(np.ceil(np.log2((steps[1] - steps[0]) / _PRECISION)))):
        half = (inner + outer) / 2
        inside = sight.covers(some.offset_points(half))
        inner, outer = np.where(inside, half, inner), np.where(inside, outer, half)
    face, points = sight.hits(some.offset_points(inner))
    hit = face >= 0  # a ray beside the bisection's may slip through
    found[rows[~hit]] = False
    rows = rows[hit]
    offset, surface = np.zeros(count), np.zeros((count, 3))
    faces = np.full(count, -1)
    offset[rows] = ((inner + outer) / 2)[hit]
    surface[rows] = points[hit]
    faces[rows] = face[hit]
    return Rims(found, offset, surface, faces)


def _rim_intervals(sight: Sight, contour: Contour, steps: FloatArray) -> tuple[IntArray, BoolArray]:
    """`_nearest_exits` at steps along normals; steps next to the contour are tried first."""

    def exits(some: Contour, places: FloatArray) -> tuple[IntArray, BoolArray]:
        along = np.repeat(places[:, None], len(some.points), axis=1)
        return _nearest_exits(sight.covers(some.offset_points(along)), places)

    near = len(steps) // 2 - 1
    first, found = exits(contour, steps[near : near + 3])
    first, rest = first + near, np.flatnonzero(~found)
    first[rest], found[rest] = exits(contour.select(rest), steps)
    return first, found


def remove_steep(contour: Contour, rims: Rims, bias: FloatArray | float = 0.0) -> Rims:
    """Remove rims at a steep angle to the contour, which do not match it.

    ``bias`` (S,) is the bias of the contour's extraction, which rounds corners off.
    """
    distances = rims.offset - bias
    steep = contour.neighbours(rims.found) & (np.abs(np.diff(distances)) > _STEEPEST * SPACING)
    found = rims.found.copy()
    found[1:] &= ~steep
    found[:-1] &= ~steep
    return rims._replace(found=found)


def rim_normals(contour: Contour, rims: Rims) -> FloatArray:
    """Normals (S, 2) of the rims, of length 1 along the contour's normals.

    Motion along the rim does not change its distance from the contour. Without a neighbouring rim,
    the contour's normals.
    """
    places = contour.offset_points(rims.offset)
    gaps = np.diff(places, axis=0)
    gaps[~contour.neighbours(rims.found)] = 0.0
    along = np.zeros_like(places)
    along[1:] += gaps
    along[:-1] += gaps
    across = np.column_stack([along[:, 1], -along[:, 0]])
    projected = (across * contour.normals).sum(axis=1)
    usable = np.abs(projected) > _LEAST_COSINE * np.linalg.norm(across, axis=1)
    scale = np.where(usable, projected, 1.0)[:, None]
    return np.where(usable[:, None], across / scale, contour.normals)


MaskImage = tuple[Image, FloatArray]
"""A mask (h, w) of probabilities, and distances (S,) [px] along normals to its smoothed contour.

A distance is NaN if the contour was not found."""


def mask_image(mask: FloatArray | BoolArray, contour: Contour) -> MaskImage:
    """A mask, and the distances of its smoothed contour from the samples."""
    inside = np.ascontiguousarray(mask, dtype=np.float32)
    none = np.zeros(len(contour.points))
    return inside, crossings(smooth(inside), contour.points, contour.normals, none)


def extraction_bias(sight: Sight, mask: MaskImage, contour: Contour, rims: Rims) -> FloatArray:
    """Distances (S,) [px] from the contour extracted from rendered rims outwards to the rims.

    Zero without a rim, or without a contour near it.
    """
    rows = np.flatnonzero(rims.found)
    bias = np.zeros(len(rims.found))
    if not len(rows):
        return bias
    some, offsets = contour.select(rows), rims.offset[rows]
    inside, places = mask
    corner, rendered = _render_band(sight, inside, some.offset_points(offsets))
    own = crossings(smooth(rendered), some.points - corner, some.normals, offsets)
    bias[rows] = np.nan_to_num(offsets - (own - places[rows]))
    return np.where(np.abs(bias) < REACH, bias, 0.0)


def _render_band(sight: Sight, mask: Image, rims: FloatArray) -> tuple[IntArray, Image]:
    """Render the silhouette near rims (S, 2) [px] into the mask; its corner (2,), and the image."""
    height, width = mask.shape
    places = np.clip(np.rint(rims).astype(int), 0, [width - 1, height - 1])
    corner = np.maximum(places.min(axis=0) - _MARGIN, 0)
    right, bottom = places.max(axis=0) + _MARGIN + 1
    rendered = mask[corner[1] : bottom, corner[0] : right].copy()
    near = np.zeros(rendered.shape, dtype=np.uint8)
    near[tuple((places - corner).T[::-1])] = 1
    near = np.asarray(cv2.dilate(near, np.ones((_BAND, _BAND), np.uint8)), dtype=np.uint8)
    pixels = cv2.findNonZero(near).reshape(-1, 2)  # five times as fast as NumPy
    rendered[pixels[:, 1], pixels[:, 0]] = sight.covers(pixels + corner)
    return corner, rendered
