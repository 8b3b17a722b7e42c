"""Contribution of each piece of evidence to an estimate: the deviations without the piece."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.fitting.joint.deviations import pose_and_lengths
from cadalign.fitting.joint.pieces import pieces_of, without
from cadalign.fitting.joint.single_basis import SingleBasis
from cadalign.fitting.joint.summary import Contribution
from cadalign.fitting.uncertainty import Uncertainty
from cadalign.solvers.joint.evidence import Evidence, State
from cadalign.solvers.joint.system import empty_system, evaluate_joint

_WEAKEST = 1e-12  # share of the information about an unknown that counts as none
_UNKNOWN_ROTATION_DEG = 120.0
_UNKNOWN_SCALE = 5.0


@dataclass(frozen=True, eq=False)
class Basis:
    """The evidence in the form of the kernels, and the state that was estimated from it.

    ``numbers`` are those of its views among all that were given; None where all are used.
    """

    evidence: Evidence
    state: State
    numbers: tuple[int, ...] | None = None


AnyBasis = Basis | SingleBasis
"""What contributions are computed from."""


def contributions_of(basis: AnyBasis) -> tuple[Contribution, ...]:
    """Deviations at the estimate without each piece."""
    found = []
    for piece in pieces_of(basis.evidence):
        rest, state = without(basis.evidence, basis.state, piece)
        view = piece.view
        if view is not None and basis.numbers is not None:
            view = basis.numbers[view]
        found.append(Contribution(piece.kind, view, _deviations(rest, state)))
    return tuple(found)


def _deviations(evidence: Evidence, state: State) -> Uncertainty:
    system = empty_system(evidence)
    evaluate_joint(evidence, state, system)
    sizes = np.sqrt(system.hessian.diagonal())
    sizes[~(sizes > 0)] = _WEAKEST  # nothing is known of it
    scaled = system.hessian / np.outer(sizes, sizes)
    inverse = np.linalg.inv(scaled + _WEAKEST * np.eye(len(sizes)))
    covariance = inverse / np.outer(sizes, sizes)
    first = len(sizes) - len(evidence.shape.modes) - 3
    held = first + np.flatnonzero(evidence.scales.free == 0)
    covariance[held] = covariance[:, held] = 0.0
    of_all = pose_and_lengths(evidence, state, covariance)
    deviations = np.sqrt(np.maximum(of_all.diagonal(), 0.0))
    distance = float(np.linalg.norm(state.poses[evidence.rig.pose[0], 9:]))
    rotation = float(np.degrees(np.linalg.norm(deviations[:3])))
    x, y, z = (_or_infinite(each, _UNKNOWN_SCALE * distance) for each in deviations[3:6])
    sx, sy, sz = (_or_infinite(each, _UNKNOWN_SCALE) for each in deviations[6:])
    return Uncertainty(
        _or_infinite(rotation, _UNKNOWN_ROTATION_DEG), (x, y, z), (sx, sy, sz), focal=0.0
    )


def _or_infinite(deviation: float, limit: float) -> float:
    return float(deviation) if deviation < limit else float("inf")
