"""The Cramer-Rao bound of an instance of `align`, computed at the truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cadalign import Alignment
from cadalign.estimation.estimates import pose_and_lengths
from cadalign.estimation.result import Result
from cadalign.geometry.rotations import vector_from_rotation
from cadalign.solvers.joint.covariance import joint_covariance
from cadalign.solvers.joint.evidence import State


def bound_of(result: Result, truths: Sequence[Alignment]) -> np.ndarray:
    """Covariance (9, 9) of pose in the first camera and log lengths, at the true poses.

    ``truths`` are in the frame of each pose: the rig's, or each view's camera.
    """
    basis = result.statistics.basis
    assert basis is not None
    poses = [np.concatenate([each.rotation.ravel(), each.translation]) for each in truths]
    true_state = State(
        np.array(poses),
        np.log(truths[0].scale),
        np.zeros_like(basis.state.coefficients),
        np.zeros_like(basis.state.displacements),
    )
    unknowns = joint_covariance(basis.evidence, true_state)[0]
    return pose_and_lengths(basis.evidence, true_state, unknowns)


def whitened_square(result: Result, truths: Sequence[Alignment]) -> float:
    """Square of the error over the bound, divided by its number of unknowns: 1 on average."""
    bound = bound_of(result, truths)
    turn = vector_from_rotation(result.alignment.rotation @ truths[0].rotation.T)
    shift = result.alignment.translation - truths[0].translation
    error = np.concatenate([turn, shift, np.log(result.alignment.scale / truths[0].scale)])
    free = bound.diagonal() > 0
    error, bound = error[free], bound[np.ix_(free, free)]
    return float(error @ np.linalg.solve(bound, error)) / int(free.sum())
