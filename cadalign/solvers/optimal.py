"""The optimum: the maximum-likelihood alignment, searched for globally."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.solvers.constants import POSE_SIZE, UNKNOWNS
from cadalign.solvers.linalg import cholesky, polish_rotation, solve_cholesky
from cadalign.solvers.minimal import MAX_SOLUTIONS
from cadalign.solvers.objective import BLOCK, Objective, evaluate, evaluate_cost
from cadalign.solvers.refine import refine
from cadalign.solvers.starts import (
    choose_subsets,
    linear_start,
    minimal_starts,
    rotation_starts,
)

MAX_MINIMA = 12
_COARSE_POINTS = 48  # that many tell the minima apart; all points then refine them
_GRID_ROTATIONS = 96
_GRID_REFINED = 20
_PROBE_ITERATIONS = 6
_MAX_ITERATIONS = 200
_SAME_CHORD = 1e-3
_LARGEST_STRETCH = 1e3
_UNLIKELY = 40.0  # excess cost, over a unit variance, at which a coarse minimum is given up
_UNOBSERVABLE = 1e-11  # share of an unknown's information that the other unknowns leave


@kernel
def optimal_kernel(
    objective: Objective, poses: FloatArray, costs: FloatArray, covariance: FloatArray
) -> tuple[int, int, int, int]:
    """Find the minima of the whitened reprojection error, the best first.

    Parameters
    ----------
    objective : Objective
    poses, costs : (MAX_MINIMA, 15), (MAX_MINIMA,) float
        Receive the minima.
    covariance : (8, 8) float
        Receives the covariance of the best: rotation vector [rad], translation, log scales.

    Returns
    -------
    minima, iterations, hypotheses : int
        How many minima were found, in how many refinement steps, from how many starts.
    undetermined : int
        -1, or the number of an unknown that the points do not determine.
    """
    center, unit = _center_and_unit(objective.points)
    if not unit > 0:
        return 0, 0, 0, 0
    local = _with_points(objective, (objective.points - center) / unit)
    minima, iterations, hypotheses = _search(local, poses, costs)
    if minima == 0:
        return 0, iterations, hypotheses, -1
    for k in range(minima):
        orthonormalize(poses[k])
        uncenter(poses[k], center, unit)
    return minima, iterations, hypotheses, covariance_of(objective, poses[0], covariance)


@kernel
def covariance_of(objective: Objective, pose: FloatArray, covariance: FloatArray) -> int:
    """Write (J' W J)^-1 at a pose (15,) into (8, 8), with zeros for fixed unknowns.

    Returns -1, or the number of an unknown that the points do not determine.
    """
    center, unit = _center_and_unit(objective.points)
    local = _with_points(objective, (objective.points - center) / unit)
    centered = pose.copy()
    uncenter(centered, -center, 1.0)
    for c in range(3):
        centered[9 + c] /= unit
    undetermined = _invert_information(local, centered, covariance)
    _uncenter_covariance(pose, center, unit, covariance)
    return undetermined


@kernel
def _center_and_unit(points: FloatArray) -> tuple[FloatArray, float]:
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
def _with_points(objective: Objective, points: FloatArray) -> Objective:
    """The same objective for other model points."""
    return Objective(
        points,
        objective.rays,
        objective.whitening,
        objective.loss,
        objective.loss_scale,
        objective.prior_weight,
        objective.free,
    )


@kernel
def _some_points(objective: Objective, count: int) -> Objective:
    """The objective of ``count`` of the points, evenly spread over their order."""
    n = objective.points.shape[0]
    each = objective.whitening.shape[0] > 1
    points = np.empty((count, 3))
    rays = np.empty((count, 2))
    whitening = np.empty((count if each else 1, 3))
    whitening[0] = objective.whitening[0]
    for k in range(count):
        i = k * n // count
        points[k] = objective.points[i]
        rays[k] = objective.rays[i]
        if each:
            whitening[k] = objective.whitening[i]
    return Objective(
        points,
        rays,
        whitening,
        objective.loss,
        objective.loss_scale,
        objective.prior_weight,
        objective.free,
    )


@kernel
def _search(objective: Objective, poses: FloatArray, costs: FloatArray) -> tuple[int, int, int]:
    """Find the minima; returns how many, and the iterations and hypotheses it took.

    Where there are many points the search runs on some of them, and what it finds is refined on
    all.
    """
    linear = np.empty(POSE_SIZE)
    is_solved = linear_start(objective.points, objective.rays, linear)
    few = objective.points.shape[0] <= _COARSE_POINTS
    coarse = objective if few else _some_points(objective, _COARSE_POINTS)
    found, iterations, hypotheses = _search_from_all_starts(coarse, linear, is_solved, poses, costs)
    if few:
        return found, iterations, hypotheses
    candidates = np.empty((found + 1, POSE_SIZE))
    count = 0
    # A wrong sigma should not make every coarse minimum look unlikely.
    variance = max(1.0, costs[0] / (2.0 * _COARSE_POINTS - UNKNOWNS)) if found > 0 else 1.0
    while count < found and costs[count] - costs[0] < _UNLIKELY * variance:
        candidates[count] = poses[count]
        count += 1
    candidates[count] = linear  # with strong noise, some of the points may have no minimum
    minima = 0
    for k in range(count + 1):
        if k < count or (minima == 0 and is_solved):
            minima, used = _descend(objective, candidates[k], poses, costs, minima)
            iterations += used
    return minima, iterations, hypotheses


@kernel
def _search_from_all_starts(
    objective: Objective,
    linear: FloatArray,
    is_solved: bool,
    poses: FloatArray,
    costs: FloatArray,
) -> tuple[int, int, int]:
    """Refine the most promising of all starts; returns minima, iterations, hypotheses.

    ``linear`` is the linear solver's pose, where it has one.
    """
    points, rays, free = objective.points, objective.rays, objective.free
    subset_count, refined = _effort(points.shape[0])
    starts = np.empty((subset_count * MAX_SOLUTIONS + 1 + _GRID_ROTATIONS, POSE_SIZE))
    count = 0
    if points.shape[0] >= 4:
        subsets = np.empty((subset_count, 4), dtype=np.int64)
        chosen = choose_subsets(points, subsets)
        count = minimal_starts(points, rays, subsets, chosen, starts)
    if is_solved:
        starts[count] = linear
        count += 1
    # Other starts serve coplanar points, and where the unstretched model is a better guess.
    needs_grid = free[6] == 0.0 or free[7] == 0.0 or objective.prior_weight > 0.0
    minima = 0
    iterations = 0
    for attempt in range(2):
        if minima > 0 or (attempt == 0 and needs_grid):
            continue
        if attempt == 1:
            count += rotation_starts(points, rays, starts[count : count + _GRID_ROTATIONS])
            refined = _GRID_REFINED
        minima, used = _descend_best(objective, starts[:count], refined, poses, costs)
        iterations += used
    return minima, iterations, count


@kernel
def _effort(points: int) -> tuple[int, int]:
    """How many 4-subsets to solve and how many starts to refine.

    Measured on random problems: the optimum is missed in less than 0.1 % of them.
    """
    if points < 8:
        return 35, 12
    if points < 9:
        return 12, 10
    if points < 10:
        return 8, 8
    if points < 17:
        return 5, 6
    return 3, 3


@kernel
def _descend_best(
    objective: Objective, starts: FloatArray, refined: int, poses: FloatArray, costs: FloatArray
) -> tuple[int, int]:
    """Refine the starts of the lowest cost; returns the number of minima and of iterations."""
    count = starts.shape[0]
    scores = np.empty(count)
    for k in range(count):
        for j in range(2):
            if objective.free[6 + j] == 0.0:
                starts[k, 13 + j] = 1.0
        scores[k] = evaluate_cost(objective, starts[k])
    minima = 0
    iterations = 0
    for _ in range(min(refined, count)):
        best = 0
        for k in range(1, count):
            if scores[k] < scores[best]:
                best = k
        if not scores[best] < np.inf:
            break
        scores[best] = np.inf
        minima, used = _descend(objective, starts[best].copy(), poses, costs, minima)
        iterations += used
    return minima, iterations


@kernel
def _descend(
    objective: Objective, pose: FloatArray, poses: FloatArray, costs: FloatArray, minima: int
) -> tuple[int, int]:
    """Refine one start and insert its minimum, if it is new, by cost.

    Returns the new number of minima and the iterations used.
    """
    iterations = 0
    cost = np.inf
    for stage in range(2):  # a few steps tell whether it goes where another start went
        cost, used, converged = refine(
            objective, _PROBE_ITERATIONS if stage == 0 else _MAX_ITERATIONS, pose
        )
        iterations += used
        if not cost < np.inf or has_collapsed(pose):
            return minima, iterations
        if converged or _find(pose, poses, minima) >= 0:
            break
    found = _find(pose, poses, minima)
    if found >= 0:
        if cost < costs[found]:
            costs[found] = cost
            poses[found] = pose
        return minima, iterations
    if minima == MAX_MINIMA and cost >= costs[minima - 1]:
        return minima, iterations
    row = minima if minima < MAX_MINIMA else minima - 1
    while row > 0 and costs[row - 1] > cost:
        costs[row] = costs[row - 1]
        poses[row] = poses[row - 1]
        row -= 1
    costs[row] = cost
    poses[row] = pose
    return min(minima + 1, MAX_MINIMA), iterations


@kernel
def has_collapsed(pose: FloatArray) -> bool:
    """Say whether the refinement ran off to a model without thickness, or without end.

    With few points the likelihood may rise forever as a scale goes to zero. No real object is
    there, and the other minima are what the user needs.
    """
    low = min(pose[13], pose[14])
    high = max(pose[13], pose[14])
    return not (low > 1.0 / _LARGEST_STRETCH and high < _LARGEST_STRETCH)


@kernel
def _find(pose: FloatArray, poses: FloatArray, minima: int) -> int:
    """The row of the minimum that a pose coincides with, or -1."""
    for k in range(minima):
        square = 0.0
        for i in range(9):
            square += (poses[k, i] - pose[i]) ** 2
        for i in range(13, 15):
            square += (np.log(poses[k, i] / pose[i])) ** 2
        if square < _SAME_CHORD * _SAME_CHORD:
            return k
    return -1


@kernel
def orthonormalize(pose: FloatArray) -> None:
    """Take the rounding errors of the steps out of the rotation."""
    rotation = np.empty((3, 3))
    polish_rotation(pose[:9].reshape(3, 3), rotation)
    for i in range(3):
        for j in range(3):
            pose[3 * i + j] = rotation[i, j]


@kernel
def uncenter(pose: FloatArray, center: FloatArray, unit: float) -> None:
    """Turn the pose of points (x - center) / unit into the pose of points x."""
    for c in range(3):
        pose[9 + c] *= unit
        for j in range(3):
            pose[9 + c] -= pose[3 * c + j] * pose[12 + j] * center[j]


@kernel
def _invert_information(objective: Objective, pose: FloatArray, covariance: FloatArray) -> int:
    """Write (J' W J)^-1 for centred points; see `covariance_of`.

    Returns -1, or the number of the first unknown that the others leave undetermined.
    """
    information = np.empty((UNKNOWNS, UNKNOWNS))
    gradient = np.empty(UNKNOWNS)
    rows = np.empty((UNKNOWNS + 1, 2 * BLOCK))
    evaluate(objective, pose, rows, information, gradient)
    diagonal = np.diag(information).copy()
    covariance[:] = 0.0
    if not cholesky(information, UNKNOWNS, _UNOBSERVABLE):
        for k in range(UNKNOWNS):
            total = diagonal[k]
            for m in range(k):
                total -= information[k, m] ** 2
            if not total > _UNOBSERVABLE * diagonal[k]:
                return k
        return UNKNOWNS - 1
    column = np.empty(UNKNOWNS)
    for k in range(UNKNOWNS):
        if objective.free[k] == 0.0:
            continue
        column[:] = 0.0
        column[k] = 1.0
        solve_cholesky(information, UNKNOWNS, column)
        for m in range(UNKNOWNS):
            covariance[m, k] = column[m]
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
