"""Rotations that map a model onto itself, and the truth nearest to an estimate under them.

An estimate that is off by such a rotation shows the same object in the same place: that is no
error. What a model's symmetries are follows from KeypointNet's annotation, by this rule:

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

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import rotation_from_vector

if TYPE_CHECKING:
    from cadalign.datasets.models.keypoints import Symmetries

_TOLERANCE = 0.03  # of the keypoints' extent: how well people place equivalent keypoints
_OF_WAY = 0.2  # the same, of how far the rotation takes a keypoint
_FOLDS = (2, 3, 4, 5, 6, 8)
_AXIS_TOLERANCE_DEG = 10.0


@dataclass(frozen=True, eq=False)
class SymmetryGroup:
    """Rotations about one point that map an object onto itself.

    Parameters
    ----------
    center : (3,) float
        The point [model units].
    rotations : (g, 3, 3) float
        Single rotations; the first is the identity.
    axis : (3,) float, optional
        Any rotation about this axis, of length 1, through the point is a symmetry as well.
    """

    center: FloatArray
    rotations: FloatArray
    axis: FloatArray | None = None

    @property
    def is_trivial(self) -> bool:
        """True where the identity is the only symmetry."""
        return self.axis is None and len(self.rotations) == 1

    def __str__(self) -> str:
        if self.axis is not None:
            return "circle"
        return "none" if self.is_trivial else f"{len(self.rotations)} rotations"

    def nearest_truth(self, *, est: Alignment, gt: Alignment) -> Alignment:
        """The truth, among those that look the same, whose rotation is nearest to the estimate's.

        The symmetries are the object's, so they act on the model after the stretch that makes the
        object of it: x -> R (c + G (S x - c)) + t with the truth's R, S, t. That is again an
        alignment, of the rotation R G and the same scale S, which is why a stretched model's
        truth may be turned without shearing it. An estimate that looks like the truth has zero
        error; one with wrong scales about a right axis keeps the error of its scales.

        The best angle about an axis a follows in closed form: with N = G' R_gt' R_est the trace
        of Rot(a, angle)' N is A cos(angle) + B sin(angle) + a'N a, where A = tr N - a'N a and
        B = a . (N_32 - N_23, N_13 - N_31, N_21 - N_12).
        """
        if self.is_trivial:
            return gt
        relative = gt.rotation.T @ est.rotation
        candidates = [self._turned(rotation, relative) for rotation in self.rotations]
        traces = [float(np.sum(candidate * relative)) for candidate in candidates]
        best = candidates[int(np.argmax(traces))]
        return Alignment(
            gt.rotation @ best,
            gt.translation + gt.rotation @ (self.center - best @ self.center),
            gt.scale,
            is_valid=True,
        )

    def _turned(self, rotation: FloatArray, relative: FloatArray) -> FloatArray:
        """The rotation, turned about the axis as near as possible to ``relative``."""
        if self.axis is None:
            return rotation
        n = rotation.T @ relative
        along = float(self.axis @ n @ self.axis)
        turn = np.array([n[2, 1] - n[1, 2], n[0, 2] - n[2, 0], n[1, 0] - n[0, 1]])
        angle = np.arctan2(float(self.axis @ turn), float(np.trace(n)) - along)
        return np.asarray(rotation @ rotation_from_vector(self.axis * float(angle)))


def symmetry_group(xyz: FloatArray, symmetries: Symmetries) -> SymmetryGroup:
    """Find the rotations that map a model's keypoints (k, 3) onto itself, by the module's rule."""
    trivial = SymmetryGroup(np.zeros(3), np.eye(3)[None])
    if not symmetries.reflections and not symmetries.rotations:
        return trivial
    tolerance = _TOLERANCE * float(np.linalg.norm(np.ptp(xyz, axis=0)))
    revolution = _axis_of_revolution(xyz, symmetries, tolerance)
    if revolution is not None:
        center, axis = revolution
        return SymmetryGroup(center, np.eye(3)[None], axis)
    center = xyz.mean(axis=0)
    kept = _map_onto_themselves(xyz - center, _equivalent(len(xyz), symmetries), tolerance)
    if not kept.any():
        return trivial
    return SymmetryGroup(center, np.concatenate([np.eye(3)[None], _candidates()[kept]]))


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


def _equivalent(count: int, symmetries: Symmetries) -> npt.NDArray[np.bool_]:
    """Mask (k, k) of the keypoints that a rotation may take to one another."""
    orbits = np.arange(count)
    for first, second in symmetries.reflections:
        orbits[orbits == orbits[second]] = orbits[first]
    # A pair that mirrors each other joins with no third keypoint: that is one reflection only.
    equivalent = (orbits[:, None] == orbits) & (np.bincount(orbits, minlength=count)[orbits] > 2)
    for rotation in symmetries.rotations:
        equivalent[np.ix_(rotation.keypoints, rotation.keypoints)] = True
    return np.asarray(equivalent | np.eye(count, dtype=bool))


@cache
def _candidates() -> FloatArray:
    """Rotations (g, 3, 3) about the coordinate axes, but for the identity."""
    turns = sorted({k / fold for fold in _FOLDS for k in range(1, fold)})
    return np.array(
        [rotation_from_vector(2 * np.pi * t * axis) for axis in np.eye(3) for t in turns]
    )


def _map_onto_themselves(
    centered: FloatArray, equivalent: npt.NDArray[np.bool_], tolerance: float
) -> npt.NDArray[np.bool_]:
    """Mask (g,) of the candidates that are symmetries."""
    count = len(centered)
    moved = centered @ _candidates().transpose(0, 2, 1)
    squares = (centered**2).sum(axis=1)
    # |moved - centered|^2; rotations keep lengths
    gaps = squares[:, None] + squares - 2 * moved @ centered.T
    gaps[:, ~equivalent] = np.inf
    targets = gaps.argmin(axis=2)
    reached = np.take_along_axis(gaps, targets[:, :, None], axis=2)[:, :, 0]
    one_to_one = (np.sort(targets, axis=1) == np.arange(count)).all(axis=1)
    moving = (targets != np.arange(count)).any(axis=1)
    # On a thin model a wrong angle, too, stays within the tolerance, which is of its length.
    way = squares + squares[targets] - 2 * (centered @ centered.T)[np.arange(count), targets]
    fine = (reached <= tolerance**2) & ((reached <= _OF_WAY**2 * way) | (way < 1e-12))
    return np.asarray(fine.all(axis=1) & one_to_one & moving)
