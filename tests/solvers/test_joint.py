"""Normal equations of the joint system, against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cadalign.solvers.constants import CAUCHY, HUBER, LINEAR, ScalePrior
from cadalign.solvers.joint.covariance import information_of, joint_covariance
from cadalign.solvers.joint.equations import empty_joint_equations
from cadalign.solvers.joint.evidence import (
    Directions,
    Evidence,
    Focals,
    Offsets,
    Rig,
    ScalePriors,
    Shape,
    Sightings,
    State,
    kept_rows,
    pack,
    points_of,
    unpack_state,
)
from cadalign.solvers.joint.search import equations_at, refine_joint
from cadalign.solvers.joint.system import joint_system
from cadalign.solvers.search import evaluate, move

POINTS, MODES, VIEWS = 7, 3, 2


def evidence_of(
    seed: int,
    *,
    spread: float,
    poses: tuple[int, int],
    loss: int,
    focals: int = 0,
    width: float = 0.0,
) -> Evidence:
    rng = np.random.default_rng(seed)
    shape = Shape(
        rng.normal(size=(POINTS, 3)),
        0.1 * rng.normal(size=(MODES, POINTS, 3)),
        np.full(POINTS, spread),
    )
    point, view = np.repeat(np.arange(POINTS), VIEWS), np.tile(np.arange(VIEWS), POINTS)
    count = len(point)
    weights = np.where(np.arange(count) % 2, 10.0, 0.0)
    scales = np.where(np.arange(count) % 4 == 3, 3.0, 0.0)  # of depths in an image
    depths = np.stack([np.full(count, 5.0), weights, scales], axis=1)
    sightings = Sightings(
        point,
        view,
        0.1 * rng.normal(size=(count, 2)),
        np.abs(rng.normal(size=(count, 3))) * 100,
        depths,
        np.full(count, loss),
        np.full(count, 2.0),
    )
    rotations = Rotation.from_rotvec([[0, 0, 0], [0.1, 0.3, 0]]).as_matrix().reshape(VIEWS, 9)
    cameras = np.concatenate([rotations, 0.1 * rng.normal(size=(VIEWS, 3))], axis=1)
    up = Directions(
        np.array([[0.0, 1.0, 0.0]]),
        np.array([[0, 0.8, 0.6]]),
        np.array([1]),
        30 * np.eye(3)[None] + rng.normal(size=(1, 3, 3)),
    )
    ends = [[0, 1], [2, 3], [5, -1], [-1, 4]]  # two lengths, a height, and a distance from a camera
    along = [[1.0, 0, 0], [0, 1, 0], [0, 0.6, 0.8], [0.8, 0, 0.6]]
    offsets = Offsets(
        np.array(ends),
        np.array([-1, -1, 1, 0]),
        np.array(along),
        np.array([1.0, 2.0, 2.0, -3.0]),
        np.array([10.0, 20.0, 20.0, 10.0]),
    )
    precision = rng.normal(size=(3, 3))
    scales = ScalePriors(np.ones(3), precision @ precision.T, ScalePrior(3.0, width))
    lenses = Focals(
        np.minimum(np.arange(VIEWS), focals - 1),
        np.full(focals, -2.0),
        np.full(focals, 2.0),
        0.1 * rng.normal(size=focals),
        np.full(focals, 30.0),
    )
    rig = Rig(cameras, np.array(poses), np.array([[0.0, 0, 1], [0, 0.6, 0.8]]))
    return Evidence(shape, sightings, rig, lenses, scales, (up, offsets))


def gradient_of(evidence: Evidence, state: State, *, integrates: bool = False) -> np.ndarray:
    system = joint_system(evidence, integrates=integrates)
    room = empty_joint_equations(system.evidence, system.layout)
    assert evaluate(system, pack(state), room) < np.inf
    return room.gradient


def cost_of(evidence: Evidence, state: State, *, integrates: bool = False) -> float:
    return equations_at(evidence, pack(state), integrates=integrates)[0]


def move_state(evidence: Evidence, state: State, step: np.ndarray) -> State:
    system = joint_system(evidence, integrates=False)
    row, room = pack(state), empty_joint_equations(system.evidence, system.layout)
    evaluate(system, row, room)
    there = row.copy()
    move(system, row, room, 0.0, step, there)
    return unpack_state(evidence.shape, len(evidence.focals.low), there)


def state_of(seed: int, poses: int, focals: int = 0) -> State:
    rng = np.random.default_rng(seed + 1)
    rotations = Rotation.random(poses, random_state=seed).as_matrix().reshape(poses, 9)
    return State(
        np.concatenate([rotations, np.tile([0.1, 0.2, 6.0], (poses, 1))], axis=1),
        0.2 * rng.normal(size=focals),
        0.1 * rng.normal(size=3),
        0.5 * rng.normal(size=MODES),
        0.02 * rng.normal(size=(POINTS, 3)),
    )


def predict_evidence(evidence: Evidence, state: State) -> Evidence:
    """The evidence that a state predicts, with noise of 0.01 in the rays."""
    sightings, rig = evidence.sightings, evidence.rig
    seen = points_of(evidence.shape, state)[sightings.point]
    motions = state.poses[rig.pose[sightings.image]], rig.cam_from_rig[sightings.image]
    for motion in motions:
        rotations = motion[:, :9].reshape(-1, 3, 3)
        seen = np.einsum("nij,nj->ni", rotations, seen) + motion[:, 9:]
    noise = np.random.default_rng(0).normal(0, 0.01, (len(seen), 2))
    rays = seen[:, :2] / seen[:, 2:] + noise
    depths = sightings.depths.copy()
    depths[:, 0] = (seen * rig.axes[sightings.image]).sum(axis=1)
    return evidence._replace(sightings=sightings._replace(rays=rays, depths=depths))


def test_a_direction_that_agrees_with_the_pose_adds_no_cost() -> None:
    evidence = evidence_of(0, spread=0.0, poses=(0, 1), loss=LINEAR)
    state, up = state_of(0, 2), evidence.directions
    turns = [each[:9].reshape(3, 3) for each in (evidence.rig.cam_from_rig[1], state.poses[1])]
    agreeing = up._replace(camera=up.model @ (turns[0] @ turns[1]).T)
    without = evidence.add_block(Directions(*(each[:0] for each in up)))
    expected = cost_of(without, state)
    assert cost_of(evidence.add_block(agreeing), state) == pytest.approx(expected)
    assert cost_of(evidence, state) > expected * (1 + 1e-3)


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    poses=st.sampled_from([(0, 0), (0, 1)]),
    focals=st.sampled_from([0, 1, 2]),
    loss=st.sampled_from([LINEAR, HUBER, CAUCHY]),
)
def test_the_gradient_of_the_cost(
    seed: int, poses: tuple[int, int], focals: int, loss: int
) -> None:
    evidence = evidence_of(seed, spread=0.0, poses=poses, loss=loss, focals=focals, width=0.02)
    state = state_of(seed, max(poses) + 1, focals)
    gradient = gradient_of(evidence, state)
    slopes = np.empty(len(gradient))
    for k in range(len(slopes)):
        step = 1e-6 * np.eye(len(slopes))[k]
        costs = [cost_of(evidence, move_state(evidence, state, s)) for s in (step, -step)]
        slopes[k] = (costs[0] - costs[1]) / 4e-6  # the cost has no factor 1/2
    assert np.allclose(slopes, gradient, rtol=1e-5, atol=1e-7 * np.abs(slopes).max())


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    poses=st.sampled_from([(0, 0), (0, 1)]),
    focals=st.sampled_from([0, 1]),
    spread=st.sampled_from([0.0, 0.05]),
    loss=st.sampled_from([LINEAR, HUBER, CAUCHY]),
)
def test_the_gradient_of_the_log_determinant(
    seed: int, poses: tuple[int, int], focals: int, spread: float, loss: int
) -> None:
    spread *= poses == (0, 0)  # displacements of several poses are modes
    evidence = evidence_of(seed, spread=spread, poses=poses, loss=loss, focals=focals)
    state = state_of(seed, max(poses) + 1, focals)
    state.displacements[:] *= spread > 0
    evidence = predict_evidence(evidence, state)
    gradient = gradient_of(evidence, state, integrates=True)
    plain = gradient_of(evidence, state)
    displaced = spread > 0
    unknowns = len(gradient) - (MODES if displaced else 0)  # coefficients also move displacements
    slopes = np.empty(unknowns)
    for k in range(unknowns):
        step = 1e-5 * np.eye(len(gradient))[k]
        ends = [move_state(evidence, state, each) for each in (step, -step)]
        if displaced:
            ends = [each._replace(displacements=state.displacements) for each in ends]
        volumes = [
            cost_of(evidence, each, integrates=True) - cost_of(evidence, each) for each in ends
        ]
        slopes[k] = (volumes[0] - volumes[1]) / 4e-5
    found = (gradient - plain)[:unknowns]
    if displaced:  # the shifted means also change the gradient
        found -= shifts_of(evidence, state)[:unknowns]
    assert np.allclose(slopes, found, rtol=1e-4, atol=1e-5 * np.abs(slopes).max())


def shifts_of(evidence: Evidence, state: State) -> np.ndarray:
    """Change of the gradient due to the shifted prior means of displacements."""
    system = joint_system(evidence, integrates=True)
    room = empty_joint_equations(system.evidence, system.layout)
    evaluate(system, pack(state), room)
    shifted = room.rows[-4].copy()
    plain = empty_joint_equations(evidence, system.layout)
    evaluate(joint_system(evidence, integrates=False), pack(state), plain)
    return np.asarray(room.rows[:-4] @ (shifted - plain.rows[-4]))


def test_eliminated_displacements_equal_modes_of_the_same_deviation() -> None:
    spread = 0.05
    evidence = evidence_of(5, spread=spread, poses=(0, 0), loss=LINEAR)
    each = spread * np.eye(3 * POINTS).reshape(-1, POINTS, 3)
    evidence = predict_evidence(evidence, state_of(5, 1))
    evidence = evidence.add_block(kept_rows(evidence.offsets, np.arange(0)))
    as_modes = evidence._replace(
        shape=Shape(
            evidence.shape.mean,
            np.concatenate([evidence.shape.modes, each]),
            np.zeros(POINTS),
        )
    )
    state = state_of(5, 1)
    state.displacements[:] = 0
    more = np.concatenate([state.coefficients, np.zeros(3 * POINTS)])
    first, _, one = refine_joint(evidence, 300, state)
    second, _, other = refine_joint(as_modes, 300, state._replace(coefficients=more))
    assert np.isclose(first, second, rtol=1e-8)
    assert np.allclose(one.poses, other.poses, atol=1e-5)
    found = points_of(evidence.shape, one), points_of(as_modes.shape, other)
    assert np.allclose(*found, atol=1e-5)
    eliminated, of_modes = joint_covariance(evidence, one), joint_covariance(as_modes, other)
    assert np.allclose(eliminated.poses, of_modes.poses, rtol=1e-3, atol=1e-9)
    assert np.allclose(eliminated.points, of_modes.points, rtol=1e-3, atol=1e-8)
    assert np.allclose(eliminated.seen, of_modes.seen, rtol=1e-3, atol=1e-8)


def test_the_arrow_is_the_dense_matrix() -> None:
    evidence = evidence_of(6, spread=0.0, poses=(0, 1), loss=LINEAR, focals=1)
    state = state_of(6, 2, 1)
    _, information = information_of(evidence, state)
    found, inverse = joint_covariance(evidence, state), np.linalg.inv(information)
    size = np.abs(inverse).max()
    for p in range(2):
        own = slice(6 * p, 6 * p + 6)
        assert np.allclose(found.poses[p], inverse[own, own], atol=1e-9 * size)
        assert np.allclose(found.cross[p], inverse[own, 12:], atol=1e-9 * size)
    assert np.allclose(found.border, inverse[12:, 12:], atol=1e-9 * size)


@pytest.mark.parametrize("poses", [(0, 0), (0, 1)])
def test_covariances_of_points_are_propagated_from_the_unknowns(poses: tuple[int, int]) -> None:
    evidence = evidence_of(4, spread=0.0, poses=poses, loss=LINEAR)
    state = state_of(4, max(poses) + 1)
    found = joint_covariance(evidence, state)
    covariance = np.linalg.inv(information_of(evidence, state)[1])

    def in_model_and_camera(step: np.ndarray) -> np.ndarray:
        there = move_state(evidence, state, step)
        places = [points_of(evidence.shape, there)]
        for motion in (there.poses[poses[0]], evidence.rig.cam_from_rig[0]):
            places.append(places[-1] @ motion[:9].reshape(3, 3).T + motion[9:])
        return np.stack([places[0], places[2]])

    steps = 1e-6 * np.eye(len(covariance))
    ends = [in_model_and_camera(step) - in_model_and_camera(-step) for step in steps]
    slopes = np.moveaxis(np.array(ends) / 2e-6, 0, -1)
    expected = slopes @ covariance @ slopes.swapaxes(-1, -2)
    size = np.abs(expected).max()
    assert np.allclose(expected, [found.points, found.seen], rtol=1e-5, atol=1e-7 * size)
