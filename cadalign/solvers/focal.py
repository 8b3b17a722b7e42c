"""The system of pose, stretch and focal length: 9 unknowns, from the keypoints of one view.

The focal length is a reference one times exp(log_ratio). The reference's objective holds rays and
weights at log_ratio 0; at another focal length the rays shrink and the weights grow by the ratio. A
longer lens and a larger distance explain much the same image, so that the two are moved together:
a step of the log focal length carries the distance with it. What is left for it to explain is the
perspective, and the valley of the cost is straight.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import inlined, kernel
from cadalign.solvers.alignment import (
    Equations,
    Objective,
    are_same_poses,
    center_and_unit,
    centered,
    evaluate_cost,
    invert,
    rank_by_cost,
    room_for,
    room_for_two,
    solve_damped,
    uncenter_covariance,
    with_keypoints,
    with_points,
    write_equations,
)
from cadalign.solvers.constants import OK, POSE_SIZE, UNKNOWNS, UNOBSERVABLE
from cadalign.solvers.evidence import KeypointEvidence, LogFocalPrior, focal_prior_cost
from cadalign.solvers.linalg import copy_into
from cadalign.solvers.linear import affine_rows
from cadalign.solvers.search import (
    are_same,
    cost_at,
    evaluate,
    move,
    refine,
    room_of,
    score_of,
    solve,
)
from cadalign.solvers.unknowns import leaves_bounds, move_pose

_LARGEST_STEP = 0.5
_SAME_FOCAL = 0.01


class FocalObjective(NamedTuple):
    """An objective at the reference focal length, and what is known of the focal length.

    A state is the packed pose and log_ratio (16,). ``slopes`` (n, 2), or (0, 2) for a lens without
    distortion, holds the change of the undistorted pixels, over the reference focal length, per
    unit of the logarithm of the focal length.
    """

    objective: Objective
    slopes: FloatArray
    prior: LogFocalPrior


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

    ``slopes`` are those of `FocalObjective`.
    """
    ratio = np.exp(log_ratio)
    old = objective.keypoints
    rays = old.rays / ratio
    if slopes.shape[0] > 0:
        rays += slopes * (log_ratio / ratio)
    keypoints = KeypointEvidence(old.points, rays, old.whitening * ratio, old.loss, old.loss_scale)
    return with_keypoints(objective, keypoints)


@room_of.of(FocalObjective)
@kernel
def _room_of(system: FocalObjective) -> tuple[Equations, Equations]:
    return room_for_two(UNKNOWNS + 1)


@evaluate.of(FocalObjective)
@kernel
def evaluate_focal(system: FocalObjective, state: FloatArray, equations: Equations) -> float:
    """Build the Gauss-Newton system of all 9 unknowns; see `FocalObjective`."""
    hessian, gradient = equations.hessian, equations.gradient
    log_ratio = state[POSE_SIZE]
    here = at_focal(system.objective, system.slopes, log_ratio)
    cost = write_equations(here, system.slopes / np.exp(log_ratio), state, equations)
    if not cost < np.inf:
        return np.inf
    cost += focal_prior_cost(system.prior, log_ratio)
    hessian[UNKNOWNS, UNKNOWNS] += system.prior.weight
    gradient[UNKNOWNS] += system.prior.weight * (log_ratio - system.prior.center)
    if leaves_bounds(log_ratio, system.prior.low, system.prior.high, gradient[UNKNOWNS]):
        gradient[UNKNOWNS] = 0.0
        for m in range(UNKNOWNS):
            hessian[UNKNOWNS, m] = hessian[m, UNKNOWNS] = 0.0
    return cost


@cost_at.of(FocalObjective)
@kernel
def _cost_at(system: FocalObjective, state: FloatArray) -> float:
    log_ratio = state[POSE_SIZE]
    here = at_focal(system.objective, system.slopes, log_ratio)
    return evaluate_cost(here, state) + focal_prior_cost(system.prior, log_ratio)


@solve.of(FocalObjective)
@inlined
def _solve(system: FocalObjective, equations: Equations, damping: float, step: FloatArray) -> float:
    return solve_damped(equations, UNKNOWNS + 1, damping, step)


@move.of(FocalObjective)
@inlined
def _move(
    system: FocalObjective,
    state: FloatArray,
    equations: Equations,
    damping: float,
    step: FloatArray,
    moved: FloatArray,
) -> None:
    move_pose(state, step, moved)
    log_step = min(max(step[UNKNOWNS], -_LARGEST_STEP), _LARGEST_STEP)
    log_ratio = min(max(state[POSE_SIZE] + log_step, system.prior.low), system.prior.high)
    moved[POSE_SIZE] = log_ratio
    moved[11] *= np.exp(log_ratio - state[POSE_SIZE])


score_of.of(FocalObjective)(rank_by_cost)


@are_same.of(FocalObjective)
@inlined
def _are_same(system: FocalObjective, first: FloatArray, second: FloatArray) -> bool:
    zoomed = abs(first[POSE_SIZE] - second[POSE_SIZE])
    return zoomed < _SAME_FOCAL and are_same_poses(system.objective, first, second)


@kernel
def refine_focal(
    system: FocalObjective, max_iterations: int, pose: FloatArray
) -> tuple[float, float, int]:
    """Improve ``pose`` (15,) in place, with the focal length, from log_ratio 0.

    Returns the cost, infinite if a point lies behind the camera at the start, log_ratio, and the
    number of iterations.
    """
    state = np.zeros(POSE_SIZE + 1)
    for k in range(POSE_SIZE):
        state[k] = pose[k]
    cost, iterations, _ = refine(system, max_iterations, state)
    copy_into(pose, state[:POSE_SIZE])
    return cost, state[POSE_SIZE], iterations


@kernel
def focal_covariance(system: FocalObjective, pose: FloatArray, covariance: FloatArray) -> int:
    """Write the covariance of all 9 unknowns, at log_ratio 0, into (9, 9).

    The order is rotation vector, translation, log scales, log focal length. Returns -1, or the
    number of an unknown that the points do not determine; the focal length is never one, its
    deviation is then as large as rounding errors let it be known. Bounds don't count.
    """
    points = system.objective.keypoints.points
    center, unit = center_and_unit(points)
    local = with_points(system.objective, (points - center) / unit)
    state = np.zeros(POSE_SIZE + 1)
    state[:POSE_SIZE] = centered(pose, center, unit)
    equations = room_for(UNKNOWNS + 1)
    unbounded = LogFocalPrior(-np.inf, np.inf, system.prior.center, system.prior.weight)
    evaluate_focal(FocalObjective(local, system.slopes, unbounded), state, equations)
    hessian, distance = equations.hessian, state[11]
    least = UNOBSERVABLE * hessian[5, 5] * distance * distance
    undetermined = invert(hessian, system.objective.free, least, covariance)
    # The distance follows the focal length, see the module.
    for k in range(UNKNOWNS + 1):
        covariance[5, k] += distance * covariance[UNKNOWNS, k]
    for k in range(UNKNOWNS + 1):
        covariance[k, 5] += distance * covariance[k, UNKNOWNS]
    uncenter_covariance(pose, center, unit, covariance)
    return undetermined
