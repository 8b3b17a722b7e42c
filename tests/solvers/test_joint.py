"""The joint estimate's normal equations, against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cadalign.solvers.constants import CAUCHY, HUBER, LINEAR
from cadalign.solvers.joint.covariance import joint_covariance
from cadalign.solvers.joint.evidence import (
    Directions,
    Evidence,
    Heights,
    Lengths,
    Planes,
    Rig,
    ScalePriors,
    Shape,
    Sightings,
    State,
    copy_state,
    points_of,
)
from cadalign.solvers.joint.refine import move_state, refine_joint
from cadalign.solvers.joint.system import empty_system, evaluate_joint

POINTS, MODES, VIEWS = 7, 3, 2


def evidence_of(seed: int, *, spread: float, poses: tuple[int, int], loss: int) -> Evidence:
    rng = np.random.default_rng(seed)
    shape = Shape(
        rng.normal(size=(POINTS, 3)),
        0.1 * rng.normal(size=(MODES, POINTS, 3)),
        np.full(POINTS, spread),
    )
    point, view = np.repeat(np.arange(POINTS), VIEWS), np.tile(np.arange(VIEWS), POINTS)
    count = len(point)
    depths = np.stack([np.full(count, 5.0), np.where(np.arange(count) % 2, 10.0, 0.0)], axis=1)
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
    lengths = Lengths(
        np.array([[0, 1], [2, 3]]), np.array([0, 1]), np.array([1.0, 2.0]), np.array([10.0, 20.0])
    )
    heights = Heights(
        np.array([5]), np.array([1]), np.array([[0.0, 0.6, 0.8]]), np.array([2.0]), np.array([20.0])
    )
    planes = Planes(
        np.array([2, 6]),
        np.array([0, 1]),
        rng.normal(size=(2, 3)),
        np.array([4.0, 5.0]),
        np.array([30.0, 20.0]),
        np.full(2, loss),
        np.full(2, 2.0),
    )
    precision = rng.normal(size=(3, 3))
    scales = ScalePriors(np.ones(3), precision @ precision.T)
    return Evidence(
        shape, sightings, Rig(cameras, np.array(poses)), up, lengths, heights, planes, scales
    )


def state_of(seed: int, poses: int) -> State:
    rng = np.random.default_rng(seed + 1)
    rotations = Rotation.random(poses, random_state=seed).as_matrix().reshape(poses, 9)
    return State(
        np.concatenate([rotations, np.tile([0.1, 0.2, 6.0], (poses, 1))], axis=1),
        0.1 * rng.normal(size=3),
        0.5 * rng.normal(size=MODES),
        0.02 * rng.normal(size=(POINTS, 3)),
    )


def seen_from(evidence: Evidence, state: State) -> Evidence:
    """The evidence that a state would give, but for 1 % of noise in the rays."""
    sightings, rig = evidence.sightings, evidence.rig
    seen = points_of(evidence.shape, state)[sightings.point]
    motions = state.poses[rig.pose[sightings.image]], rig.cam_from_rig[sightings.image]
    for motion in motions:
        rotations = motion[:, :9].reshape(-1, 3, 3)
        seen = np.einsum("nij,nj->ni", rotations, seen) + motion[:, 9:]
    noise = np.random.default_rng(0).normal(0, 0.01, (len(seen), 2))
    rays = seen[:, :2] / seen[:, 2:] + noise
    depths = np.stack([seen[:, 2], sightings.depths[:, 1]], axis=1)
    return evidence._replace(sightings=sightings._replace(rays=rays, depths=depths))


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    poses=st.sampled_from([(0, 0), (0, 1)]),
    loss=st.sampled_from([LINEAR, HUBER, CAUCHY]),
)
def test_the_gradient_is_that_of_the_cost(seed: int, poses: tuple[int, int], loss: int) -> None:
    evidence = evidence_of(seed, spread=0.0, poses=poses, loss=loss)
    state = state_of(seed, max(poses) + 1)
    system = empty_system(evidence)
    assert evaluate_joint(evidence, state, system) < np.inf
    moved, trial = copy_state(state), empty_system(evidence)
    slopes = np.empty(len(system.gradient))
    for k in range(len(slopes)):
        costs = []
        for size in (1e-6, -1e-6):
            step = np.zeros(len(slopes))
            step[k] = size
            move_state(evidence, state, system, step, moved)
            costs.append(evaluate_joint(evidence, moved, trial))
        slopes[k] = (costs[0] - costs[1]) / 4e-6  # the cost has no factor 1/2
    assert np.allclose(slopes, system.gradient, rtol=1e-5, atol=1e-7 * np.abs(slopes).max())


@pytest.mark.parametrize("poses", [(0, 0), (0, 1)])
def test_the_minimum_has_no_slope_in_displacements_either(poses: tuple[int, int]) -> None:
    evidence = evidence_of(3, spread=0.05, poses=poses, loss=LINEAR)
    state = state_of(3, max(poses) + 1)
    evidence = seen_from(evidence, state)
    cost, _, converged = refine_joint(evidence, 300, state)
    assert converged
    assert cost < np.inf
    system = empty_system(evidence)
    evaluate_joint(evidence, state, system)
    size = np.sqrt(cost * system.hessian.diagonal())
    assert np.abs(system.gradient / size).max() < 1e-4
    # A displacement that is at its best stays where it is.
    moved = copy_state(state)
    move_state(evidence, state, system, np.zeros(len(system.gradient)), moved)
    assert np.abs(moved.displacements - state.displacements).max() < 1e-5


def test_eliminated_displacements_equal_modes_of_the_same_deviation() -> None:
    spread = 0.05
    evidence = evidence_of(5, spread=spread, poses=(0, 0), loss=LINEAR)
    each = spread * np.eye(3 * POINTS).reshape(-1, POINTS, 3)
    evidence = seen_from(evidence, state_of(5, 1))
    free = evidence.scales._replace(free=np.zeros(3))
    evidence = evidence._replace(
        scales=free,
        lengths=Lengths(*(column[:0] for column in evidence.lengths)),
        heights=Heights(*(column[:0] for column in evidence.heights)),
        planes=Planes(*(column[:0] for column in evidence.planes)),
    )
    as_modes = evidence._replace(
        shape=Shape(
            evidence.shape.mean,
            np.concatenate([evidence.shape.modes, each]),
            np.zeros(POINTS),
        )
    )
    state = state_of(5, 1)
    state.displacements[:] = 0
    state.log_scales[:] = 0
    other = State(
        state.poses.copy(),
        state.log_scales.copy(),
        np.concatenate([state.coefficients, np.zeros(3 * POINTS)]),
        state.displacements.copy(),
    )
    first, _, _ = refine_joint(evidence, 300, state)
    second, _, _ = refine_joint(as_modes, 300, other)
    assert np.isclose(first, second, rtol=1e-8)
    assert np.allclose(state.poses, other.poses, atol=1e-5)
    found = points_of(evidence.shape, state), points_of(as_modes.shape, other)
    assert np.allclose(*found, atol=1e-5)
    unknowns, points, seen = joint_covariance(evidence, state)
    all_of_them, of_modes, seen_of_modes = joint_covariance(as_modes, other)
    assert np.allclose(unknowns[:6, :6], all_of_them[:6, :6], rtol=1e-3, atol=1e-9)
    assert np.allclose(points, of_modes, rtol=1e-3, atol=1e-8)
    assert np.allclose(seen, seen_of_modes, rtol=1e-3, atol=1e-8)


@pytest.mark.parametrize("poses", [(0, 0), (0, 1)])
def test_covariances_of_points_are_propagated_from_the_unknowns(poses: tuple[int, int]) -> None:
    evidence = evidence_of(4, spread=0.0, poses=poses, loss=LINEAR)
    state = state_of(4, max(poses) + 1)
    found = joint_covariance(evidence, state)
    system, moved = empty_system(evidence), copy_state(state)

    def in_model_and_camera(step: np.ndarray) -> np.ndarray:
        move_state(evidence, state, system, step, moved)
        places = [points_of(evidence.shape, moved)]
        for motion in (moved.poses[poses[0]], evidence.rig.cam_from_rig[0]):
            places.append(places[-1] @ motion[:9].reshape(3, 3).T + motion[9:])
        return np.stack([places[0], places[2]])

    steps = 1e-6 * np.eye(len(found.unknowns))
    ends = [in_model_and_camera(step) - in_model_and_camera(-step) for step in steps]
    slopes = np.moveaxis(np.array(ends) / 2e-6, 0, -1)
    expected = slopes @ found.unknowns @ slopes.swapaxes(-1, -2)
    size = np.abs(expected).max()
    assert np.allclose(expected, [found.points, found.seen], rtol=1e-5, atol=1e-7 * size)
