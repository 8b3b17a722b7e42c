"""The search with the shape eliminated, against the joint estimate with the shape as unknowns."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cadalign.arrays import FloatArray
from cadalign.solvers.constants import CAUCHY, HUBER, LINEAR
from cadalign.solvers.marginal.equations import empty_equations, evaluate
from cadalign.solvers.marginal.posterior import posterior_of
from cadalign.solvers.marginal.problem import Guess, Mixture, Seen, guess_at, shape_at, target_of
from cadalign.solvers.marginal.refine import refine_pose
from cadalign.solvers.marginal.search import search_view

KEYPOINTS, COMPONENTS = 9, 2


def problem_of(seed: int, loss: int = LINEAR) -> tuple[Mixture, Seen, FloatArray]:
    """A mixture, a view of a sample of its first component, and the true pose."""
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


def stacked_cost(mixture: Mixture, seen: Seen, pose: FloatArray, offset: FloatArray) -> float:
    """Squared residuals and the prior of the shape, written out."""
    target = target_of(mixture, 0, seen)
    camera = (target.mean + offset) @ pose[:9].reshape(3, 3).T + pose[9:]
    errors = (camera[:, :2] / camera[:, 2:] - seen.rays) * seen.whitening[:, ::2]
    flat = offset.ravel()
    return float((errors**2).sum() + flat @ np.linalg.solve(target.covariance, flat))


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000))
def test_a_minimum_is_one_of_pose_and_shape_together(seed: int) -> None:
    mixture, seen, pose = problem_of(seed)
    guess = guess_at(pose, 7)
    cost, _, _, converged = refine_pose(target_of(mixture, 0, seen), seen, 100, guess)
    assert converged
    assert cost == pytest.approx(stacked_cost(mixture, seen, guess.pose, guess.offset), rel=1e-6)
    rng = np.random.default_rng(seed)
    for _ in range(20):
        turn = Rotation.from_rotvec(rng.normal(0, 1e-3, 3)).as_matrix()
        moved = np.concatenate(
            [
                (turn @ guess.pose[:9].reshape(3, 3)).ravel(),
                guess.pose[9:] + rng.normal(0, 1e-3, 3),
            ]
        )
        offset = guess.offset + rng.normal(0, 1e-3, (7, 3))
        assert stacked_cost(mixture, seen, moved, offset) > cost


@pytest.mark.parametrize("loss", [LINEAR, HUBER, CAUCHY])
def test_the_search_finds_the_pose_and_its_component(loss: int) -> None:
    for seed in range(5):
        mixture, seen, pose = problem_of(seed, loss)
        minima, count, _, _ = search_view(mixture, seen, np.empty((0, 12)))
        assert count > 0
        assert minima.component[0] == 0
        best = minima.poses[0, :9].reshape(3, 3)
        cosine = (np.trace(best.T @ pose[:9].reshape(3, 3)) - 1) / 2
        assert np.degrees(np.arccos(min(cosine, 1.0))) < 6
        assert (np.diff(minima.scores[:count]) >= 0).all()


def test_a_given_start_is_searched_from() -> None:
    mixture, seen, pose = problem_of(3)
    without, _, _, starts = search_view(mixture, seen, np.empty((0, 12)))
    given_one, _, _, more = search_view(mixture, seen, pose[None])
    assert more == starts + 1
    assert given_one.scores[0] <= without.scores[0] + 1e-6


def test_the_posterior_is_the_inverse_information_of_pose_and_shape() -> None:
    mixture, seen, pose = problem_of(1)
    guess = guess_at(pose, 7)
    refine_pose(target_of(mixture, 0, seen), seen, 100, guess)
    points, covariance, of_points, of_seen = posterior_of(mixture, 0, seen, guess, 1.0)
    assert points == pytest.approx(shape_at(mixture, 0, seen, guess.force))
    size = mixture.means[0].size
    rotation = guess.pose[:9].reshape(3, 3)
    rows = np.zeros((14, 6 + size))
    for n, point in enumerate(seen.points):
        turned = rotation @ points[point]
        x, y, z = turned + guess.pose[9:]
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
    behind = np.concatenate([pose[:9], -pose[9:]])
    guess = Guess(behind, np.zeros((7, 3)), np.zeros((7, 3)))
    assert evaluate(target_of(mixture, 0, seen), seen, guess, empty_equations(7)) == np.inf
    assert refine_pose(target_of(mixture, 0, seen), seen, 10, guess)[0] == np.inf
