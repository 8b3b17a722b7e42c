"""The ninth unknown: refinement and covariance where the focal length is estimated too.

The focal length is written as a reference one times exp(log_ratio). The reference's objective holds
rays and weights at log_ratio 0; at another focal length the rays shrink and the weights grow by the
ratio. Given the focal length, the other 8 unknowns are refined as ever, so the ninth is found by
Newton's method on what is left, the least error as a function of the focal length alone (variable
projection).
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.solvers.constants import OK, UNKNOWNS, UNOBSERVABLE
from cadalign.solvers.evidence import (
    BLOCK,
    Keypoints,
    LogFocalPrior,
    focal_prior_cost,
    keypoint_rows,
)
from cadalign.solvers.linalg import cholesky, copy_into, solve_cholesky
from cadalign.solvers.linear import affine_rows
from cadalign.solvers.objective import Objective, evaluate, with_keypoints
from cadalign.solvers.projection import project_point, scalars_of
from cadalign.solvers.refine import least_information, refine
from cadalign.solvers.unknowns import move_pose

_ROUNDS = 60
_POSE_ITERATIONS = 100
_LARGEST_STEP = 0.5
_CONVERGED_STEP = 1e-9
_RELATIVE_DECREASE = 1e-12
_ABSOLUTE_DECREASE = 1e-16
_HALVINGS = 12


@kernel
def linear_focal(points: FloatArray, rays: FloatArray) -> float:
    """Estimate the focal length linearly, as a multiple of that of the rays.

    The 3 x 3 block of the linear solution is diag(1, 1, 1 / ratio) R diag(scale) up to a factor, so
    for two of its columns m and n, (m_x n_x + m_y n_y) / ratio^2 + m_z n_z = 0; the least-squares
    solution over the three pairs. NaN where the points do not span a volume or no ratio is real.
    """
    spread = np.empty(3)
    rows = np.empty((3, 4))
    if affine_rows(points, rays, np.empty(5), spread, rows) != OK:
        return np.nan
    mixed = squares = 0.0
    for i in range(3):
        j = (i + 1) % 3
        weight = spread[i] * spread[j]
        across = weight * (rows[0, 1 + i] * rows[0, 1 + j] + rows[1, 1 + i] * rows[1, 1 + j])
        along = weight * rows[2, 1 + i] * rows[2, 1 + j]
        mixed -= across * along
        squares += across * across
    return float(np.sqrt(squares / mixed)) if mixed > 0.0 else np.nan


@kernel
def at_focal(objective: Objective, slopes: FloatArray, log_ratio: float) -> Objective:
    """The objective at exp(log_ratio) times the focal length of its rays.

    ``slopes`` (n, 2), or (0, 2) for a lens without distortion, holds the change of the undistorted
    pixels, over the reference focal length, per unit of the logarithm of the focal length.
    """
    ratio = np.exp(log_ratio)
    old = objective.keypoints
    rays = old.rays / ratio
    if slopes.shape[0] > 0:
        rays += slopes * (log_ratio / ratio)
    keypoints = Keypoints(old.points, rays, old.whitening * ratio, old.loss, old.loss_scale)
    return with_keypoints(objective, keypoints)


@kernel
def focal_system(
    here: Objective,
    slopes: FloatArray,
    ratio: float,
    pose: FloatArray,
    hessian: FloatArray,
    gradient: FloatArray,
) -> tuple[float, float]:
    """Build the Gauss-Newton system of all 9 unknowns at a pose, without the focal length's prior.

    ``here`` is what `at_focal` gives for the ratio. ``hessian`` (9, 8) and ``gradient`` (8,)
    receive the system of the other 8, and in the last row the focal length's products with them;
    its own entries of J' W J and J' W r are returned.
    """
    rows = np.empty((UNKNOWNS + 1, 2 * BLOCK))
    evaluate(here, pose, rows, hessian[:UNKNOWNS], gradient)
    hessian[UNKNOWNS] = 0.0
    information = slope = 0.0
    points, whitening = here.keypoints.points, here.keypoints.whitening
    scalars = scalars_of(pose)
    for start in range(0, points.shape[0], BLOCK):
        size = min(BLOCK, points.shape[0] - start)
        keypoint_rows(here.keypoints, pose, start, size, rows)
        for b in range(size):
            i = start + b
            _, _, depth = project_point(scalars, (points[i, 0], points[i, 1], points[i, 2]))
            # A longer focal length moves a point's image as a smaller depth does.
            across = -rows[5, b] * depth
            down = -rows[5, size + b] * depth
            if slopes.shape[0] > 0:
                weighted = whitening[i if whitening.shape[0] > 1 else 0]
                root = rows[3, b] * depth / weighted[0]  # of the loss's weight
                dx, dy = root * slopes[i, 0] / ratio, root * slopes[i, 1] / ratio
                across -= weighted[0] * dx + weighted[1] * dy
                down -= weighted[2] * dy
            for k in range(UNKNOWNS):
                if here.free[k] != 0.0:
                    hessian[UNKNOWNS, k] += rows[k, b] * across + rows[k, size + b] * down
            information += across * across + down * down
            slope += rows[UNKNOWNS, b] * across + rows[UNKNOWNS, size + b] * down
    return information, slope


@kernel
def refine_focal(
    objective: Objective,
    slopes: FloatArray,
    prior: LogFocalPrior,
    max_rounds: int,
    pose: FloatArray,
    log_ratio: float,
) -> tuple[float, float, int]:
    """Improve ``pose`` (15,) in place, and log_ratio with it, in at most ``max_rounds`` steps.

    ``objective`` and ``slopes`` are as for `at_focal`. Returns the cost, infinite if a point lies
    behind the camera at the start, log_ratio, and the iterations of the pose.
    """
    hessian = np.empty((UNKNOWNS + 1, UNKNOWNS))
    gradient = np.empty(UNKNOWNS)
    shift = np.empty(UNKNOWNS)
    trial = np.empty(pose.shape[0])
    here = at_focal(objective, slopes, log_ratio)
    cost, iterations, _ = refine(here, _POSE_ITERATIONS, pose)
    cost += focal_prior_cost(prior, log_ratio)
    if not cost < np.inf:
        return np.inf, log_ratio, iterations
    for _ in range(min(max_rounds, _ROUNDS)):
        own, slope = focal_system(here, slopes, np.exp(log_ratio), pose, hessian, gradient)
        slope += prior.weight * (log_ratio - prior.center)
        curvature = own + prior.weight
        whole = curvature
        # The pose follows the focal length by shift, which lessens both slope and curvature.
        floor = least_information(hessian)
        for k in range(UNKNOWNS):
            hessian[k, k] += floor
        if not cholesky(hessian, UNKNOWNS, 0.0):
            return cost, log_ratio, iterations
        for k in range(shift.shape[0]):
            shift[k] = -hessian[UNKNOWNS, k]
        solve_cholesky(hessian, UNKNOWNS, shift)
        for k in range(UNKNOWNS):
            curvature += hessian[UNKNOWNS, k] * shift[k]
            slope += gradient[k] * shift[k]
        if curvature > UNOBSERVABLE * whole:
            step = -slope / curvature
        else:
            step = -np.sign(slope) * _LARGEST_STEP
        step = min(max(step, -_LARGEST_STEP), _LARGEST_STEP)
        step = min(max(step, prior.low - log_ratio), prior.high - log_ratio)
        improved = False
        for _ in range(_HALVINGS):
            if abs(step) < _CONVERGED_STEP:
                break
            move_pose(pose, step * shift, trial)
            there = at_focal(objective, slopes, log_ratio + step)
            moved_cost, used, _ = refine(there, _POSE_ITERATIONS, trial)
            iterations += used
            moved_cost += focal_prior_cost(prior, log_ratio + step)
            if moved_cost <= cost:
                improved = True
                break
            step *= 0.3
        if not improved:
            break
        decrease = cost - moved_cost
        copy_into(pose, trial)
        here = there
        log_ratio += step
        cost = moved_cost
        if decrease <= _ABSOLUTE_DECREASE + _RELATIVE_DECREASE * cost:
            break
    return cost, log_ratio, iterations
