"""The objective of a fit: the sum of the evidence about an alignment.

To add evidence, write a block as in `cadalign.solvers.evidence`, give `Objective` a field for it,
and add its terms in `evaluate` and `evaluate_cost`; everything else sums them through these two.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.solvers.constants import LINEAR, UNKNOWNS
from cadalign.solvers.evidence import (
    Keypoints,
    ScalePrior,
    add_keypoints,
    add_scale_prior,
    keypoint_cost,
    scale_prior_cost,
)
from cadalign.solvers.unknowns import hold_fixed


class Objective(NamedTuple):
    """Evidence of one problem; ``free`` (8,) is 0 for an unknown that keeps its value, else 1."""

    free: FloatArray
    keypoints: Keypoints
    scale_prior: ScalePrior


def keypoint_objective(points: FloatArray, rays: FloatArray, whitening: FloatArray) -> Objective:
    """The plain objective: keypoints with squared errors, all unknowns free, no prior."""
    points = np.require(points, np.float64, ["C", "W"])
    keypoints = Keypoints(points, rays, whitening, LINEAR, 1.0)
    return Objective(np.ones(UNKNOWNS), keypoints, ScalePrior(0.0))


@kernel
def evaluate(
    objective: Objective,
    pose: FloatArray,
    rows: FloatArray,
    hessian: FloatArray,
    gradient: FloatArray,
) -> float:
    """Build the Gauss-Newton system of all free unknowns at a pose; returns the cost.

    ``rows`` (9, 2 * BLOCK) is scratch space; ``hessian`` (8, 8) and ``gradient`` (8,) receive
    J' W J and J' W r, and unit rows for unknowns that are not free. The cost is infinite if a point
    lies behind the camera.
    """
    hessian[:] = 0.0
    gradient[:] = 0.0
    cost = add_keypoints(objective.keypoints, pose, rows, hessian, gradient)
    if not cost < np.inf:
        return np.inf
    cost += add_scale_prior(objective.scale_prior, pose, hessian, gradient)
    for k in range(UNKNOWNS):
        for m in range(k):
            hessian[k, m] = hessian[m, k]
    hold_fixed(objective.free, hessian, gradient)
    return cost


@kernel
def evaluate_cost(objective: Objective, pose: FloatArray) -> float:
    """The cost of a pose, as `evaluate` returns it, without derivatives."""
    cost = keypoint_cost(objective.keypoints, pose)
    return cost + scale_prior_cost(objective.scale_prior, pose)


@kernel
def with_keypoints(objective: Objective, keypoints: Keypoints) -> Objective:
    """The same objective for other keypoints."""
    return Objective(objective.free, keypoints, objective.scale_prior)


@kernel
def with_points(objective: Objective, points: FloatArray) -> Objective:
    """The same objective for other model points."""
    old = objective.keypoints
    return with_keypoints(
        objective, Keypoints(points, old.rays, old.whitening, old.loss, old.loss_scale)
    )
