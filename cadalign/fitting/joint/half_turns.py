"""Starts half a turn away, where a flat object's shape leaves open which side is seen.

The mean does not show such an ambiguity: a blade whose width varies more than it measures looks
much the same from behind, with its edge and its back exchanged.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.solvers.joint.evidence import Evidence, Shape

_LEAST_POINTS = 3
_UNLIKELY = 60.0  # squared distance from the mean, in deviations, of a shape that is still a start
_FLATNESS = 0.01  # displacement that no image shows, relative to the extent


def half_turned(evidence: Evidence, view: int, poses: Sequence[FloatArray]) -> list[FloatArray]:
    """Turn poses (12,) of the mean by half a turn, about each axis that its shape allows."""
    sightings = evidence.sightings
    names = np.unique(sightings.point[(sightings.image == view) & (sightings.whitening[:, 2] > 0)])
    if len(names) < _LEAST_POINTS or evidence.scales.free.any():
        return []
    return [_after(pose, turn) for turn in _half_turns(evidence.shape, names) for pose in poses]


def _half_turns(shape: Shape, names: IntArray) -> list[FloatArray]:
    """Motions (12,) of the model by half a turn that leave its points a likely shape."""
    points = shape.mean[names]
    centre = points.mean(axis=0)
    offsets = points - centre
    modes = shape.modes[:, names].reshape(len(shape.modes), offsets.size)
    unseen = _FLATNESS**2 * (offsets**2).sum(axis=1).max()
    own = np.repeat(shape.spread[names] ** 2, 3) + unseen
    largest = float((modes**2).sum(axis=1).max(initial=0.0) + own.max())
    found = []
    for axis in np.linalg.svd(offsets, full_matrices=False)[2]:
        turn = 2 * np.outer(axis, axis) - np.eye(3)
        moved = (offsets @ turn - offsets).ravel()
        # The modes are orthogonal, so that this bounds the distance and spares the next line.
        if not 0 < moved @ moved <= _UNLIKELY * largest:
            continue
        if moved @ np.linalg.solve(modes.T @ modes + np.diag(own), moved) < _UNLIKELY:
            found.append(np.concatenate([turn.ravel(), centre - turn @ centre]))
    return found


def _after(pose: FloatArray, motion: FloatArray) -> FloatArray:
    """The pose (12,) of a model that was moved first."""
    rotation = pose[:9].reshape(3, 3)
    turned = rotation @ motion[:9].reshape(3, 3)
    return np.concatenate([turned.ravel(), rotation @ motion[9:] + pose[9:]])
