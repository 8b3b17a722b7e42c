"""Warnings about what a joint estimate leaves uncertain, and about evidence that contradicts it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.fitting.joint.contradictions import contradictions, count_equations
from cadalign.fitting.joint.robust import state_of
from cadalign.fitting.joint.starts import starts_of
from cadalign.fitting.uncertainty import WEAK_DISTANCE, WEAK_ROTATION_DEG, WEAK_SCALE
from cadalign.geometry.alignment import Alignment
from cadalign.solvers.joint.evidence import Evidence, State
from cadalign.solvers.joint.search import search_joint

_WRONG_UNIT = 100.0  # size over the model's, where nothing but depths tells it
_LEAST_PROBABILITY = 0.005  # of residuals as large as these by chance


def warnings_of(
    evidence: Evidence,
    state: State,
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
    if _is_sized_by_depth_alone(evidence):
        size = float(np.exp(state.log_scales.mean()))
        if not 1 / _WRONG_UNIT < size < _WRONG_UNIT:
            warnings.append(
                f"the object is {size:.2g} times as large as the model: are the depths in "
                "another unit (millimetres for metres)?"
            )
    contradicting = contradictions(evidence, state, cost, _searched)
    warnings.extend(contradicting)
    misfit = None if contradicting else _misfit(evidence, cost)
    if misfit is not None:
        warnings.append(misfit)
    return tuple(warnings)


def _is_sized_by_depth_alone(evidence: Evidence) -> bool:
    has_depth = len(evidence.planes.point) or (evidence.sightings.depths[:, 1] > 0).any()
    others = len(evidence.lengths.value) + len(evidence.heights.value)
    is_rig = (np.bincount(evidence.rig.pose) > 1).any()
    return bool(has_depth and not others and not is_rig)


def _searched(evidence: Evidence) -> tuple[State, float] | None:
    """The best estimate of the evidence, and its cost."""
    poses, log_scales = starts_of(evidence)
    if not len(poses):
        return None
    minima, count, _ = search_joint(evidence, poses, log_scales)
    if not count:
        return None
    best = int(np.argmin(minima.costs[:count]))
    return state_of(minima, best), float(minima.costs[best])


def _misfit(evidence: Evidence, cost: float) -> str | None:
    """Report residuals that are too large for their standard deviations.

    At the optimum the cost, priors included, is distributed as chi-square: every unknown with a
    prior adds one equation, every other takes one away.
    """
    from scipy.special import chdtrc  # takes longer to import than all that is compiled

    redundancy = count_equations(evidence) - len(evidence.shape.modes)
    redundancy -= 6 * int(evidence.rig.pose.max() + 1) + int(evidence.scales.free.sum())
    if redundancy <= 0 or evidence.sightings.loss.any() or evidence.planes.loss.any():
        return None
    if chdtrc(redundancy, cost) >= _LEAST_PROBABILITY:
        return None
    return (
        f"the residuals are {np.sqrt(cost / redundancy):.2g} times as large as sigma and the "
        "spread of shapes allow: a keypoint, a sigma or the model is wrong"
    )
