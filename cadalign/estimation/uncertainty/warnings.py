"""Warnings about what a joint estimate leaves uncertain, and about evidence that contradicts it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.starts import starts_of
from cadalign.estimation.uncertainty.contradictions import contradictions, count_equations
from cadalign.estimation.uncertainty.evidence import depth_factor, pieces_of
from cadalign.estimation.uncertainty.summary import name_of
from cadalign.estimation.uncertainty.weakness import (
    WEAK_DISTANCE,
    WEAK_ROTATION_DEG,
    WEAK_SCALE,
    percent,
)
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.metrics import rotation_error
from cadalign.solvers.joint.evidence import Evidence, State
from cadalign.solvers.joint.search import search_joint

if TYPE_CHECKING:
    from cadalign.estimation.result_parts import Alternative

_WRONG_UNIT = 100.0  # factor of depths, or of the size that they give the object
_LIKELY = 0.1  # probability of an alternative that is worth a warning
_LEAST_PROBABILITY = 0.005  # of residuals as large as these by chance


def warnings_of(
    evidence: Evidence,
    state: State,
    cost: float,
    poses: Sequence[Alignment],
    covariance: FloatArray,
) -> tuple[str, ...]:
    """Warnings about rotation, lengths and distance, and about residuals beyond their sigma."""
    warnings = weaknesses(poses[0], covariance)
    contradicting = contradictions(evidence, state, cost, _searched)
    warnings.extend(_wrong_units(evidence, state, contradicting))
    warnings.extend(contradicting)
    if not contradicting and not evidence.sightings.loss.any() and not evidence.planes.loss.any():
        redundancy = count_equations(evidence) - len(evidence.shape.modes)
        redundancy -= 6 * int(evidence.rig.pose.max() + 1) + int(evidence.scales.free.sum())
        warnings.extend(misfits(cost, redundancy))
    return tuple(warnings)


def weaknesses(pose: Alignment, covariance: FloatArray) -> list[str]:
    """Warnings about a rotation, lengths and a distance that are known badly."""
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
    distance = float(np.linalg.norm(pose.translation))
    spread = float(np.linalg.norm(deviations[3:6]))
    if spread > WEAK_DISTANCE * distance > 0:
        warnings.append(f"the distance is known only to +-{100 * spread / distance:.0f} %")
    if len(deviations) > 9 and deviations[9] > WEAK_SCALE:
        warnings.append(f"the focal length is known only to +-{percent(deviations[9])}")
    return warnings


def another_pose(best: Alignment, others: Sequence[Alternative]) -> tuple[str, ...]:
    """Warning about the likeliest alternative, if it has a share of the probability."""
    if not others:
        return ()
    first = max(others, key=lambda each: each.relative_likelihood)
    share = first.relative_likelihood / (1 + sum(each.relative_likelihood for each in others))
    angle = rotation_error(est=first.alignment, gt=best)
    if share < _LIKELY or angle < WEAK_ROTATION_DEG:
        return ()
    return (
        f"another pose, {angle:.0f} deg away, has a probability of {100 * share:.0f} %: "
        "see `alternatives`",
    )


def _wrong_units(evidence: Evidence, state: State, contradicting: Sequence[str]) -> Iterator[str]:
    """Warnings about depths in another unit than the model and the rest of the evidence.

    The estimate may follow the depths, which then makes the object too large, or leave them out.
    """
    size = float(np.exp(state.log_scales.mean()))
    is_told = not _is_plausible(size) and (contradicting or _is_sized_by_depth_alone(evidence))
    ask = "are the depths in another unit (millimetres for metres)?"
    for piece in pieces_of(evidence):
        name = name_of(*piece)
        if piece.kind != "depth" or any(name in text for text in contradicting):
            continue
        factor = depth_factor(evidence, state, cast(int, piece.view))
        if not _is_plausible(factor):
            yield f"{name}: the depths are {factor:.2g} times what is expected: {ask}"
        elif is_told:
            yield f"{name}: the object is {size:.2g} times as large as the model: {ask}"


def _is_plausible(factor: float) -> bool:
    return 1 / _WRONG_UNIT < factor < _WRONG_UNIT


def _is_sized_by_depth_alone(evidence: Evidence) -> bool:
    has_depth = len(evidence.planes.point) or (evidence.sightings.depths[:, 1] > 0).any()
    others = len(evidence.lengths.value) + len(evidence.heights.value)
    is_rig = (np.bincount(evidence.rig.pose) > 1).any()
    return bool(has_depth and not others and not is_rig)


def _searched(evidence: Evidence) -> tuple[State, float] | None:
    """The best estimate of the evidence, and its cost."""
    starts = starts_of(evidence)
    if not len(starts.poses):
        return None
    minima, _ = search_joint(evidence, *starts)
    if not minima.states:
        return None
    best = int(np.argmin(minima.costs))
    return minima.states[best], float(minima.costs[best])


def misfits(cost: float, redundancy: int) -> list[str]:
    """Report residuals that are too large for their standard deviations.

    At the optimum the cost, priors included, is distributed as chi-square: every unknown with a
    prior adds one equation, every other takes one away.
    """
    from scipy.special import chdtrc  # takes longer to import than all that is compiled

    if redundancy <= 0 or chdtrc(redundancy, cost) >= _LEAST_PROBABILITY:
        return []
    return [
        f"the residuals are {np.sqrt(cost / redundancy):.2g} times as large as sigma and the "
        "spread of shapes allow: a keypoint, a sigma or the model is wrong"
    ]
