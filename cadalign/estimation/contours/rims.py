"""Rims: where the model's silhouette ends on a contour's normals, by ray casting.

Smoothing rounds corners off, and pixels quantise a contour. The silhouette that the model has in
the same pixels, extracted as the mask's contour was, is displaced in the same way, so that the
difference of the two contours is free of both.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.estimation.contours.contour import SPACING, Contour, Image, sampled, smoothed
from cadalign.geometry.alignment import Alignment, model_rays
from cadalign.geometry.camera import Camera
from cadalign.geometry.raycaster import RayCaster

_LONGEST_STEP = 1.5  # [px], between rays on a normal: a thinner part may be missed
_MOST_STEPS = 24  # to either side
_PRECISION = 0.01  # [px], of a rim
_STEEPEST = 1.2  # tangent of the angle between rim and contour above which these don't match
_REACH = 2.0  # [px], between a rim and the contour that is extracted from its silhouette
_STEP = 0.25
_BAND = 7  # [px], about the rims, that smoothing depends on
_MARGIN = 8  # [px], about the rims: their reach, and that of smoothing
_LEAST_COSINE = 0.3  # between rim and contour


class Rims(NamedTuple):
    """Rims on the normals of a contour's samples, for each of S samples.

    ``found`` (S,), the ``offset`` (S,) of the rim outwards from the contour [px], the ``points``
    (S, 3) of the surface in the model's frame before its stretch and their triangles ``face`` (S,).
    """

    found: BoolArray
    offset: FloatArray
    points: FloatArray
    face: IntArray


def find_rims(
    caster: RayCaster, camera: Camera, pose: Alignment, contour: Contour, reach: float
) -> Rims:
    """Find the rims that are nearest to a contour, at most ``reach`` [px] away.

    A rim is a change from the object to the background in the contour's outward direction. Where
    the rim runs at a steep angle to the contour, the two don't match.
    """
    count = len(contour.points)
    intervals = 2 * min(int(np.ceil(reach / _LONGEST_STEP)), _MOST_STEPS)
    steps = np.linspace(-reach, reach, intervals + 1)
    sight = _Sight(caster, camera, pose)
    covered = sight.covered(contour, steps[:, None] + np.zeros(count))
    leaves = covered[:-1] & ~covered[1:]
    middle = (steps[:-1] + steps[1:]) / 2
    distance = np.where(leaves, np.abs(middle)[:, None], np.inf)
    nearest = distance.argmin(axis=0)
    found = np.isfinite(distance[nearest, np.arange(count)])
    rows = np.flatnonzero(found)
    some = contour.taken(rows)
    inner, outer = steps[nearest[rows]], steps[nearest[rows] + 1]
    for _ in range(int(np.ceil(np.log2((steps[1] - steps[0]) / _PRECISION)))):
        half = (inner + outer) / 2
        inside = sight.covered(some, half)
        inner, outer = np.where(inside, half, inner), np.where(inside, outer, half)
    face, points = sight.hits(some, inner)
    hit = face >= 0  # a ray beside the bisection's may slip through
    found[rows[~hit]] = False
    rows = rows[hit]
    offset, surface = np.zeros(count), np.zeros((count, 3))
    faces = np.full(count, -1)
    offset[rows] = ((inner + outer) / 2)[hit]
    surface[rows] = points[hit]
    faces[rows] = face[hit]
    found &= ~_is_steep(contour, found, offset)
    return Rims(found, offset, surface, faces)


class _Sight(NamedTuple):
    """A posed surface as a camera sees it."""

    caster: RayCaster
    camera: Camera
    pose: Alignment

    def covered(self, contour: Contour, places: FloatArray) -> BoolArray:
        """Tell if the object is seen at ``places`` (S,) or (k, S) on the contour's normals."""
        origin, directions, valid = self._directions(contour, places)
        return np.asarray((self.caster.covered(origin, directions) & valid).reshape(places.shape))

    def hits(self, contour: Contour, places: FloatArray) -> tuple[IntArray, FloatArray]:
        """Triangles (S,), -1 for none, and points (S, 3) seen at ``places`` (S,)."""
        origin, directions, valid = self._directions(contour, places)
        face, depth = self.caster.first_hits(origin, directions)
        seen = valid & (face >= 0)
        points = origin + np.where(seen, depth, 0.0)[:, None] * directions
        return np.where(seen, face, -1), points

    def _directions(
        self, contour: Contour, places: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        pixels = contour.points + places[..., None] * contour.normals
        rays, valid = self.camera.normalize_where_valid(pixels.reshape(-1, 2))
        origin, model_from_ray = model_rays(self.pose)
        return origin, rays @ model_from_ray[:, :2].T + model_from_ray[:, 2], valid


def _is_steep(contour: Contour, found: BoolArray, offset: FloatArray) -> BoolArray:
    """True (S,) where the offsets of neighbours differ too much from a sample's own."""
    known = found[1:] & found[:-1] & (contour.curve[1:] == contour.curve[:-1])
    jump = known & (np.abs(np.diff(offset)) > _STEEPEST * SPACING)
    steep = np.zeros(len(found), dtype=bool)
    steep[1:] |= jump
    steep[:-1] |= jump
    return steep


def across_rims(contour: Contour, rims: Rims) -> FloatArray:
    """Directions (S, 2) across the rims, of length 1 along the contour's normals.

    A point of the rim that moves along it does not change the rim's distance from the contour.
    They are the normals where no neighbour has a rim.
    """
    places = contour.points + rims.offset[:, None] * contour.normals
    gaps = np.diff(places, axis=0)
    known = rims.found[1:] & rims.found[:-1] & (contour.curve[1:] == contour.curve[:-1])
    gaps[~known] = 0.0
    along = np.zeros_like(places)
    along[1:] += gaps
    along[:-1] += gaps
    across = np.column_stack([along[:, 1], -along[:, 0]])
    projected = (across * contour.normals).sum(axis=1)
    usable = np.abs(projected) > _LEAST_COSINE * np.linalg.norm(across, axis=1)
    scale = np.where(usable, projected, 1.0)[:, None]
    return np.where(usable[:, None], across / scale, contour.normals)


class MaskImage(NamedTuple):
    """A mask (h, w) of probabilities, and where each sample of its contour lies on it, (S,) [px].

    These ``crossings`` are distances along the samples' normals, NaN where there is none.
    """

    inside: Image
    crossings: FloatArray


def mask_image(mask: FloatArray | BoolArray, contour: Contour) -> MaskImage:
    """A mask with the places of its contour's samples."""
    inside = np.ascontiguousarray(mask, dtype=np.float32)
    return MaskImage(inside, _crossings(smoothed(inside), contour, np.zeros(len(contour.points))))


def extraction_bias(
    caster: RayCaster,
    camera: Camera,
    pose: Alignment,
    mask: MaskImage,
    contour: Contour,
    rims: Rims,
) -> FloatArray:
    """Distances (S,) [px] by which rims lie outside of the contour that extraction makes of them.

    Zero where there is no rim, or no such contour near it.
    """
    rows = np.flatnonzero(rims.found)
    bias = np.zeros(len(rims.found))
    if not len(rows):
        return bias
    some, offsets = contour.taken(rows), rims.offset[rows]
    corner, rendered = _rendered(caster, camera, pose, mask, some, offsets)
    placed = some._replace(points=some.points - corner)
    own = _crossings(smoothed(rendered), placed, offsets) - mask.crossings[rows]
    bias[rows] = np.nan_to_num(offsets - own)
    return np.where(np.abs(bias) < _REACH, bias, 0.0)


def _rendered(
    caster: RayCaster,
    camera: Camera,
    pose: Alignment,
    mask: MaskImage,
    contour: Contour,
    offsets: FloatArray,
) -> tuple[IntArray, Image]:
    """The model's silhouette near its rims, the mask about them; first the corner (2,) of it."""
    height, width = mask.inside.shape
    places = np.rint(contour.points + offsets[:, None] * contour.normals).astype(int)
    places = np.clip(places, 0, [width - 1, height - 1])
    corner = np.maximum(places.min(axis=0) - _MARGIN, 0)
    right, bottom = places.max(axis=0) + _MARGIN + 1
    rendered = mask.inside[corner[1] : bottom, corner[0] : right].copy()
    columns, rows = (places - corner).T
    near = np.zeros(rendered.shape, dtype=np.uint8)
    near[rows, columns] = 1
    near = np.asarray(cv2.dilate(near, np.ones((_BAND, _BAND), np.uint8)), dtype=np.uint8)
    columns, rows = cv2.findNonZero(near).reshape(-1, 2).T  # five times as fast as NumPy
    pixels = np.stack([columns, rows], axis=1) + corner
    rays, valid = camera.normalize_where_valid(pixels.astype(float))
    origin, model_from_ray = model_rays(pose)
    directions = rays @ model_from_ray[:, :2].T + model_from_ray[:, 2]
    rendered[rows, columns] = caster.covered(origin, directions) & valid
    return corner, rendered


def _crossings(level: Image, contour: Contour, offsets: FloatArray) -> FloatArray:
    """Places (S,) on the normals, next to ``offsets`` (S,), where a level line is left; or NaN."""
    steps = np.arange(-_REACH, _REACH + _STEP / 2, _STEP)
    places = offsets + steps[:, None]
    along = contour.points + places[..., None] * contour.normals
    values = sampled(level, along.reshape(-1, 2)).reshape(places.shape)
    falls = (values[:-1] >= 0.5) & (values[1:] < 0.5)
    distance = np.where(falls, np.abs(steps[:-1] + _STEP / 2)[:, None], np.inf)
    nearest = distance.argmin(axis=0)
    every = np.arange(len(offsets))
    before, after = values[nearest, every], values[nearest + 1, every]
    with np.errstate(divide="ignore", invalid="ignore"):
        found = places[nearest, every] + _STEP * (before - 0.5) / (before - after)
    return np.where(np.isfinite(distance[nearest, every]), found, np.nan)
