"""Covariance of an estimate: the inverse Fisher information (J' W J)^-1 at a pose."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.solvers.alignment import Objective, evaluate_alignment, room_for, with_points
from cadalign.solvers.constants import UNKNOWNS, UNOBSERVABLE
from cadalign.solvers.linalg import cholesky, copy_into, solve_cholesky
from cadalign.solvers.unknowns import uncenter


@kernel
def covariance_of(objective: Objective, pose: FloatArray, covariance: FloatArray) -> int:
    """Write the covariance at a pose (15,) into (8, 8), with zeros for fixed unknowns.

    Returns -1, or the number of an unknown that the points do not determine.
    """
    center, unit = center_and_unit(objective.keypoints.points)
    local = with_points(objective, (objective.keypoints.points - center) / unit)
    equations = room_for(UNKNOWNS)
    evaluate_alignment(local, centered(pose, center, unit), equations)
    undetermined = invert(equations.hessian, objective.free, 0.0, covariance)
    uncenter_covariance(pose, center, unit, covariance)
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
def centered(pose: FloatArray, center: FloatArray, unit: float) -> FloatArray:
    """The pose of points (x - center) / unit, in these units."""
    centered = pose.copy()
    uncenter(centered, -center, 1.0)
    for c in range(3):
        centered[9 + c] /= unit
    return centered


@kernel
def invert(information: FloatArray, free: FloatArray, least: float, covariance: FloatArray) -> int:
    """Write the inverse of an information matrix (U, U), whose factor takes its place.

    An unknown beyond the first 8 has at least the information ``least`` left by the others.
    Returns -1, or the number of an undetermined unknown.
    """
    size = information.shape[0]
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
    for k in range(UNKNOWNS, size):
        total = diagonal[k]
        for m in range(UNKNOWNS):
            for j in range(m):
                information[k, m] -= information[m, j] * information[k, j]
            information[k, m] /= information[m, m]
            total -= information[k, m] ** 2
        information[k, k] = np.sqrt(max(total, least))
    column = np.empty(size)
    for k in range(size):
        if k < UNKNOWNS and free[k] == 0.0:
            continue
        column[:] = 0.0
        column[k] = 1.0
        solve_cholesky(information, size, column)
        copy_into(covariance[:, k], column)
    return -1


@kernel
def uncenter_covariance(
    pose: FloatArray, center: FloatArray, unit: float, covariance: FloatArray
) -> None:
    """Carry the covariance from points (x - center) / unit to points x, at the pose of x.

    With t = unit t' - R S center, an infinitesimal change of the unknowns changes t by
    unit dt' + [R S center]x d(rotation) - sum_k R_k s_k center_k d(log s_k).
    """
    size = covariance.shape[0]
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
