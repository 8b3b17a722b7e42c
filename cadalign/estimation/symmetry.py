"""Results in terms of a model's symmetry: one of all equal alignments, and its uncertainty.

A model that a symmetry g takes to itself is placed by A g as by A. A result has the canonical one
of all such alignments (`Symmetry.canonical`), together with the keypoints as that one has
them, g^-1 x: the result is that of keypoints labelled so. To first order, a step (w, dt, ds) of A's
rotation vector in the camera frame, translation and log scales is one of A g by a linear map, which
carries the covariance. How far the object is turned about an axis of the symmetry means nothing:
standard deviations are stated without that step, such that points on the axis keep theirs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import require_kind
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import angles_between, by_rotation, vector_from_rotation
from cadalign.geometry.symmetry import Equal, Symmetry

SAME_SQUARES = 9.0
"""Squared distance of rotations, in the best one's deviations, of equal estimates."""
_SAME_DEG = 0.01  # of rotations where there are no deviations, or they are tiny


def check_symmetry(symmetry: Symmetry) -> None:
    """Raise InputError for what is no symmetry."""
    require_kind(symmetry, Symmetry, "symmetry", fix="see cadalign.Symmetry.from_dict")


def held_axes(stretched: str) -> tuple[bool, bool, bool]:
    """The axes whose scale is held, where the others are estimated."""
    x, y, z = (axis not in stretched for axis in "xyz")
    return x, y, z


def stretched_axes(held: tuple[bool, bool, bool]) -> str:
    """The axes whose scale is estimated, where those of others are held."""
    return "".join(axis for axis, is_held in zip("xyz", held, strict=True) if not is_held)


def remove_free_turns(covariance: FloatArray, best: Equal) -> FloatArray:
    """A covariance of pose and others without turns about the symmetry's axes."""
    size = len(covariance)
    arm, left = best.alignment.linear @ best.center, np.eye(size)
    for axis in best.free:
        direction = best.alignment.rotation @ axis
        turn, share = np.zeros(size), np.zeros(size)
        turn[:3], turn[3:6], share[:3] = direction, -np.cross(direction, arm), direction
        left = (np.eye(size) - np.outer(turn, share)) @ left
    return np.asarray(left @ covariance @ left.T)


def distinct_alignments(
    poses: Sequence[Alignment],
    covariance: FloatArray | None,
    symmetry: Symmetry,
    held: tuple[bool, bool, bool],
) -> list[tuple[int, Equal]]:
    """Canonical alignments with their numbers, without those as near the first as errors."""
    first, *others = enumerate(symmetry.canonical(each, held=held) for each in poses)
    best = first[1].alignment
    information = None
    if covariance is not None:
        information = np.linalg.pinv(covariance[:3, :3], hermitian=True)

    def is_same(other: Alignment) -> bool:
        near = symmetry.canonical(other, reference=best.rotation).alignment
        if angles_between(near.rotation, best.rotation) < _SAME_DEG:
            return True
        step = vector_from_rotation(near.rotation @ best.rotation.T)
        return information is not None and bool(step @ information @ step <= SAME_SQUARES)

    return [first, *(each for each in others if not is_same(each[1].alignment))]


def transform_covariance(
    covariance: FloatArray,
    given: Alignment,
    best: Equal,
    held: tuple[bool, bool, bool] = (False, False, False),
) -> FloatArray:
    """The covariance (9, 9) or (10, 10) of an equal alignment; zero for scales that are held."""
    turn, shift = best.motion[:3, :3], best.motion[:3, 3]
    step = np.eye(len(covariance))
    step[3:6, :3] = by_rotation(given.linear @ shift)
    step[3:6, 6:9] = given.linear * shift
    step[6:9, 6:9] = (turn**2).T
    step[6 + np.flatnonzero(held)] = 0.0
    return np.asarray(step @ covariance @ step.T)
