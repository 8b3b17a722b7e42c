"""Smooth motion: derivatives, factorisation and marginal covariance against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign.estimation.tracks.motion import moved_by
from cadalign.solvers.joint.arrow import (
    Arrow,
    copy_matrix,
    empty_arrow,
    factorize_arrow,
    invert_arrow,
    solve_arrow,
)
from cadalign.solvers.joint.motion import (
    STATE,
    MotionPrior,
    add_motion,
    twist_between,
    write_interval,
)
from cadalign.solvers.unknowns import move_rigid


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return moved_by(np.concatenate([np.eye(3).ravel(), np.zeros(3)]), rng.normal(size=6))


def dense(chain: Arrow) -> np.ndarray:
    frames, size = len(chain.blocks), len(chain.border)
    whole = np.zeros((STATE * frames + size,) * 2)
    for p in range(frames):
        own = slice(STATE * p, STATE * (p + 1))
        whole[own, own] = chain.blocks[p]
        whole[own, STATE * frames :] = chain.coupling[p, :, STATE:]
        if p + 1 < frames:
            whole[own, STATE * (p + 1) : STATE * (p + 2)] = chain.coupling[p, :, :STATE]
    whole[STATE * frames :, STATE * frames :] = chain.border
    upper = np.triu(whole)
    return upper + np.triu(whole, 1).T


@pytest.fixture
def chain() -> Arrow:
    rng = np.random.default_rng(0)
    frames, size = 5, 3
    made = empty_arrow(frames, STATE, STATE, size)
    for p in range(frames):
        rows = rng.normal(size=(40, 2 * STATE + size))
        products = rows.T @ rows
        made.blocks[p] += products[:STATE, :STATE]
        made.coupling[p, :, STATE:] += products[:STATE, 2 * STATE :]
        made.border[:] += products[2 * STATE :, 2 * STATE :]
        if p + 1 < frames:
            made.blocks[p + 1] += products[STATE : 2 * STATE, STATE : 2 * STATE]
            made.coupling[p + 1, :, STATE:] += products[STATE : 2 * STATE, 2 * STATE :]
            made.coupling[p, :, :STATE] += products[:STATE, STATE : 2 * STATE]
    made.gradient[:] = rng.normal(size=len(made.gradient))
    return made


def test_a_twist_leads_from_one_pose_to_the_other() -> None:
    rng = np.random.default_rng(1)
    for size in (1e-9, 1e-3, 1.0, 1.7):
        pose, twist = random_pose(rng), size * rng.normal(size=6)
        if np.linalg.norm(twist[:3]) < np.pi:
            np.testing.assert_allclose(
                twist_between(pose, moved_by(pose, twist)), twist, rtol=1e-7, atol=1e-12
            )


def test_the_derivatives_of_the_motion_are_those_of_finite_differences() -> None:
    rng = np.random.default_rng(2)
    motion = MotionPrior(np.array([0.3]), np.array([0.7, 0.4]))
    poses = np.array([random_pose(rng) for _ in range(2)])
    poses[1] = moved_by(poses[0], 0.4 * rng.normal(size=6))
    velocities = rng.normal(size=(2, 6))

    def residuals(step: np.ndarray) -> np.ndarray:
        moved = poses.copy()
        for k in range(2):
            move_rigid(poses[k], step[STATE * k : STATE * k + 6], moved[k])
        changed = velocities + step.reshape(2, STATE)[:, 6:]
        rows = np.empty((STATE, 2 * STATE + 1))
        write_interval(motion, 0, moved, changed, rows)
        return rows[:, -1]

    rows = np.empty((STATE, 2 * STATE + 1))
    write_interval(motion, 0, poses, velocities, rows)
    steps = 1e-6 * np.eye(2 * STATE)
    numeric = np.array([(residuals(step) - residuals(-step)) / 2e-6 for step in steps]).T
    np.testing.assert_allclose(rows[:, :-1], numeric, atol=1e-6 * np.abs(numeric).max())


def test_a_constant_twist_has_no_cost() -> None:
    rng = np.random.default_rng(3)
    twist, times = rng.normal(size=6), np.cumsum([0.0, 0.1, 0.3, 0.2])
    start = random_pose(rng)
    poses = np.array([moved_by(start, time * twist) for time in times])
    motion = MotionPrior(np.diff(times), np.ones(2))
    assert (
        add_motion(motion, poses, np.tile(twist, (4, 1)), empty_arrow(4, STATE, STATE, 0)) < 1e-20
    )


def test_a_chain_is_solved_as_the_whole_matrix(chain: Arrow) -> None:
    factor, step = empty_arrow(5, STATE, STATE, 3), np.zeros_like(chain.gradient)
    copy_matrix(chain, factor)
    assert factorize_arrow(factor)
    solve_arrow(factor, chain.gradient, step)
    np.testing.assert_allclose(step, -np.linalg.solve(dense(chain), chain.gradient), rtol=1e-9)


def test_the_inverse_of_a_chain_has_the_blocks_of_the_inverse(chain: Arrow) -> None:
    whole = np.linalg.inv(dense(chain))
    assert factorize_arrow(chain)
    inverse = invert_arrow(chain)
    last = 4
    inverse.coupling[last, :, :STATE] = 0.0  # there is no next frame
    expected = dense(inverse)
    np.testing.assert_allclose(np.where(expected != 0, whole, 0.0), expected, atol=1e-9)


def test_an_indefinite_chain_is_refused(chain: Arrow) -> None:
    chain.blocks[2, 0, 0] = -1.0
    assert not factorize_arrow(chain)
