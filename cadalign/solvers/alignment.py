"""Pose and stretch (8 unknowns) from the keypoints of one view, and their covariance.

To add evidence, write a block as in `cadalign.solvers.evidence`, give `Objective` a field for it,
and add its terms in `evaluate_alignment` and `evaluate_cost`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import borrow, inline, kernel
from cadalign.solvers.constants import UNKNOWNS, UNOBSERVABLE, ScalePrior
from cadalign.solvers.evidence import (
    BLOCK,
    KeypointEvidence,
    add_keypoints,
    add_scale_prior,
    excess_of,
    keypoint_cost,
)
from cadalign.solvers.linalg import (
    LEAST_INFORMATION,
    cholesky,
    copy_into,
    expected_decrease,
    mirror_upper,
    solve_cholesky,
)
from cadalign.solvers.search import allocate, are_same, cost_at, evaluate, move, score_of, solve
from cadalign.solvers.unknowns import move_pose, uncenter

_SAME_CHORD = 1e-3


class Objective(NamedTuple):
    """Evidence of one problem; ``free`` (8,) is 1 for an estimated unknown, 0 for a fixed one."""

    free: FloatArray
    keypoints: KeypointEvidence
    scale_prior: ScalePrior


class Equations(NamedTuple):
    """Normal equations of U unknowns: ``hessian`` (U, U), ``gradient`` (U,), and scratch space."""

    hessian: FloatArray
    gradient: FloatArray
    rows: FloatArray
    factor: FloatArray


@kernel
def empty_equations(unknowns: int) -> Equations:
    return Equations(
        np.empty((unknowns, unknowns)),
        np.empty(unknowns),
        np.empty((unknowns + 1, 2 * BLOCK)),
        np.empty((unknowns, unknowns)),
    )


@allocate.of(Objective)
@kernel
def _allocate(objective: Objective) -> tuple[Equations, Equations]:
    return empty_equations(UNKNOWNS), empty_equations(UNKNOWNS)


@evaluate.of(Objective)
@borrow
def evaluate_alignment(objective: Objective, pose: FloatArray, equations: Equations) -> float:
    """Write the Gauss-Newton system at a pose (15,), with unit rows for fixed unknowns."""
    hessian, gradient = equations.hessian, equations.gradient
    hessian[:] = 0.0
    gradient[:] = 0.0
    cost = add_keypoints(objective.keypoints, pose, equations.rows, hessian, gradient)
    if not cost < np.inf:
        return np.inf
    cost += add_scale_prior(objective.scale_prior, pose, hessian, gradient)
    mirror_upper(hessian)
    for k in range(UNKNOWNS):
        if objective.free[k] == 0.0:
            gradient[k] = 0.0
            for m in range(UNKNOWNS):
                hessian[k, m] = hessian[m, k] = 0.0
            hessian[k, k] = 1.0
    return cost


@cost_at.of(Objective)
@borrow
def evaluate_cost(objective: Objective, pose: FloatArray) -> float:
    prior = objective.scale_prior
    y, z = excess_of(np.log(pose[13]), prior.width), excess_of(np.log(pose[14]), prior.width)
    return keypoint_cost(objective.keypoints, pose) + float(prior.weight * (y * y + z * z))


@solve.of(Objective)
@inline
def _solve(objective: Objective, equations: Equations, damping: float, step: FloatArray) -> float:
    return solve_damped(equations, UNKNOWNS, damping, step)


@inline
def solve_damped(equations: Equations, unknowns: int, damping: float, step: FloatArray) -> float:
    """Write the damped step; returns the decrease that it predicts, NaN if singular."""
    hessian, gradient, factor = equations.hessian, equations.gradient, equations.factor
    least = 1e-300  # keeps unknowns without evidence at their values
    for k in range(unknowns):
        least = max(least, LEAST_INFORMATION * hessian[k, k])
    for k in range(unknowns):
        step[k] = -gradient[k]
        for m in range(k + 1):
            factor[k, m] = hessian[k, m]
        factor[k, k] += damping * hessian[k, k] + least
    if not cholesky(factor, unknowns, 0.0):
        return np.nan
    solve_cholesky(factor, unknowns, step)
    return expected_decrease(gradient, step, unknowns)


@move.of(Objective)
@inline
def _move(
    objective: Objective,
    pose: FloatArray,
    equations: Equations,
    damping: float,
    step: FloatArray,
    moved: FloatArray,
) -> None:
    move_pose(pose, step, moved)


@score_of.of(Objective)
@inline
def _score_of(objective: Objective, pose: FloatArray, cost: float) -> float:
    return cost


@are_same.of(Objective)
@kernel
def _are_same(objective: Objective, first: FloatArray, second: FloatArray) -> bool:
    square = 0.0
    for i in range(9):
        square += (first[i] - second[i]) ** 2
    for i in range(13, 15):
        square += (np.log(first[i] / second[i])) ** 2
    return square < _SAME_CHORD * _SAME_CHORD


@kernel
def replace_keypoints(objective: Objective, keypoints: KeypointEvidence) -> Objective:
    return Objective(objective.free, keypoints, objective.scale_prior)


@kernel
def replace_points(objective: Objective, points: FloatArray) -> Objective:
    old = objective.keypoints
    return replace_keypoints(
        objective, KeypointEvidence(points, old.rays, old.whitening, old.loss, old.loss_scale)
    )


# Covariance --------------------------------------------------------------------------------------


@kernel
def covariance_of(objective: Objective, pose: FloatArray, covariance: FloatArray) -> int:
    """Write the covariance (8, 8) at a pose (15,); returns an undetermined unknown, or -1."""
    center, unit = center_and_unit(objective.keypoints.points)
    local = replace_points(objective, (objective.keypoints.points - center) / unit)
    equations = empty_equations(UNKNOWNS)
    evaluate_alignment(local, _center(pose, center, unit), equations)
    undetermined = _invert(equations.hessian, objective.free, covariance)
    _uncenter_covariance(pose, center, unit, covariance)
    return undetermined


@kernel
def center_and_unit(points: FloatArray) -> tuple[FloatArray, float]:
    """Mean of the points, and their root mean square distance from it."""
    n = points.shape[0]
    center = np.zeros(3)
    for i in range(n):
        center += points[i]
    center /= n
    spread = 0.0
    for i in range(n):
        for c in range(3):
            spread += (points[i, c] - center[c]) ** 2
    return center, np.sqrt(spread / n)


@kernel
def _center(pose: FloatArray, center: FloatArray, unit: float) -> FloatArray:
    """Convert a pose of points x to one of points (x - center) / unit."""
    centered = pose.copy()
    uncenter(centered, -center, 1.0)
    for c in range(3):
        centered[9 + c] /= unit
    return centered


@kernel
def _invert(information: FloatArray, free: FloatArray, covariance: FloatArray) -> int:
    """Write the inverse of an information matrix (8, 8); same return value as `covariance_of`."""
    diagonal = np.diag(information).copy()
    covariance[:] = 0.0
    if not cholesky(information, UNKNOWNS, UNOBSERVABLE):
        for k in range(UNKNOWNS):
            total = diagonal[k]
            for m in range(k):
                total -= information[k, m] ** 2
            if not total > UNOBSERVABLE * diagonal[k]:
                return k
        return UNKNOWNS - 1
    column = np.empty(UNKNOWNS)
    for k in range(UNKNOWNS):
        if free[k] == 0.0:
            continue
        column[:] = 0.0
        column[k] = 1.0
        solve_cholesky(information, UNKNOWNS, column)
        copy_into(covariance[:, k], column)
    return -1


@kernel
def _uncenter_covariance(
    pose: FloatArray, center: FloatArray, unit: float, covariance: FloatArray
) -> None:
    """Propagate the covariance to points x by the derivatives of t = unit t' - R S center."""
    size = UNKNOWNS
    jacobian = np.eye(size)
    shift = np.zeros(3)
    for c in range(3):
        for j in range(3):
            shift[c] += pose[3 * c + j] * pose[12 + j] * center[j]
        for k in range(2):
            jacobian[3 + c, 6 + k] = -pose[3 * c + k + 1] * pose[13 + k] * center[k + 1]
        jacobian[3 + c, 3 + c] = unit
    jacobian[3, 1], jacobian[3, 2] = -shift[2], shift[1]
    jacobian[4, 0], jacobian[4, 2] = shift[2], -shift[0]
    jacobian[5, 0], jacobian[5, 1] = -shift[1], shift[0]
    product = np.zeros((size, size))
    for i in range(size):
        for j in range(size):
            for k in range(size):
                product[i, j] += jacobian[i, k] * covariance[k, j]
    for i in range(size):
        for j in range(size):
            total = 0.0
            for k in range(size):
                total += product[i, k] * jacobian[j, k]
            covariance[i, j] = total
