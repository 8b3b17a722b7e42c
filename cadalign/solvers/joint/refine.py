"""Levenberg-Marquardt over everything that a joint estimate leaves unknown."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.solvers.joint.evidence import Evidence, State, copy_state
from cadalign.solvers.joint.factor import factorize, solve_factor
from cadalign.solvers.joint.system import System, empty_system, evaluate_joint
from cadalign.solvers.unknowns import orthonormalize

_FIRST_DAMPING = 1e-4
_LARGEST_DAMPING = 1e12
_LEAST_INFORMATION = 1e-15  # about an unknown, over that about the best known one
_RELATIVE_DECREASE = 1e-11
_ABSOLUTE_DECREASE = 1e-13
_LARGEST_LOG_STEP = 1.0


@kernel
def refine_joint(evidence: Evidence, max_iterations: int, state: State) -> tuple[float, int, bool]:
    """Improve ``state`` in place by Levenberg-Marquardt.

    Returns the cost, infinite if a point lies behind a camera at the start, the number of
    iterations, and if they converged.
    """
    system, proposed = empty_system(evidence), empty_system(evidence)
    unknowns = system.gradient.shape[0]
    factor = np.empty((unknowns, unknowns))
    step = np.zeros(unknowns)
    trial = copy_state(state)
    cost = evaluate_joint(evidence, state, system)
    damping, growth = _FIRST_DAMPING, 4.0
    iterations = 0
    while cost < np.inf and iterations < max_iterations:
        least = 1e-300
        for k in range(unknowns):
            least = max(least, _LEAST_INFORMATION * system.hessian[k, k])
        for k in range(unknowns):
            step[k] = -system.gradient[k]
            for m in range(k + 1):
                factor[k, m] = system.hessian[k, m]
            factor[k, k] += damping * system.hessian[k, k] + least
        accepted = False
        expected = 0.0
        if factorize(factor):
            solve_factor(factor, step)
            for k in range(unknowns):
                expected -= system.gradient[k] * step[k]
            move_state(evidence, state, system, step, trial)
            trial_cost = evaluate_joint(evidence, trial, proposed)
            accepted = trial_cost <= cost * (1.0 + 1e-12)
        if not accepted:
            if damping < 1e-2 and 0.0 < expected <= _ABSOLUTE_DECREASE + _RELATIVE_DECREASE * cost:
                return cost, iterations, True
            damping *= growth
            growth *= 2.0
            if damping > _LARGEST_DAMPING:
                return cost, iterations, False
            continue
        iterations += 1
        gain = (cost - trial_cost) / expected if expected > 0 else 1.0
        done = damping < 1e-2 and expected <= _ABSOLUTE_DECREASE + _RELATIVE_DECREASE * cost
        damping = max(damping * (0.1 if gain > 0.5 else 0.5 if gain > 0.1 else 2.0), 1e-12)
        growth = 4.0
        cost = trial_cost
        _copy_into(trial, state)
        system, proposed = proposed, system
        if done:
            return cost, iterations, True
    return cost, iterations, False


@kernel
def move_state(
    evidence: Evidence, state: State, system: System, step: FloatArray, moved: State
) -> None:
    """Write the state that a step leads to, each displacement moving as is best for it."""
    poses = state.poses.shape[0]
    for p in range(poses):
        _move_pose(state.poses[p], step[6 * p : 6 * p + 6], moved.poses[p])
    for a in range(3):
        log_step = min(max(step[6 * poses + a], -_LARGEST_LOG_STEP), _LARGEST_LOG_STEP)
        moved.log_scales[a] = state.log_scales[a] + log_step
    for k in range(state.coefficients.shape[0]):
        moved.coefficients[k] = state.coefficients[k] + step[6 * poses + 3 + k]
    sightings, rows, first = evidence.sightings, system.rows, system.first
    unknowns = step.shape[0]
    n = 0
    while n < sightings.point.shape[0]:
        i = sightings.point[n]
        start = first[n]
        while n < sightings.point.shape[0] and sightings.point[n] == i:
            n += 1
        if not evidence.shape.spread[i] > 0:
            continue
        moved.displacements[i] = 0.0
        for c in range(start, first[n]):
            residual = rows[unknowns, c]
            for k in range(unknowns):
                residual += rows[k, c] * step[k]
            residual *= -(evidence.shape.spread[i] ** 2)
            for a in range(3):
                moved.displacements[i, a] += residual * rows[unknowns + 1 + a, c]


@kernel
def _move_pose(pose: FloatArray, step: FloatArray, moved: FloatArray) -> None:
    """Write the pose (12,) that a step of its six unknowns leads to."""
    angle2 = step[0] * step[0] + step[1] * step[1] + step[2] * step[2]
    angle = np.sqrt(angle2)
    a = np.sin(angle) / angle if angle > 1e-4 else 1.0 - angle2 / 6.0
    b = (1.0 - np.cos(angle)) / angle2 if angle > 1e-4 else 0.5 - angle2 / 24.0
    x, y, z = step[0], step[1], step[2]
    for c in range(3):
        p, q, r = pose[c], pose[3 + c], pose[6 + c]
        dot = x * p + y * q + z * r
        moved[c] = p + a * (y * r - z * q) + b * (x * dot - p * angle2)
        moved[3 + c] = q + a * (z * p - x * r) + b * (y * dot - q * angle2)
        moved[6 + c] = r + a * (x * q - y * p) + b * (z * dot - r * angle2)
        moved[9 + c] = pose[9 + c] + step[3 + c]


@kernel
def _copy_into(source: State, target: State) -> None:
    target.poses[:] = source.poses
    target.log_scales[:] = source.log_scales
    target.coefficients[:] = source.coefficients
    target.displacements[:] = source.displacements
    for p in range(target.poses.shape[0]):
        orthonormalize(target.poses[p])
