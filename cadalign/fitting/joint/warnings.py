"""Warnings about what a joint estimate leaves uncertain, and about evidence that contradicts it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.fitting.uncertainty import WEAK_DISTANCE, WEAK_ROTATION_DEG, WEAK_SCALE
from cadalign.geometry.alignment import Alignment
from cadalign.solvers.joint.evidence import Evidence

_LEAST_PROBABILITY = 0.005  # of residuals as large as these by chance


def warnings_of(
    evidence: Evidence,
    cost: float,
    poses: Sequence[Alignment],
    covariance: FloatArray,
) -> tuple[str, ...]:
    """Warnings about rotation, lengths and distance, and about residuals beyond their sigma."""
    deviations = np.sqrt(np.maximum(covariance.diagonal(), 0.0))
    warnings = []
    rotation = float(np.degrees(np.linalg.norm(deviations[:3])))
    if rotation > WEAK_ROTATION_DEG:
        warnings.append(f"the rotation is known only to +-{rotation:.2g} deg")
    for axis in range(3):
        if deviations[6 + axis] > WEAK_SCALE:
            warnings.append(
                f"the length along {'xyz'[axis]} is known only to "
                f"+-{100 * deviations[6 + axis]:.0f} %"
            )
    distance = float(np.linalg.norm(poses[0].translation))
    spread = float(np.linalg.norm(deviations[3:6]))
    if spread > WEAK_DISTANCE * distance > 0:
        warnings.append(f"the distance is known only to +-{100 * spread / distance:.0f} %")
    misfit = _misfit(evidence, cost)
    if misfit is not None:
        warnings.append(misfit)
    return tuple(warnings)


def _misfit(evidence: Evidence, cost: float) -> str | None:
    """Report residuals that are too large for their standard deviations.

    At the optimum the cost, priors included, is distributed as chi-square: every unknown with a
    prior adds one equation, every other takes one away.
    """
    from scipy.special import chdtrc  # takes longer to import than all that is compiled

    sightings = evidence.sightings
    equations = 2 * len(sightings.point) + int((sightings.depths[:, 1] > 0).sum())
    equations += 2 * len(evidence.directions.weight) + len(evidence.lengths.weight)
    free = int(evidence.scales.free.sum()) - int(np.linalg.matrix_rank(evidence.scales.precision))
    redundancy = equations - 6 * int(evidence.rig.pose.max() + 1) - max(free, 0)
    if redundancy <= 0 or sightings.loss.any():
        return None
    if chdtrc(redundancy, cost) >= _LEAST_PROBABILITY:
        return None
    return (
        f"the residuals are {np.sqrt(cost / redundancy):.2g} times as large as sigma and the "
        "spread of shapes allow: a keypoint, a sigma or the model is wrong"
    )
