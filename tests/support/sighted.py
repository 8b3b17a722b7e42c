"""Evidence of the joint system that is nothing but the keypoints of one view."""

from __future__ import annotations

import numpy as np

from cadalign.solvers.constants import ScalePrior
from cadalign.solvers.joint.evidence import (
    Directions,
    Evidence,
    Focals,
    Offsets,
    Rig,
    ScalePriors,
    Shape,
    Sightings,
)

_NONE, _NO_VALUE = np.empty(0, dtype=np.int64), np.empty(0)
KNOWN_FOCAL = Focals(np.full(1, -1), _NO_VALUE, _NO_VALUE, _NO_VALUE, _NO_VALUE)


def sighted_evidence(shape: Shape, rays: np.ndarray, focals: Focals = KNOWN_FOCAL) -> Evidence:
    """The first points of a shape of known scale, seen by rays (n, 2) of 1 mrad of noise."""
    count = len(rays)
    sightings = Sightings(
        np.arange(count),
        np.zeros(count, dtype=np.int64),
        rays,
        np.tile([1000.0, 0.0, 1000.0], (count, 1)),
        np.zeros((count, 3)),
        np.zeros(count, dtype=np.int64),
        np.ones(count),
    )
    blocks = (
        Directions(np.empty((0, 3)), np.empty((0, 3)), _NONE, np.empty((0, 3, 3))),
        Offsets(_NONE.reshape(0, 2), _NONE, np.empty((0, 3)), _NO_VALUE, _NO_VALUE),
    )
    return Evidence(
        shape,
        sightings,
        Rig(np.append(np.eye(3), np.zeros(3))[None], np.zeros(1, dtype=np.int64), np.eye(3)[2:]),
        focals,
        ScalePriors(np.zeros(3), np.zeros((3, 3)), ScalePrior(0.0, 0.0)),
        blocks,
    )
