"""Derivatives of a posed shape's optimum by its data, by the implicit function theorem.

At the optimum the step of pose and forces that the equations predict is zero. Its derivatives by
the state and by the data, from central differences of the equations themselves, give those of the
state: ``ds = -(dG/ds)^-1 dG/dd dd``. All that the objective holds counts, the determinant that the
shape leaves and the weights of a robust loss included.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.solvers.linalg import copy_into
from cadalign.solvers.marginal.equations import POSE, POSE_UNKNOWNS, Posed, posed_room, state_at
from cadalign.solvers.marginal.problem import GaussianTarget, Mixture, Seen, target_of
from cadalign.solvers.search import evaluate, move, solve
from cadalign.solvers.unknowns import move_rigid

_DIFFERENCE = 1e-5  # in standard deviations, radians, and shares of lengths


class StateSlopes(NamedTuple):
    """Derivatives of a step of pose and forces (6 + 3 n), by these and by the data.

    ``by_state`` (6 + 3 n, 6 + 3 n); ``by_data`` (6 + 3 n, d) by the rays (2 n), the log sigmas (n)
    and, where asked for, the mean's keypoints (3 n).
    """

    by_state: FloatArray
    by_data: FloatArray


@kernel
def slopes_of(
    mixture: Mixture,
    component: int,
    seen: Seen,
    pose: FloatArray,
    force: FloatArray,
    with_mean: bool,
) -> StateSlopes:
    """The slopes at an optimum, whose ``pose`` (12,) and ``force`` (n, 3) are given."""
    target = target_of(mixture, component, seen)
    n = target.mean.shape[0]
    covariance = target.covariance
    state = state_at(pose, n)
    for k in range(3 * n):
        state[POSE + 3 * n + k] = force[k // 3, k % 3]
        for m in range(3 * n):
            state[POSE + k] += covariance[k, m] * force[m // 3, m % 3]
    size = POSE_UNKNOWNS + 3 * n
    by_state = np.empty((size, size))
    by_data = np.empty((size, 6 * n if with_mean else 3 * n))
    system = Posed(target, seen, True)
    for k in range(size):
        step, unit = np.zeros(POSE_UNKNOWNS), _DIFFERENCE
        if k >= POSE_UNKNOWNS:
            spread = covariance[k - POSE_UNKNOWNS, k - POSE_UNKNOWNS]
            unit = _DIFFERENCE / np.sqrt(spread) if spread > 0.0 else 1.0
        elif k >= 3:
            unit = _DIFFERENCE * abs(state[11])
        for side in range(2):
            change = unit if side == 0 else -unit
            moved = state.copy()
            if k < POSE_UNKNOWNS:
                step[k] = change
                move_rigid(state, step, moved)
            else:
                m = k - POSE_UNKNOWNS
                moved[POSE + 3 * n + m] += change
                for j in range(3 * n):
                    moved[POSE + j] += change * covariance[j, m]
            found = step_at(system, moved)
            if side == 0:
                by_state[:, k] = found
            else:
                by_state[:, k] = (by_state[:, k] - found) / (2.0 * unit)
    for k in range(by_data.shape[1]):
        unit = _DIFFERENCE
        if k < 2 * n:
            unit = _DIFFERENCE / seen.whitening[k // 2, 0]
        elif k >= 3 * n:
            unit = _DIFFERENCE * abs(state[11])
        for side in range(2):
            found = step_at(_changed(system, k, unit if side == 0 else -unit), state)
            if side == 0:
                by_data[:, k] = found
            else:
                by_data[:, k] = (by_data[:, k] - found) / (2.0 * unit)
    return StateSlopes(by_state, by_data)


@kernel
def _changed(system: Posed, datum: int, change: float) -> Posed:
    """The system with one datum changed."""
    target, seen = system.target, system.seen
    n = target.mean.shape[0]
    rays, whitening, mean = seen.rays.copy(), seen.whitening.copy(), target.mean.copy()
    if datum < 2 * n:
        rays[datum // 2, datum % 2] += change
    elif datum < 3 * n:
        for c in range(3):
            whitening[datum - 2 * n, c] *= np.exp(-change)
    else:
        mean[(datum - 3 * n) // 3, (datum - 3 * n) % 3] += change
    return Posed(
        GaussianTarget(mean, target.covariance),
        Seen(seen.points, rays, whitening, seen.loss, seen.loss_scale),
        True,
    )


@kernel
def step_at(system: Posed, state: FloatArray) -> FloatArray:
    """Step (6 + 3 n,) of pose and forces that the equations at a state predict."""
    size = 3 * system.target.mean.shape[0]
    equations = posed_room(system)
    step, moved = np.zeros(POSE_UNKNOWNS), np.empty(state.shape[0])
    evaluate(system, state, equations)
    solve(system, equations, 0.0, step)
    copy_into(moved, state)
    move(system, state, equations, 0.0, step, moved)
    found = np.empty(POSE_UNKNOWNS + size)
    for k in range(POSE_UNKNOWNS):
        found[k] = step[k]
    for k in range(size):
        found[POSE_UNKNOWNS + k] = moved[POSE + size + k] - state[POSE + size + k]
    return found
