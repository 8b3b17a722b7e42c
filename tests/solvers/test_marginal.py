"""Search with the shape integrated out, against a joint estimate of pose and shape."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cadalign.arrays import FloatArray
from cadalign.estimation.estimates import single_posterior
from cadalign.solvers.constants import CAUCHY, HUBER, LINEAR
from cadalign.solvers.marginal.equations import (
    POSE,
    Marginal,
    empty_marginal_equations,
    evaluate_marginal,
    marginal_cost,
)
from cadalign.solvers.marginal.problem import Mixture, Seen, mixture_at, shape_at, target_of
from cadalign.solvers.marginal.search import search_view
from cadalign.solvers.search import refine
from cadalign.solvers.unknowns import move_rigid

KEYPOINTS, COMPONENTS = 9, 2


def problem_of(seed: int, loss: int = LINEAR) -> tuple[Mixture, Seen, FloatArray]:
    """A mixture, keypoints of a sample of its first component, and the true pose."""
    rng = np.random.default_rng(seed)
    points = KEYPOINTS + 2
    means = rng.uniform(-1, 1, (COMPONENTS, points, 3))
    modes = rng.normal(0, 0.1, (COMPONENTS, 4, 3 * points))
    covariances = np.einsum("gki,gkj->gij", modes, modes) + 1e-4 * np.eye(3 * points)
    shape = means[0] + (rng.normal(size=4) @ modes[0]).reshape(points, 3)
    rotation = Rotation.random(random_state=seed).as_matrix()
    pose = np.concatenate([rotation.ravel(), [0.2, -0.1, 6.0]])
    seen = rng.permutation(KEYPOINTS)[:7]
    camera = shape[seen] @ rotation.T + pose[9:]
    rays = camera[:, :2] / camera[:, 2:] + rng.normal(0, 1e-3, (7, 2))
    whitening = np.tile([1e3, 0.0, 1e3], (7, 1))
    penalties = -2 * np.log([0.7, 0.3])
    return Mixture(means, covariances, penalties), Seen(seen, rays, whitening, loss, 2.0), pose


def state_at(pose: FloatArray, keypoints: int) -> FloatArray:
    """The state of the mean at a pose (12,)."""
    return np.append(pose, np.zeros(6 * keypoints))


def stacked_cost(system: Marginal, state: FloatArray) -> float:
    """Cost of pose and shape computed with dense matrices."""
    (mean, covariance), seen = system.target, system.seen
    flat = state[POSE : POSE + mean.size]
    rotation = state[:9].reshape(3, 3)
    camera = (mean + flat.reshape(-1, 3)) @ rotation.T + state[9:POSE]
    errors = (camera[:, :2] / camera[:, 2:] - seen.rays) * seen.whitening[:, ::2]
    cost = float((errors**2).sum() + flat @ np.linalg.solve(covariance, flat))
    if not system.integrates:
        return cost
    rows = np.zeros((mean.shape[0], 2, mean.size))
    for n, ((x, y, z), (a, _, c)) in enumerate(zip(camera, seen.whitening, strict=True)):
        by_camera = np.array([[a / z, 0, -a * x / z**2], [0, c / z, -c * y / z**2]])
        rows[n, :, 3 * n : 3 * n + 3] = by_camera @ rotation
    by_shape = rows.reshape(-1, mean.size)
    matrix = np.eye(len(by_shape)) + by_shape @ covariance @ by_shape.T
    return cost + float(np.linalg.slogdet(matrix)[1])


def move_state(state: FloatArray, step: FloatArray, offset: FloatArray) -> FloatArray:
    """State after a step (6,) of the pose and a step (3 n,) of the offsets."""
    found = state.copy()
    move_rigid(state, step, found)
    found[POSE : POSE + offset.size] += offset
    return found


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.booleans())
def test_a_minimum_is_a_minimum_of_pose_and_shape(seed: int, integrates: bool) -> None:
    mixture, seen, pose = problem_of(seed)
    system = Marginal(target_of(mixture_at(mixture, seen), 0), seen, integrates)
    state = state_at(pose, 7)
    cost, _, converged = refine(system, 100, state)
    assert converged
    assert cost == pytest.approx(stacked_cost(system, state), rel=1e-6)
    assert cost == pytest.approx(marginal_cost(system, state))
    rng = np.random.default_rng(seed)
    for _ in range(20):
        near = move_state(state, rng.normal(0, 1e-3, 6), rng.normal(0, 1e-3, 21))
        assert stacked_cost(system, near) > cost


@pytest.mark.parametrize("loss", [LINEAR, HUBER, CAUCHY])
def test_derivatives_of_the_determinant_equal_finite_differences(loss: int) -> None:
    mixture, seen, pose = problem_of(2, loss)
    seen.rays[0] += 0.02  # an outlier
    system = Marginal(target_of(mixture_at(mixture, seen), 0), seen, True)
    state = state_at(pose, 7)
    force = np.random.default_rng(2).normal(0, 0.5, 21)
    state[POSE:] = np.concatenate([system.target.covariance @ force, force])
    room = empty_marginal_equations(system)

    def log_determinant(step: FloatArray) -> float:
        evaluate_marginal(system, move_state(state, step[:6], step[6:]), room)
        return float(room.sums[1])

    by_difference = [
        (log_determinant(step) - log_determinant(-step)) / 4e-5 for step in 1e-5 * np.eye(27)
    ]
    evaluate_marginal(system, state, room)
    derivatives = np.concatenate([room.pose_slope, room.slope])
    assert derivatives == pytest.approx(np.array(by_difference), rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("loss", [LINEAR, HUBER, CAUCHY])
def test_the_search_finds_the_pose_and_its_component(loss: int) -> None:
    for seed in range(5):
        mixture, seen, pose = problem_of(seed, loss)
        minima, _ = search_view(mixture, seen, np.empty((0, 12)))
        count = minima.counts[0]
        assert count > 0
        assert minima.label[0] == 0
        best = minima.states[0, :9].reshape(3, 3)
        cosine = (np.trace(best.T @ pose[:9].reshape(3, 3)) - 1) / 2
        assert np.degrees(np.arccos(min(cosine, 1.0))) < 6
        assert (np.diff(minima.scores[:count]) >= 0).all()


def test_a_given_start_is_used() -> None:
    mixture, seen, pose = problem_of(3)
    without, starts = search_view(mixture, seen, np.empty((0, 12)))
    given_one, more = search_view(mixture, seen, pose[None])
    assert more == starts + 1
    assert given_one.scores[0] <= without.scores[0] + 1e-6


def test_the_posterior_is_the_inverse_information_of_pose_and_shape() -> None:
    mixture, seen, pose = problem_of(1)
    state = state_at(pose, 7)
    refine(Marginal(target_of(mixture_at(mixture, seen), 0), seen, False), 100, state)
    found = single_posterior(mixture, 0, seen, state, 1.0)
    (covariance,), of_points, of_seen = (
        found.covariances,
        found.points_covariance,
        found.points_cam_covariance,
    )
    points = shape_at(mixture, 0, seen, state)
    assert found.points[:KEYPOINTS] == pytest.approx(points[:KEYPOINTS])
    size = mixture.means[0].size
    rotation = state[:9].reshape(3, 3)
    rows = np.zeros((14, 6 + size))
    for n, point in enumerate(seen.points):
        turned = rotation @ points[point]
        x, y, z = turned + state[9:POSE]
        by_camera = 1e3 * np.array([[1 / z, 0, -x / z**2], [0, 1 / z, -y / z**2]])
        by_turn = np.cross(np.eye(3), turned).T  # columns: axis x turned
        rows[2 * n : 2 * n + 2, :3] = by_camera @ by_turn
        rows[2 * n : 2 * n + 2, 3:6] = by_camera
        rows[2 * n : 2 * n + 2, 6 + 3 * point : 9 + 3 * point] = by_camera @ rotation
    information = rows.T @ rows
    information[6:, 6:] += np.linalg.inv(mixture.covariances[0])
    whole = np.linalg.inv(information)
    assert covariance[:6, :6] == pytest.approx(whole[:6, :6], rel=1e-6, abs=1e-12)
    for i, point in enumerate(points):
        own = slice(6 + 3 * i, 9 + 3 * i)
        assert of_points[i] == pytest.approx(whole[own, own], rel=1e-6, abs=1e-10)
        by_all = np.zeros((3, 6 + size))
        by_all[:, :3] = np.cross(np.eye(3), rotation @ point).T
        by_all[:, 3:6] = np.eye(3)
        by_all[:, own] = rotation
        assert of_seen[i] == pytest.approx(by_all @ whole @ by_all.T, rel=1e-6, abs=1e-10)
    difference = np.zeros((3, 6 + size))
    difference[:, -3:], difference[:, -6:-3] = np.eye(3), -np.eye(3)
    extent = points[-1] - points[-2]
    by_length = np.where(extent[:, None] > 0, difference / extent[:, None], 0.0)
    expected = by_length @ whole @ by_length.T
    assert covariance[6:, 6:] == pytest.approx(expected, rel=1e-6, abs=1e-10)


def test_points_behind_the_camera_have_no_cost() -> None:
    mixture, seen, pose = problem_of(0)
    behind = state_at(np.concatenate([pose[:9], -pose[9:]]), 7)
    system = Marginal(target_of(mixture_at(mixture, seen), 0), seen, True)
    assert evaluate_marginal(system, behind, empty_marginal_equations(system)) == np.inf
    assert marginal_cost(system, behind) == np.inf
    assert refine(system, 10, behind)[0] == np.inf
