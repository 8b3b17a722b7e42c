"""The Cramer-Rao bound of an instance of `align`, computed at the truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cadalign import Alignment, Model, Size, View
from cadalign.estimation.estimates import mean_state, pose_and_lengths
from cadalign.estimation.options import FitOptions
from cadalign.estimation.pack import evidence_of
from cadalign.estimation.prior import Lenses, ShapePrior, prior_of
from cadalign.geometry.rotations import vector_from_rotation
from cadalign.solvers.joint.covariance import joint_covariance, pose_and_border
from cadalign.solvers.joint.evidence import Evidence


def plain_evidence(prior: ShapePrior, views: Sequence[View], size: Size | None = None) -> Evidence:
    """Evidence about the first component, of cameras that are known and not turned."""
    return evidence_of(
        prior,
        prior.components[0],
        views,
        size,
        options=FitOptions(),
        lenses=Lenses.of(views, "known", None),
        turns=[np.eye(3)] * len(views),
        noise=1.0,
    )


def bound_of(
    model: Model, views: Sequence[View], size: Size | None, truths: Sequence[Alignment]
) -> np.ndarray:
    """Covariance (9, 9) of pose in the first camera and log lengths, at the true poses.

    ``truths`` are in the frame of each pose: the rig's, or each view's camera.
    """
    evidence = plain_evidence(prior_of(model), views, size)
    poses = np.array([each.packed[:12] for each in truths])
    state = mean_state(evidence, poses, np.log(truths[0].scale))
    unknowns = pose_and_border(joint_covariance(evidence, state), 0)
    return pose_and_lengths(evidence, state, unknowns)


def whitened_square(found: Alignment, truth: Alignment, bound: np.ndarray) -> float:
    """Square of the error over the bound, divided by its number of unknowns: 1 on average."""
    turn = vector_from_rotation(found.rotation @ truth.rotation.T)
    shift = found.translation - truth.translation
    error = np.concatenate([turn, shift, np.log(found.scale / truth.scale)])
    free = bound.diagonal() > 0
    error, bound = error[free], bound[np.ix_(free, free)]
    return float(error @ np.linalg.solve(bound, error)) / int(free.sum())
