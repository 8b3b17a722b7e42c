"""Smooth motion: derivatives, factorisation and marginal covariance against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign.estimation.tracks.motion import moved_by
from cadalign.solvers.tracks.chain import (
    STATE,
    Chain,
    copy_chain,
    empty_chain,
    factorize_chain,
    invert_chain,
    solve_chain,
)
from cadalign.solvers.tracks.motion import MotionPrior, add_motion, twist_between, write_interval
from cadalign.solvers.unknowns import move_rigid


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return moved_by(np.concatenate([np.eye(3).ravel(), np.zeros(3)]), rng.normal(size=6))


def dense(chain: Chain) -> np.ndarray:
    frames, size = len(chain.frames), len(chain.border)
    whole = np.zeros((STATE * frames + size,) * 2)
    for p in range(frames):
        own = slice(STATE * p, STATE * (p + 1))
        whole[own, own] = chain.frames[p]
        whole[own, STATE * frames :] = chain.later[p, :, STATE:]
        if p + 1 < frames:
            whole[own, STATE * (p + 1) : STATE * (p + 2)] = chain.later[p, :, :STATE]
    whole[STATE * frames :, STATE * frames :] = chain.border
    upper = np.triu(whole)
    return upper + np.triu(whole, 1).T


@pytest.fixture
def chain() -> Chain:
    rng = np.random.default_rng(0)
    frames, size = 5, 3
    made = empty_chain(frames, size)
    for p in range(frames):
        rows = rng.normal(size=(40, 2 * STATE + size))
        products = rows.T @ rows
        made.frames[p] += products[:STATE, :STATE]
        made.later[p, :, STATE:] += products[:STATE, 2 * STATE :]
        made.border[:] += products[2 * STATE :, 2 * STATE :]
        if p + 1 < frames:
            made.frames[p + 1] += products[STATE : 2 * STATE, STATE : 2 * STATE]
            made.later[p + 1, :, STATE:] += products[STATE : 2 * STATE, 2 * STATE :]
            made.later[p, :, :STATE] += products[:STATE, STATE : 2 * STATE]
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
    assert add_motion(motion, poses, np.tile(twist, (4, 1)), empty_chain(4, 0)) < 1e-20


def test_a_chain_is_solved_as_the_whole_matrix(chain: Chain) -> None:
    factor, step = empty_chain(5, 3), np.zeros_like(chain.gradient)
    copy_chain(chain, factor)
    assert factorize_chain(factor)
    solve_chain(factor, chain.gradient, step)
    np.testing.assert_allclose(step, -np.linalg.solve(dense(chain), chain.gradient), rtol=1e-9)


def test_the_inverse_of_a_chain_has_the_blocks_of_the_inverse(chain: Chain) -> None:
    whole = np.linalg.inv(dense(chain))
    assert factorize_chain(chain)
    inverse = invert_chain(chain)
    last = 4
    inverse.later[last, :, :STATE] = 0.0  # there is no next frame
    expected = dense(inverse)
    np.testing.assert_allclose(np.where(expected != 0, whole, 0.0), expected, atol=1e-9)


def test_an_indefinite_chain_is_refused(chain: Chain) -> None:
    chain.frames[2, 0, 0] = -1.0
    assert not factorize_chain(chain)
