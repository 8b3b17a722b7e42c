"""Instances without a mesh, methods by name, and the Cramer-Rao bound as a method."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign import Alignment, fit
from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError, TooFewVisibleError
from cadalign.evaluation.instances.instance import (
    KEYPOINT_CAMERA,
    Instance,
    KeypointHull,
    KeypointTask,
    make_hull_instances,
    sample_hull_view,
    sample_hull_views,
)
from cadalign.evaluation.methods import LIMIT, fit_methods, fit_options
from cadalign.evaluation.metrics.errors import limit_estimate
from cadalign.evaluation.simulation import SimulatedProblem, simulate_problem
from cadalign.geometry.alignment import Box
from cadalign.geometry.camera import Camera, projection_jacobian
from cadalign.geometry.symmetry import Symmetry
from cadalign.metrics import rotation_error

CUBE = np.array([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)]) / 4


def cloud(seed: int = 0, count: int = 14) -> FloatArray:
    return np.random.default_rng(seed).uniform(-0.3, 0.3, (count, 3)) + [0.05, -0.1, 0.1]


def test_only_the_far_corner_of_a_cube_is_hidden_from_a_corner() -> None:
    visible = KeypointHull(CUBE).visible_from(np.array([4.0, 4.0, 4.0]))
    assert visible.tolist() == [False] + [True] * 7


def test_the_far_face_of_a_cube_is_hidden_from_the_front() -> None:
    visible = KeypointHull(CUBE).visible_from(np.array([0.0, 0.0, 9.0]))
    assert visible.tolist() == (CUBE[:, 2] > 0).tolist()


@pytest.mark.parametrize("points", [CUBE[:3], CUBE[CUBE[:, 0] > 0]])
def test_keypoints_without_a_hull_are_all_visible(points: FloatArray) -> None:
    assert KeypointHull(points).visible_from(np.array([0.0, 3.0, 0.0])).all()


@pytest.mark.parametrize("seed", range(8))
def test_views_fill_the_image_and_stay_inside(seed: int) -> None:
    hull = KeypointHull(cloud(seed))
    rng = np.random.default_rng(seed)
    pose, visible = sample_hull_view(hull, KEYPOINT_CAMERA, rng=rng, min_visible=6)
    corners = Box.from_model(hull.bounds, pose).corners
    offset = np.abs(KEYPOINT_CAMERA.project(corners) - [319.5, 239.5])
    share = (2 * offset / [640, 480]).max()
    assert 0.7 - 1e-9 <= share <= 0.95 + 1e-9
    assert visible.sum() >= 6
    up = pose.rotation[:, 1]
    assert up[1] < 0
    assert abs(up[0]) < 1e-12
    assert np.linalg.det(pose.rotation) == pytest.approx(1.0)


def test_too_few_keypoints_are_an_error_that_says_how_many() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(DegenerateError, match="there are only 5"):
        sample_hull_view(KeypointHull(cloud(count=5)), KEYPOINT_CAMERA, rng=rng, min_visible=6)
    with pytest.raises(DegenerateError, match="the best of 100 views shows"):
        sample_hull_view(KeypointHull(CUBE), KEYPOINT_CAMERA, rng=rng, min_visible=8)


def test_views_drawn_together_equal_views_drawn_alone() -> None:
    hulls = [KeypointHull(cloud(seed, count)) for seed, count in enumerate((14, 5, 9, 30))]
    hulls.append(KeypointHull(CUBE))

    def streams() -> list[np.random.Generator]:
        return [np.random.default_rng(seed) for seed in range(len(hulls))]

    together = sample_hull_views(hulls, KEYPOINT_CAMERA, rngs=streams(), min_visible=8)
    for hull, rng, found in zip(hulls, streams(), together, strict=True):
        (alone,) = sample_hull_views([hull], KEYPOINT_CAMERA, rngs=[rng], min_visible=8)
        if isinstance(found, TooFewVisibleError):
            assert str(found) == str(alone)
            continue
        assert not isinstance(alone, TooFewVisibleError)
        assert found[0] == alone[0]
        assert np.array_equal(found[1], alone[1])
    kinds = [isinstance(found, TooFewVisibleError) for found in together]
    assert kinds == [False, True, False, False, True]


def task(model_id: str = "a", view: int = 0) -> KeypointTask:
    return KeypointTask(
        category="chair",
        model_id=model_id,
        view=view,
        hull=KeypointHull(cloud()),
        ids=np.arange(14),
        symmetry=Symmetry.none(),
        model=None,
    )


def instance_of(view: KeypointTask, *, noise_px: float, seed: int = 0) -> Instance:
    (instance,) = make_hull_instances([view], noise_px=noise_px, min_visible=6, seed=seed)
    assert isinstance(instance, Instance)
    return instance


def test_without_noise_the_truth_reprojects_exactly_and_is_found() -> None:
    instance = instance_of(task(), noise_px=0.0)
    projected = instance.camera.project(instance.gt.apply(instance.points_3d))
    assert np.allclose(projected, instance.points_2d)
    result = fit(instance.points_3d, instance.points_2d, instance.camera)
    assert np.allclose(result.alignment.scale, instance.gt.scale, rtol=1e-6)
    assert instance.visibility == "hull"
    assert (instance.gt.scale[1:] >= 0.5).all()
    assert (instance.gt.scale[1:] <= 2).all()


def test_instances_depend_only_on_seed_and_names() -> None:
    first = instance_of(task(), noise_px=1.0).points_2d
    assert np.array_equal(first, instance_of(task(), noise_px=1.0).points_2d)
    others = (task(), 1), (task("b"), 0), (task(view=1), 0)
    for other in (instance_of(view, noise_px=1.0, seed=seed).points_2d for view, seed in others):
        assert first.shape != other.shape or not np.array_equal(first, other)
    views = [task("b"), task(), task(view=1)]
    together = make_hull_instances(views, noise_px=1.0, min_visible=6, seed=0)
    assert isinstance(together[1], Instance)
    assert np.array_equal(first, together[1].points_2d)


def cramer_rao_bound(problem: SimulatedProblem, *, sigma: float) -> FloatArray:
    """Inverse Fisher information (9, 9) at the truth, ordered as `cadalign.Result.covariance`."""
    used = np.delete(np.arange(9), 6)  # x has the scale 1
    jacobian = projection_jacobian(problem.points_3d, problem.camera, problem.alignment)
    rows = jacobian[:, :, used].reshape(-1, len(used)) / sigma
    covariance = np.zeros((9, 9))
    covariance[np.ix_(used, used)] = np.linalg.inv(rows.T @ rows)
    return covariance


@pytest.mark.long
def test_errors_of_the_limit_have_the_cramer_rao_bound_as_covariance() -> None:
    rng = np.random.default_rng(0)
    problem = simulate_problem(rng, points=12, noise_px=0.0)
    gt = problem.alignment
    steps = []
    for _ in range(4000):
        noisy = problem.points_2d + 0.01 * rng.standard_normal(problem.points_2d.shape)
        est = limit_estimate(problem.points_3d, noisy, problem.camera, gt)
        turn = est.rotation @ gt.rotation.T
        vector = np.array(
            [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
        )
        steps.append(
            [*vector / 2, *(est.translation - gt.translation), *np.log(est.scale / gt.scale)[1:]]
        )
    bound = cramer_rao_bound(problem, sigma=0.01)
    bound = np.delete(np.delete(bound, 6, axis=0), 6, axis=1)  # x has the scale 1
    spread = np.sqrt(np.diag(bound))
    assert np.allclose(np.std(steps, axis=0) / spread, 1.0, atol=0.05)
    correlation = np.cov(np.transpose(steps)) / np.outer(spread, spread)
    assert np.allclose(correlation, bound / np.outer(spread, spread), atol=0.08)


def test_the_covariance_of_a_fit_without_noise_is_the_cramer_rao_bound() -> None:
    for seed in range(20):
        problem = simulate_problem(np.random.default_rng(seed), points=12, noise_px=0.0)
        result = fit(problem.points_3d, problem.points_2d, problem.camera, sigma=1.0)
        bound = cramer_rao_bound(problem, sigma=1.0)
        spread = np.sqrt(bound.diagonal())
        gap = np.abs(result.fisher_covariance - bound)
        assert (gap <= 1e-3 * np.outer(spread, spread)).all()


def test_the_limit_refuses_keypoints_in_one_plane() -> None:
    points = cloud()
    points[:, 2] = 0.0
    gt = Alignment(np.eye(3), [0, 0, 3], [1, 1, 1])
    camera = Camera.from_fov(640, 480, fov_x=60.0)
    with pytest.raises(DegenerateError, match="do not determine"):
        limit_estimate(points, camera.project(gt.apply(points)), camera, gt)


@pytest.mark.parametrize("name", [name for name in fit_methods() if name != LIMIT])
def test_every_method_solves_an_easy_problem(name: str) -> None:
    problem = simulate_problem(
        np.random.default_rng(4), points=30, noise_px=0.0, stretch=(1.0, 1.0)
    )
    result = fit(
        problem.points_3d,
        problem.points_2d,
        problem.camera,
        **fit_options(name, sigma=1.0, ransac=None),
    )
    assert rotation_error(est=result.alignment, gt=problem.alignment) < 1e-3
