"""The rotations that map a model onto itself, by KeypointNet's annotation and this rule:

- A circle (`RotationalSymmetry.circle`) makes its axis an axis of revolution if every keypoint lies
  on that axis or is on an annotated circle about it. A handle or a spout therefore rules it out.
- Otherwise a rotation about one of the model's coordinate axes, through the mean of the keypoints,
  by 180, 120, 90, 72, 60 or 45 degrees or a multiple of it, is a symmetry if it takes every
  keypoint to an equivalent one or to itself, to within 3 % of the keypoints' extent, and some to
  another.
  Keypoints are equivalent that stand in one annotated rotation, or that a chain of two or more
  annotated reflections joins. The five feet of an office chair make no symmetry of the chair: its
  back is not mapped onto itself.

A reflection alone is no rotation, and an alignment never mirrors a model, so no two alignments
differ by one. Two reflections make a rotation, which the rule finds.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.datasets.models.keypoints import Symmetries
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.geometry.symmetry import Symmetry, SymmetryAxis
from cadalign.geometry.symmetry_group import SymmetryGroup

_TOLERANCE = 0.03  # of the keypoints' extent: how well people place equivalent keypoints
_OF_WAY = 0.2  # the same, of how far the rotation takes a keypoint
_STILL = 1e-12  # square of a way that is none
_FOLDS = (2, 3, 4, 5, 6, 8)
_AXIS_TOLERANCE_DEG = 10.0


def annotated_symmetry(xyz: FloatArray, symmetries: Symmetries) -> Symmetry:
    """The symmetry of a model with the keypoints (k, 3), by the module's rule."""
    group = symmetry_group(xyz, symmetries)
    center, rotations, axis = group.center, group.rotations, group.axis
    motions = np.tile(np.eye(4), (len(rotations) - 1, 1, 1))
    motions[:, :3, :3] = rotations[1:]
    motions[:, :3, 3] = center - rotations[1:] @ center
    return Symmetry(motions, () if axis is None else (SymmetryAxis(axis, center),))


def symmetry_group(xyz: FloatArray, symmetries: Symmetries) -> SymmetryGroup:
    """The rotations that map a model's keypoints (k, 3) onto itself, by the module's rule."""
    trivial = SymmetryGroup(np.zeros(3), np.eye(3)[None])
    if not symmetries.reflections and not symmetries.rotations:
        return trivial
    tolerance = _TOLERANCE * float(np.linalg.norm(np.ptp(xyz, axis=0)))
    revolution = _axis_of_revolution(xyz, symmetries, tolerance)
    if revolution is not None:
        center, axis = revolution
        return SymmetryGroup(center, np.eye(3)[None], axis)
    equivalent = _equivalent(len(xyz), symmetries)
    if equivalent.sum() == len(xyz):  # each to itself alone, as with a single reflection
        return trivial
    center, rotations = xyz.mean(axis=0), _candidates()
    kept = _onto_themselves(xyz - center, equivalent, rotations, tolerance)
    if not kept.any():
        return trivial
    return SymmetryGroup(center, np.concatenate([np.eye(3)[None], rotations[kept]]))


def _onto_themselves(
    points: FloatArray, equivalent: BoolArray, rotations: FloatArray, tolerance: float
) -> BoolArray:
    """Mask (g,) of the rotations (g, 3, 3) that map the centred points (k, 3) onto one another.

    A rotation takes each point to the nearest that is ``equivalent`` (k, k) to it: to within the
    tolerance and, as on a thin model a wrong angle is within that, to within a share of the way
    between the two points. No two points go to the same, and not all stay where they are.
    """
    rows = np.arange(len(points))
    squares = (points**2).sum(axis=1)
    lengths = squares[:, None] + squares
    # Rotations keep lengths: squares of distances follow from products alone.
    gaps = lengths - 2 * (points @ rotations.transpose(0, 2, 1)) @ points.T
    gaps = np.where(equivalent, gaps, np.inf)
    nearest = gaps.argmin(axis=2)
    gap, way = gaps.min(axis=2), (lengths - 2 * points @ points.T)[rows, nearest]
    is_near = (gap <= tolerance**2) & ((gap <= _OF_WAY**2 * way) | (way < _STILL))
    is_reached_once = (np.diff(np.sort(nearest, axis=1), axis=1) > 0).all(axis=1)
    moves = (nearest != rows).any(axis=1)
    return np.asarray(is_near.all(axis=1) & is_reached_once & moves)


def _axis_of_revolution(
    xyz: FloatArray, symmetries: Symmetries, tolerance: float
) -> tuple[FloatArray, FloatArray] | None:
    """A point on the axis and the axis' direction, or None."""
    circles = [(r.keypoints, r.circle) for r in symmetries.rotations if r.circle is not None]
    if not circles:
        return None
    first = circles[0][1].normal
    cosine = np.cos(np.radians(_AXIS_TOLERANCE_DEG))
    same = [(rows, c) for rows, c in circles if abs(float(c.normal @ first)) > cosine]
    mean = np.sum([c.normal * np.sign(c.normal @ first) for _, c in same], axis=0)
    axis = mean / np.linalg.norm(mean)
    nearest = int(np.argmax(np.abs(axis)))
    if abs(axis[nearest]) > cosine:  # ShapeNet's models are turned about their coordinate axes
        axis = np.eye(3)[nearest]
    center = np.mean([c.center for _, c in same], axis=0)

    def distance(points: FloatArray) -> FloatArray:
        offset = points - center
        return np.asarray(np.linalg.norm(offset - np.outer(offset @ axis, axis), axis=-1))

    if (distance(np.array([c.center for _, c in same])) > tolerance).any():
        return None
    on_circle = np.zeros(len(xyz), dtype=bool)
    on_circle[[row for rows, _ in same for row in rows]] = True
    if not (on_circle | (distance(xyz) <= tolerance)).all():
        return None
    return center, axis


def _equivalent(count: int, symmetries: Symmetries) -> BoolArray:
    """Mask (k, k) of the keypoints that a rotation may take to one another."""
    orbits = list(range(count))
    for first, second in symmetries.reflections:
        joined, left = orbits[first], orbits[second]
        orbits = [joined if orbit == left else orbit for orbit in orbits]
    labels = np.array(orbits)
    # A pair that mirrors each other joins with no third keypoint: that is one reflection only.
    equivalent = (labels[:, None] == labels) & (np.bincount(labels, minlength=count)[labels] > 2)
    for rotation in symmetries.rotations:
        rows = np.array(rotation.keypoints, dtype=np.int64)
        equivalent[rows[:, None], rows] = True
    return np.asarray(equivalent | np.eye(count, dtype=bool))


@cache
def _candidates() -> FloatArray:
    """Rotations (g, 3, 3) about the coordinate axes, but for the identity."""
    turns = sorted({k / fold for fold in _FOLDS for k in range(1, fold)})
    return np.array(
        [rotation_from_vector(2 * np.pi * t * axis) for axis in np.eye(3) for t in turns]
    )
