"""Canonical alignments of symmetric models, and their uncertainty.

If a symmetry g maps the model to itself, the alignments A and A g are equivalent. A result has the
canonical one (`Symmetry.canonical`), with the keypoints g^-1 x. To first order, a step (w, dt, ds)
of A's rotation vector in the camera frame, translation and log scales is a linear function of the
step of A g, which transforms the covariance. Turns about an axis of continuous symmetry have no
meaning: they are removed from the covariance, which does not change it for points on the axis.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import angles_between, by_rotation, vector_from_rotation
from cadalign.geometry.symmetry import Equal, Symmetry

SAME_SQUARES = 9.0
"""Largest squared distance [sigma^2] between rotations of equal estimates."""
_SAME_DEG = 0.01  # between equal rotations, without or with tiny deviations


def held_axes(stretched: str) -> tuple[bool, bool, bool]:
    """True for each axis with a fixed scale."""
    x, y, z = (axis not in stretched for axis in "xyz")
    return x, y, z


def stretched_axes(held: tuple[bool, bool, bool]) -> str:
    """Names of the axes whose scale is not ``held``."""
    return "".join(axis for axis, is_held in zip("xyz", held, strict=True) if not is_held)


def remove_free_turns(covariance: FloatArray, best: Equal) -> FloatArray:
    """Remove turns about axes of continuous symmetry from a covariance."""
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
    """Canonical alignments with their indices, without those within errors of the first."""
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
    """The covariance (9, 9) or (10, 10) of an equal alignment; zero for ``held`` scales."""
    turn, shift = best.motion[:3, :3], best.motion[:3, 3]
    step = np.eye(len(covariance))
    step[3:6, :3] = by_rotation(given.linear @ shift)
    step[3:6, 6:9] = given.linear * shift
    step[6:9, 6:9] = (turn**2).T
    step[6 + np.flatnonzero(held)] = 0.0
    return np.asarray(step @ covariance @ step.T)
