"""Robust fits find the inliers, and refuse keypoints without any."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.problems import with_outliers

from cadalign import Camera, RansacOptions, fit, fit_batch
from cadalign.errors import NoConsensusError
from cadalign.evaluation.simulation import simulate_problem
from cadalign.metrics import rotation_error

CAMERA = Camera(width=640, height=480, fx=935.0, fy=935.0, cx=319.5, cy=239.5)


def spoiled(seed: int, *, points: int, outliers: int, noise_px: float = 1.0) -> tuple[Any, ...]:
    """A problem with some image points moved by 15 px or more, and the indices of these."""
    rng = np.random.default_rng(seed)
    problem = simulate_problem(
        rng, points=points, noise_px=noise_px, camera=CAMERA, depth=(6.0, 9.0)
    )
    wrong = rng.choice(points, outliers, replace=False)
    points_2d = with_outliers(problem.points_2d, wrong, rng)
    mask = np.zeros(points, dtype=bool)
    mask[wrong] = True
    return problem, points_2d, mask


@pytest.mark.parametrize("share", [0.0, 0.5, 0.8])
def test_outliers_are_found_and_the_rest_is_fitted(share: float) -> None:
    problem, points_2d, wrong = spoiled(1, points=200, outliers=round(200 * share))
    result = fit(problem.points_3d, points_2d, CAMERA, ransac=RansacOptions())
    assert not result.inliers[wrong].any()
    assert result.inliers[~wrong].mean() > 0.98
    alone = fit(problem.points_3d[result.inliers], points_2d[result.inliers], CAMERA)
    assert result.alignment == alone.alignment
    assert rotation_error(est=result.alignment, gt=problem.alignment) < 1.0
    assert result.rms < 2.0


@pytest.mark.long
def test_wrong_ones_among_eight_keypoints_are_found() -> None:
    found = refused = 0
    for seed in range(50):
        problem, points_2d, wrong = spoiled(seed, points=8, outliers=2)
        try:
            result = fit(problem.points_3d, points_2d, CAMERA, ransac=RansacOptions())
        except NoConsensusError:
            refused += 1
            continue
        found += bool((result.inliers == ~wrong).all())
    assert found >= 45
    assert found + refused >= 48


def test_few_keypoints_are_searched_exhaustively() -> None:
    problem, points_2d, _ = spoiled(0, points=8, outliers=2)
    result = fit(problem.points_3d, points_2d, CAMERA, ransac=RansacOptions())
    assert result.stats.iterations == 70
    other = fit(problem.points_3d, points_2d, CAMERA, ransac=RansacOptions(seed=9))
    assert other.alignment == result.alignment


def test_the_same_seed_gives_the_same_result() -> None:
    problem, points_2d, _ = spoiled(2, points=100, outliers=60)
    results = [
        fit(problem.points_3d, points_2d, CAMERA, ransac=RansacOptions(seed=seed))
        for seed in (5, 5, 6)
    ]
    assert results[0].alignment == results[1].alignment
    assert results[0].stats.iterations == results[1].stats.iterations
    assert results[0].stats.hypotheses == results[1].stats.hypotheses
    assert results[0].stats.hypotheses != results[2].stats.hypotheses


@pytest.mark.parametrize("shape", ["sigmas", "covariances"])
def test_keypoints_with_their_own_sigmas_have_the_threshold_of_these(shape: str) -> None:
    problem, points_2d, _ = spoiled(4, points=60, outliers=20, noise_px=2.0)
    own = np.full(60, 2.0) if shape == "sigmas" else np.tile(4.0 * np.eye(2), (60, 1, 1))
    given = problem.points_3d, points_2d, CAMERA
    one = fit(*given, sigma=2.0, ransac=RansacOptions())
    each = fit(*given, sigma=own, ransac=RansacOptions())
    assert (each.inliers == one.inliers).all()
    np.testing.assert_allclose(each.alignment.vector, one.alignment.vector, atol=1e-6)


def test_order_of_the_keypoints_does_not_matter() -> None:
    problem, points_2d, wrong = spoiled(6, points=120, outliers=70)
    order = np.random.default_rng(0).permutation(120)
    scores = np.where(wrong, 0.3, 0.7) + np.random.default_rng(1).uniform(0, 0.3, 120)
    for trusted in (None, scores):
        plain = fit(problem.points_3d, points_2d, CAMERA, ransac=RansacOptions(), scores=trusted)
        mixed = fit(
            problem.points_3d[order],
            points_2d[order],
            CAMERA,
            ransac=RansacOptions(),
            scores=None if trusted is None else trusted[order],
        )
        np.testing.assert_array_equal(mixed.inliers, plain.inliers[order])
        np.testing.assert_allclose(mixed.alignment.scale, plain.alignment.scale, rtol=1e-6)


def test_trusted_inliers_are_sampled_first() -> None:
    problem, points_2d, wrong = spoiled(3, points=300, outliers=270)
    options = RansacOptions(min_iterations=1, max_iterations=100)
    trusted = fit(problem.points_3d, points_2d, CAMERA, ransac=options, scores=1.0 - wrong)
    assert not trusted.inliers[wrong].any()
    assert trusted.inliers[~wrong].mean() > 0.9


def test_linear_minimal_set_is_the_papers() -> None:
    problem, points_2d, wrong = spoiled(4, points=200, outliers=60, noise_px=0.3)
    options = RansacOptions(minimal="aepnp", refine=False)
    result = fit(problem.points_3d, points_2d, CAMERA, ransac=options)
    assert result.method == "ransac-aepnp"
    assert result.covariance is None
    refined = fit(problem.points_3d, points_2d, CAMERA, ransac=RansacOptions(minimal="aepnp"))
    assert not refined.inliers[wrong].any()
    assert rotation_error(est=refined.alignment, gt=problem.alignment) < rotation_error(
        est=result.alignment, gt=problem.alignment
    )


def test_batch_equals_single_fits_and_keeps_errors() -> None:
    cases = [spoiled(seed, points=n, outliers=n // 4) for seed, n in ((0, 12), (1, 40), (2, 9))]
    points_3d = [problem.points_3d for problem, _, _ in cases]
    points_2d = [pixels for _, pixels, _ in cases]
    rng = np.random.default_rng(0)
    points_3d.append(rng.uniform(-1, 1, (8, 3)))
    points_2d.append(rng.uniform(0, 400, (8, 2)))
    for workers in (1, 2):
        batch = fit_batch(points_3d, points_2d, CAMERA, ransac=RansacOptions(), workers=workers)
        for b in range(3):
            alone = fit(points_3d[b], points_2d[b], CAMERA, ransac=RansacOptions())
            assert batch.alignment(b) == alone.alignment
            assert (batch[b].inliers == alone.inliers).all()
        assert isinstance(batch.errors[3], NoConsensusError)
        assert np.isnan(batch.rotation[3]).all()


@pytest.mark.long
@pytest.mark.parametrize("points", [8, 300])
def test_random_correspondences_are_refused(points: int) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        points_3d = rng.uniform(-1, 1, (points, 3))
        points_2d = rng.uniform([0, 0], [640, 480], (points, 2))
        with pytest.raises(NoConsensusError, match="no alignment is supported"):
            fit(points_3d, points_2d, CAMERA, ransac=RansacOptions(seed=seed))


def test_scores_that_are_all_alike_guide_nothing() -> None:
    problem, points_2d, _ = spoiled(3, points=60, outliers=20)
    options = RansacOptions()
    alike = fit(problem.points_3d, points_2d, CAMERA, ransac=options, scores=np.full(60, 0.7))
    blind = fit(problem.points_3d, points_2d, CAMERA, ransac=options)
    assert alike.alignment == blind.alignment
    assert alike.stats.iterations == blind.stats.iterations


def test_what_is_advised_for_keypoints_in_one_plane_fits_them() -> None:
    problem, _, _ = spoiled(0, points=30, outliers=0)
    flat = problem.points_3d * [1, 1, 0]
    points_2d = CAMERA.project(problem.alignment.apply(flat))
    alone = fit(flat, points_2d, CAMERA, stretch="y", loss="cauchy")
    assert alone.rms < 1e3


@pytest.mark.parametrize("minimal", ["ap4p", "aepnp"])
def test_unknown_focal_length_is_found_by_either_minimal_solver(minimal: str) -> None:
    problem, points_2d, wrong = spoiled(0, points=40, outliers=8)
    camera = Camera.from_size(CAMERA.width, CAMERA.height)
    ransac = RansacOptions(minimal=minimal)
    result = fit(problem.points_3d, points_2d, camera, focal="estimate", ransac=ransac)
    assert not result.inliers[wrong].any()
    assert result.inliers[~wrong].all()
    assert abs(np.log(result.camera.fx / CAMERA.fx)) < 3 * result.std.focal
    kept = result.inliers
    alone = fit(problem.points_3d[kept], points_2d[kept], camera, focal="estimate")
    assert result.alignment.scale == pytest.approx(alone.alignment.scale, rel=1e-5)
    assert result.camera.fx == pytest.approx(alone.camera.fx, rel=1e-5)
