"""Reduced modes give the same estimates, costs and covariances as all modes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.sighted import sighted_evidence

from cadalign.solvers.joint.covariance import information_of, joint_covariance
from cadalign.solvers.joint.equations import empty_joint_equations
from cadalign.solvers.joint.evidence import Evidence, Offsets, Shape, State, pack, points_of
from cadalign.solvers.joint.search import search_joint, used_points
from cadalign.solvers.joint.system import joint_system
from cadalign.solvers.search import evaluate

POINTS, SEEN, MODES, RANK = 9, 6, 24, 15


@pytest.fixture(params=[RANK, MODES])
def rank(request: pytest.FixtureRequest) -> int:
    return int(request.param)


@pytest.fixture
def evidence(rank: int) -> Evidence:
    """Six of nine points in one view; modes move them in ``rank`` directions, or in all 18."""
    rng = np.random.default_rng(rank)
    mixed = rng.normal(size=(MODES, rank)) @ rng.normal(size=(rank, POINTS * 3))
    shape = Shape(
        rng.normal(size=(POINTS, 3)),
        0.02 * mixed.reshape(MODES, POINTS, 3) / np.sqrt(rank),
        np.zeros(POINTS),
    )
    truth = State(
        np.concatenate([Rotation.random(random_state=rank).as_matrix().ravel(), [0.1, 0.2, 6.0]])[
            None
        ],
        np.zeros(0),
        np.zeros(3),
        rng.normal(size=MODES),
        np.zeros((POINTS, 3)),
    )
    seen = points_of(shape, truth)[:SEEN] @ truth.poses[0, :9].reshape(3, 3).T
    seen += truth.poses[0, 9:]
    rays = seen[:, :2] / seen[:, 2:] + rng.normal(0, 1e-3, (SEEN, 2))
    return sighted_evidence(shape, rays)


def best_of(evidence: Evidence, rank: int) -> tuple[State, float]:
    rotation = Rotation.random(random_state=rank) * Rotation.from_rotvec([0.1, 0.0, 0.1])
    start = np.concatenate([rotation.as_matrix().ravel(), [0.0, 0.0, 5.5]])[None, None]
    minima, _ = search_joint(evidence, start, np.zeros((1, 0)), np.zeros((1, 3)))
    (state,) = minima.states
    return state, float(minima.scores[0])


def mean_depth(evidence: Evidence, state: State) -> float:
    points = points_of(evidence.shape, state)[:SEEN]
    return float((points @ state.poses[0, 6:9] + state.poses[0, 11]).mean())


def test_a_minimum_is_a_minimum_in_all_modes(evidence: Evidence, rank: int) -> None:
    state, score = best_of(evidence, rank)
    cost, information = information_of(evidence, state)
    system = joint_system(evidence, integrates=True)
    room = empty_joint_equations(system.evidence, system.layout)
    evaluate(system, pack(state), room)
    slope = np.linalg.solve(information, room.gradient)
    assert room.gradient @ slope < 1e-9 * max(cost, 1.0)
    volume = np.linalg.slogdet(information)[1] + 6 * np.log(mean_depth(evidence, state))
    assert score == pytest.approx(cost + volume, rel=1e-9)


def test_covariances_equal_those_of_all_modes(evidence: Evidence, rank: int) -> None:
    state, _ = best_of(evidence, rank)
    inverse = np.linalg.inv(information_of(evidence, state)[1])
    inverse[6:9] = inverse[:, 6:9] = 0.0
    poses, cross, border, points, seen = joint_covariance(evidence, state)
    unknowns = np.block([[poses[0], cross[0]], [cross[0].T, border]])
    assert np.allclose(unknowns, inverse, atol=1e-9 * np.abs(inverse).max())
    by_modes = np.moveaxis(evidence.shape.modes, 0, 2)
    expected = by_modes @ inverse[9:, 9:] @ by_modes.swapaxes(1, 2)
    assert np.allclose(points, expected, atol=1e-9 * np.abs(expected).max())
    turn = state.poses[0, :9].reshape(3, 3)
    x, y, z = (points_of(evidence.shape, state) @ turn.T).T
    zero = np.zeros(POINTS)
    across = np.moveaxis(np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]]), 2, 0)
    rows = np.zeros((POINTS, 3, len(inverse)))
    rows[:, :, :3], rows[:, :, 3:6], rows[:, :, 9:] = across, np.eye(3), turn @ by_modes
    expected = rows @ inverse @ rows.swapaxes(1, 2)
    assert np.allclose(seen, expected, atol=1e-9 * np.abs(expected).max())


def test_points_of_sightings_and_offsets_are_used(evidence: Evidence) -> None:
    ends, along = np.array([[6, 0], [7, -1]]), np.eye(3)[:2]
    offsets = Offsets(ends, np.array([-1, 0]), along, np.ones(2), np.ones(2))
    more = evidence.add_block(offsets)
    assert used_points(more).tolist() == [True] * 8 + [False]
