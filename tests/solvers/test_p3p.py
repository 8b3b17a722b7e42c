"""Poses of 3 points, and the search without stretch that starts from them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from cadalign.arrays import FloatArray
from cadalign.evaluation.simulation import random_rotation
from cadalign.geometry.rotations import angles_between, rotation_from_vector
from cadalign.solvers.alignment import Objective
from cadalign.solvers.constants import LINEAR, ScalePrior
from cadalign.solvers.evidence import KeypointEvidence
from cadalign.solvers.minimal import MAX_POSES, p3p_kernel, p3p_memory, reflect
from cadalign.solvers.optimal import optimal_batch
from cadalign.solvers.ransac import rigid_hypotheses
from cadalign.solvers.search import Effort, empty_minima, search
from cadalign.solvers.starts import rotation_starts

RIGID = np.array([1.0] * 6 + [0.0, 0.0])
seeds = st.integers(0, 2**31)


def poses_of(points: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations (k, 3, 3) and translations (k, 3)."""
    poses = np.full((MAX_POSES, 15), np.nan)
    count = p3p_kernel(points, rays, np.arange(3), p3p_memory(), poses)
    return poses[:count, :9].reshape(-1, 3, 3), poses[:count, 9:12]


def project(points: FloatArray, rotation: FloatArray, translation: FloatArray) -> FloatArray:
    in_camera = points @ rotation.T + translation
    assert in_camera[:, 2].min() > 0
    return in_camera[:, :2] / in_camera[:, 2:]


@given(seeds, st.sampled_from([1.2, 4.0, 40.0, 4000.0]))
def test_the_true_pose_is_among_the_solutions(seed: int, distance: float) -> None:
    rng = np.random.default_rng(seed)
    points, rotation = rng.uniform(-0.5, 0.5, (3, 3)), random_rotation(rng)
    sides = points - np.roll(points, 1, axis=0)
    assume(np.linalg.norm(np.cross(sides[0], sides[1])) > 0.02)
    translation = distance * np.array([*rng.uniform(-0.3, 0.3, 2), 1.0])
    assume((points @ rotation.T + translation)[:, 2].min() > 0.1)
    rays = project(points, rotation, translation)
    rotations, translations = poses_of(points, rays)
    assert len(rotations) > 0
    for found, shift in zip(rotations, translations, strict=True):
        np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-9)
        np.testing.assert_allclose(project(points, found, shift), rays, atol=1e-4 / distance)
    assert min(angles_between(found, rotation) for found in rotations) < 0.1


@pytest.mark.parametrize("degrees", [0.0, 1.0, 30.0, 70.0])
def test_a_triangle_seen_along_its_axis_of_symmetry_is_solved(degrees: float) -> None:
    points = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.8, 0.0]])
    rotation = rotation_from_vector(np.radians([degrees, 0.0, 0.0]))
    rays = project(points, rotation, np.array([0.0, 0.0, 3.0]))
    for order in ([0, 1, 2], [2, 0, 1], [1, 2, 0]):
        rotations, _ = poses_of(points[order], rays[order])
        assert min(angles_between(found, rotation) for found in rotations) < 0.2


def test_collinear_and_coincident_points_have_no_pose() -> None:
    rays = np.array([[-0.1, 0.0], [0.0, 0.0], [0.1, 0.0]])
    for points in (np.outer([-1.0, 0.0, 1.0], [1.0, 0.0, 0.0]), np.ones((3, 3))):
        assert len(poses_of(points, rays)[0]) == 0
    assert len(poses_of(np.eye(3), np.zeros((3, 2)))[0]) == 0


@given(seeds)
def test_the_reflected_pose_of_points_in_a_plane_looks_alike_from_afar(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (6, 2)), np.zeros(6)]) @ random_rotation(rng)
    points -= points.mean(axis=0)
    pose = np.concatenate([random_rotation(rng).ravel(), [3.0, -2.0, 900.0], np.ones(3)])
    other = np.empty(15)
    reflect(points, pose, other)
    first, second = pose[:9].reshape(3, 3), other[:9].reshape(3, 3)
    assert np.linalg.det(second) == pytest.approx(1.0)
    rays = [project(points, each, pose[9:12]) for each in (first, second)]
    np.testing.assert_allclose(rays[0], rays[1], atol=2e-6)
    again = np.empty(15)
    reflect(points, other, again)
    np.testing.assert_allclose(again, pose, atol=1e-9)


@pytest.mark.parametrize("flatness", [1.0, 0.05, 0.0])
@pytest.mark.parametrize("count", [4, 5, 6, 12, 60])
def test_search_finds_the_minima_of_a_fine_grid_of_rotations(count: int, flatness: float) -> None:
    for seed in range(25):
        rng = np.random.default_rng([seed, count])
        points = rng.uniform(-0.5, 0.5, (count, 3)) * [1.0, 1.0, flatness]
        points -= points.mean(axis=0)
        translation = np.array([*rng.normal(0, 0.1, 2), rng.uniform(2.0, 6.0)])
        noise = rng.normal(0, 4e-3, (count, 2))
        in_camera = points @ random_rotation(rng).T + translation
        rays, whitening = in_camera[:, :2] / in_camera[:, 2:] + noise, np.array([[250.0, 0, 250.0]])
        given = np.ones(1), np.zeros(1), 0.0, RIGID, 3, True
        found = optimal_batch(points, rays, whitening, np.array([0, count]), LINEAR, *given)[1][0]
        grid, minima = np.empty((400, 15)), empty_minima(12, 15)
        keypoints = KeypointEvidence(points, rays, whitening, LINEAR, 1.0)
        starts = grid[: rotation_starts(points, rays, grid)]
        effort = Effort(80, 6, 200, np.inf)
        search(Objective(RIGID, keypoints, ScalePrior(0.0, 0.0)), starts, effort, 0, 0.0, minima)
        assert found[0] == pytest.approx(minima.costs[0], rel=1e-6, abs=1e-9)
        if minima.costs[1] < minima.costs[0] + 9.0:  # a second pose is similarly likely
            assert found[1] == pytest.approx(minima.costs[1], rel=1e-4, abs=1e-6)


def test_hypotheses_of_samples_are_their_rigid_optima() -> None:
    rng = np.random.default_rng(0)
    points, rotation = rng.uniform(-0.5, 0.5, (9, 3)), random_rotation(rng)
    translation = np.array([0.1, -0.2, 3.0])
    rays = project(points, rotation, translation) + rng.normal(0, 1e-3, (9, 2))
    rays[[2, 5]] += 0.2
    keypoints = KeypointEvidence(points, rays, np.array([[1e3, 0.0, 1e3]]), LINEAR, 1.0)
    draws = np.array([[0, 1, 3, 4], [8, 7, 6, 4], [0, 1, 2, 5]])
    poses, scores = rigid_hypotheses(keypoints, draws, 9.0)
    for row in (0, 1):
        assert angles_between(poses[row, :9].reshape(3, 3), rotation) < 1.0
        assert 2 * 9.0 <= scores[row] < 2 * 9.0 + 7 * 9.0
    assert scores[2] > scores[:2].max()
    nowhere = KeypointEvidence(np.ones((9, 3)), rays, keypoints.whitening, LINEAR, 1.0)
    assert np.isinf(rigid_hypotheses(nowhere, draws, 9.0)[1]).all()
