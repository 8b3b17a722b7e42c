"""Rims: where the model's silhouette ends on a contour's normals, by ray casting."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.fitting.contours.contour import SPACING, Contour
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.projection import model_rays
from cadalign.geometry.raycaster import RayCaster

_LONGEST_STEP = 1.5  # [px], between rays on a normal: a thinner part may be missed
_MOST_STEPS = 24  # to either side
_PRECISION = 0.01  # [px], of a rim
_STEEPEST = 1.2  # tangent of the angle between rim and contour above which these don't match


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
