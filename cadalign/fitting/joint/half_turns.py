"""Starts half a turn away, where a flat object's shape leaves open which side is seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.solvers.joint.evidence import Evidence
from cadalign.solvers.marginal.problem import Target
from cadalign.solvers.marginal.starts import after_motion, half_turns

_LEAST_POINTS = 3


def half_turned(evidence: Evidence, view: int, poses: Sequence[FloatArray]) -> list[FloatArray]:
    """Turn poses (12,) of the mean by half a turn, about each axis that its shape allows."""
    sightings, shape = evidence.sightings, evidence.shape
    names = np.unique(sightings.point[(sightings.image == view) & (sightings.whitening[:, 2] > 0)])
    if len(names) < _LEAST_POINTS or evidence.scales.free.any():
        return []
    modes = shape.modes[:, names].reshape(len(shape.modes), 3 * len(names))
    covariance = modes.T @ modes + np.diag(np.repeat(shape.spread[names] ** 2, 3))
    motions = half_turns(Target(shape.mean[names], covariance))
    return [after_motion(pose, motion) for motion in motions for pose in poses]
