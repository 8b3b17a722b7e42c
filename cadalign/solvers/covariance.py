"""Covariance of an estimate: the inverse Fisher information (J' W J)^-1 at a pose."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.solvers.constants import UNKNOWNS, UNOBSERVABLE
from cadalign.solvers.evidence import BLOCK
from cadalign.solvers.focal import focal_system
from cadalign.solvers.linalg import cholesky, copy_into, solve_cholesky
from cadalign.solvers.objective import Objective, evaluate, with_points
from cadalign.solvers.unknowns import uncenter


@kernel
def covariance_of(objective: Objective, pose: FloatArray, covariance: FloatArray) -> int:
    """Write the covariance at a pose (15,) into (8, 8), with zeros for fixed unknowns.

    Returns -1, or the number of an unknown that the points do not determine.
    """
    center, unit = center_and_unit(objective.keypoints.points)
    local = with_points(objective, (objective.keypoints.points - center) / unit)
    centered = pose.copy()
    uncenter(centered, -center, 1.0)
    for c in range(3):
        centered[9 + c] /= unit
    undetermined = _invert_information(local, centered, covariance)
    _uncenter_covariance(pose, center, unit, covariance)
    return undetermined


@kernel
def center_and_unit(points: FloatArray) -> tuple[FloatArray, float]:
    """The points' mean, and their root mean square distance from it."""
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
def _invert_information(objective: Objective, pose: FloatArray, covariance: FloatArray) -> int:
    """Write (J' W J)^-1 for centred points; see `covariance_of`."""
    information = np.empty((UNKNOWNS, UNKNOWNS))
    gradient = np.empty(UNKNOWNS)
    rows = np.empty((UNKNOWNS + 1, 2 * BLOCK))
    evaluate(objective, pose, rows, information, gradient)
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
        if objective.free[k] == 0.0:
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
    """Carry the covariance from points (x - center) / unit to points x, at the pose of x.

    With t = unit t' - R S center, an infinitesimal change of the unknowns changes t by
    unit dt' + [R S center]x d(rotation) - sum_k R_k s_k center_k d(log s_k).
    """
    jacobian = np.eye(UNKNOWNS)
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
    product = np.zeros((UNKNOWNS, UNKNOWNS))
    for i in range(UNKNOWNS):
        for j in range(UNKNOWNS):
            for k in range(UNKNOWNS):
                product[i, j] += jacobian[i, k] * covariance[k, j]
    for i in range(UNKNOWNS):
        for j in range(UNKNOWNS):
            total = 0.0
            for k in range(UNKNOWNS):
                total += product[i, k] * jacobian[j, k]
            covariance[i, j] = total


@kernel
def focal_covariance(
    objective: Objective,
    slopes: FloatArray,
    prior_weight: float,
    pose: FloatArray,
    covariance: FloatArray,
) -> int:
    """Write the inverse information of all 9 unknowns, at log_ratio 0, into (9, 9).

    The order is rotation vector, translation, log scales, log focal length. Returns -1, or the
    number of an unknown that the points do not determine.
    """
    given = np.empty((UNKNOWNS, UNKNOWNS))
    covariance[:] = 0.0
    undetermined = covariance_of(objective, pose, given)
    if undetermined >= 0:
        return undetermined
    hessian = np.empty((UNKNOWNS + 1, UNKNOWNS))
    gradient = np.empty(UNKNOWNS)
    own, _ = focal_system(objective, slopes, 1.0, pose, hessian, gradient)
    shift = np.zeros(UNKNOWNS)
    information = own + prior_weight
    for k in range(UNKNOWNS):
        for m in range(UNKNOWNS):
            shift[k] -= given[k, m] * hessian[UNKNOWNS, m]
        information += hessian[UNKNOWNS, k] * shift[k]
    # Where nothing is left, the deviation is as large as rounding errors let it be known.
    variance = 1.0 / max(information, UNOBSERVABLE * (own + prior_weight))
    covariance[UNKNOWNS, UNKNOWNS] = variance
    for k in range(UNKNOWNS):
        covariance[k, UNKNOWNS] = covariance[UNKNOWNS, k] = variance * shift[k]
        for m in range(UNKNOWNS):
            covariance[k, m] = given[k, m] + variance * shift[k] * shift[m]
    return -1
