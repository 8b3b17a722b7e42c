"""`fit` with an unknown focal length: accuracy, calibration and refusals."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from support.problems import assert_same, moved, of_unknowns, problem_of, with_outliers

from cadalign import (
    Alignment,
    Camera,
    FocalPrior,
    Model,
    RansacOptions,
    Result,
    View,
    align,
    align_batch,
    fit,
    fit_batch,
)
from cadalign.errors import DegenerateError, NoConsensusError
from cadalign.evaluation.simulation import SIMULATION_CAMERA, SimulatedProblem
from cadalign.metrics import rotation_error

UNKNOWN = Camera.from_size(640, 480)
LONG = Camera(640, 480, 935.0, 935.0, 319.5, 239.5)


def fit_unknown(problem: SimulatedProblem, camera: Camera = UNKNOWN, **options: Any) -> Result:
    """Fit the focal length without a prior."""
    chosen = {"focal": "estimate", "focal_prior": None, **options}
    return fit(problem.points_3d, problem.points_2d, camera, **chosen)


def whitened(
    problem: SimulatedProblem, alignment: Alignment, camera: Camera, step: np.ndarray
) -> np.ndarray:
    """Residuals after a step of the 9 unknowns, in the documented order."""
    seen = camera.replace_focal(camera.fx * np.exp(step[8]))
    return seen.project(moved(alignment, step).apply(problem.points_3d)) - problem.points_2d


def spoiled(problem: SimulatedProblem, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Image points, some moved by 15 px or more, and the indices of these."""
    rng = np.random.default_rng(0)
    count = len(problem.points_2d)
    wrong = rng.permutation(count) < round(share * count)
    return with_outliers(problem.points_2d, np.flatnonzero(wrong), rng), wrong


# --- accuracy ---------------------------------------------------------------------------------


@pytest.mark.long
@given(
    seed=st.integers(0, 10_000),
    points=st.integers(7, 30),
    focal=st.floats(120, 3000),
)
def test_exact_keypoints_give_back_the_focal_length(seed: int, points: int, focal: float) -> None:
    camera = Camera(640, 480, focal, focal, 319.5, 239.5)
    problem = problem_of(
        seed, points=points, noise_px=0.0, camera=camera, depth=(3 + focal / 200, 4 + focal / 200)
    )
    result = fit_unknown(problem)
    assert result.camera.fx == pytest.approx(focal, rel=1e-5)
    assert result.camera.fy == result.camera.fx
    assert_same(result.alignment, problem.alignment, 1e-5)


@pytest.mark.long
@pytest.mark.parametrize("points", [5, 8])
def test_no_better_explanation_is_missed(points: int) -> None:
    missed = 0
    for seed in range(25):
        problem = problem_of(seed, points=points, noise_px=1.0)
        result = fit_unknown(problem)
        at_truth = whitened(problem, problem.alignment, SIMULATION_CAMERA, np.zeros(9))
        missed += (result.residuals**2).sum() > (at_truth**2).sum() * (1 + 1e-9)
    assert missed == 0


@pytest.mark.parametrize("loss", ["linear", "huber", "cauchy"])
@pytest.mark.parametrize("prior", [None, FocalPrior(160.0, 0.02)])
def test_result_is_a_minimum_over_all_nine_unknowns(loss: str, prior: FocalPrior | None) -> None:
    problem = problem_of(6, points=15, noise_px=3.0)
    result = fit_unknown(problem, loss=loss, sigma=2.0, focal_prior=prior)

    def cost(step: np.ndarray) -> float:
        squares = (whitened(problem, result.alignment, result.camera, step) ** 2).sum(axis=1) / 4
        lengths = np.sqrt(squares)
        if loss == "huber":
            squares = np.where(lengths > 2, 4 * lengths - 4, squares)
        elif loss == "cauchy":
            squares = 4 * np.log1p(squares / 4)
        off = 0.0 if prior is None else np.log(result.camera.fx / prior.focal) + step[8]
        return float(squares.sum() + (off / (prior.relative_sigma if prior else 1.0)) ** 2)

    here = cost(np.zeros(9))
    for k, deviation in enumerate(np.sqrt(of_unknowns(result.fisher_covariance).diagonal())):
        for sign in (1e-3, -1e-3):
            assert cost(sign * deviation * np.eye(9)[k]) >= here - 1e-9


def test_shape_of_pixels_and_principal_point_are_the_cameras() -> None:
    camera = Camera(640, 480, 500.0, 550.0, 280.0, 260.0)
    problem = problem_of(2, points=30, noise_px=0.0, camera=camera)
    for focal in (1000.0, 77.0):  # placeholders, which change nothing
        placeholder = dataclasses.replace(camera, fx=focal, fy=1.1 * focal)
        result = fit_unknown(problem, placeholder)
        assert result.camera.fx == pytest.approx(500.0, rel=1e-6)
        assert result.camera.fy == pytest.approx(550.0, rel=1e-6)
        assert (result.camera.cx, result.camera.cy) == (280.0, 260.0)


@pytest.mark.parametrize("stretch", [None, "none"])
def test_held_scales_are_honoured(stretch: str | None) -> None:
    problem = problem_of(4, points=20, noise_px=0.0)
    if stretch == "none":
        problem = dataclasses.replace(
            problem, points_3d=problem.points_3d * problem.alignment.scale
        )
    result = fit_unknown(problem, stretch=stretch)
    assert result.alignment.scale[0] == 1.0
    assert result.camera.fx == pytest.approx(150.0, rel=1e-5)
    known = fit(problem.points_3d, problem.points_2d, problem.camera, stretch=stretch)
    assert_same(result.alignment, known.alignment, 1e-5)
    where_known = result.fisher_covariance.diagonal()[:9] == 0
    assert (where_known == (known.fisher_covariance.diagonal() == 0)).all()


# --- calibration ------------------------------------------------------------------------------


def test_covariance_is_that_of_the_nine_unknowns() -> None:
    problem = problem_of(3, points=30, noise_px=1.0)
    result = fit_unknown(problem)
    found = least_squares(
        lambda step: whitened(problem, result.alignment, result.camera, step).ravel(),
        np.zeros(9),
        max_nfev=1,
    )
    np.testing.assert_allclose(
        of_unknowns(result.fisher_covariance),
        np.linalg.inv(found.jac.T @ found.jac),
        rtol=2e-3,
        atol=1e-9,
    )
    assert result.std.focal == pytest.approx(np.sqrt(result.covariance[9, 9]))
    assert result.std.focal >= np.sqrt(result.fisher_covariance[9, 9])


def test_known_focal_length_has_eight_unknowns_and_no_deviation() -> None:
    problem = problem_of(3)
    result = fit(problem.points_3d, problem.points_2d, problem.camera)
    assert result.camera == problem.camera
    assert result.focal == "known"
    assert result.fisher_covariance.shape == (9, 9)
    assert result.std.focal == 0.0


def test_weak_focal_length_is_said_in_words() -> None:
    problem = problem_of(1, points=40, noise_px=3.0, camera=LONG, depth=(12.0, 14.0))
    result = fit_unknown(problem, sigma=3.0)
    assert result.std.focal > 1.0
    assert "focal length" in result.uncertain
    assert f"  focal length {result.camera.fx:.4g} px (not determined)" in str(result)
    strong = fit_unknown(problem_of(1, points=200, noise_px=0.1), sigma=0.1)
    assert strong.std.focal < 0.01
    assert strong.uncertain == ()


@pytest.mark.parametrize("seed", [5, 13, 21])
def test_a_pose_that_fits_with_another_focal_length_is_found_beside_the_best(seed: int) -> None:
    problem = problem_of(seed, points=5, noise_px=0.5)
    (other, *_) = fit_unknown(problem).alternatives
    known = fit(problem.points_3d, problem.points_2d, other.camera)
    poses = [known.alignment, *(each.alignment for each in known.alternatives)]
    assert min(rotation_error(est=pose, gt=other.alignment) for pose in poses) < 0.5
    projected = other.camera.project(other.alignment.apply(problem.points_3d))
    assert np.abs(projected - problem.points_2d).max() < 20


def test_estimated_noise_comes_with_nine_unknowns() -> None:
    problem = problem_of(3, points=60, noise_px=2.5)
    result = fit_unknown(problem, sigma=None)
    expected = np.sqrt((result.residuals**2).sum() / (2 * 60 - 9))
    assert result.sigma == pytest.approx(expected, rel=5e-3)
    known = fit_unknown(problem, sigma=result.sigma)
    np.testing.assert_allclose(known.fisher_covariance, result.fisher_covariance, rtol=1e-4)


# --- priors -----------------------------------------------------------------------------------


def test_prior_takes_part_by_its_weight() -> None:
    problem = problem_of(2, points=20, noise_px=1.0)
    free = fit_unknown(problem)
    tight = fit_unknown(problem, focal_prior=FocalPrior(150.0, 1e-4))
    assert tight.camera.fx == pytest.approx(150.0, rel=1e-3)
    known = fit(problem.points_3d, problem.points_2d, problem.camera)
    assert_same(tight.alignment, known.alignment, 1e-3)
    assert tight.std.focal == pytest.approx(1e-4, rel=1e-2)
    loose = fit_unknown(problem, focal_prior=FocalPrior(150.0, 1e3))
    assert loose.camera.fx == pytest.approx(free.camera.fx, rel=1e-4)


def test_prior_makes_four_keypoints_enough() -> None:
    problem = problem_of(1, points=4, noise_px=0.0)
    with pytest.raises(DegenerateError, match="4 keypoints are too few for 9 unknowns"):
        fit_unknown(problem)
    result = fit_unknown(problem, focal_prior=FocalPrior(150.0, 0.05))
    explained = [result.alignment, *(other.alignment for other in result.alternatives)]
    best = min(rotation_error(est=found, gt=problem.alignment) for found in explained)
    assert best < 0.01


def test_prior_that_the_keypoints_contradict_is_said_so() -> None:
    problem = problem_of(1, points=200, noise_px=0.1)
    result = fit_unknown(problem, sigma=0.1, focal_prior=FocalPrior(220.0, 0.05))
    assert any(
        text.startswith("the keypoints contradict the focal length's prior: 1")
        and text.endswith(" px instead of 220 px +- 5 %")
        for text in map(str, result.warnings)
    )


def test_prior_of_usual_lenses_is_the_default_and_is_told() -> None:
    problem = problem_of(2, points=20, noise_px=1.0, camera=LONG, depth=(6.0, 9.0))
    usual = FocalPrior.from_size(640, 480)
    result = fit(problem.points_3d, problem.points_2d, UNKNOWN, focal="estimate")
    assert result.focal_prior == usual
    assert f"(prior: {usual})" in str(result)
    assert result.camera == fit_unknown(problem, focal_prior=usual).camera
    assert result.camera != fit_unknown(problem).camera
    assert fit(problem.points_3d, problem.points_2d, LONG).focal_prior is None
    view = View(UNKNOWN, problem.points_2d)
    learned = align(Model(points_3d=problem.points_3d, shape_sigma=0.01), view, focal="estimate")
    assert learned.focal_prior == usual
    (of_batch,) = align_batch(
        Model(points_3d=problem.points_3d), [view], focal="estimate", focal_prior=None
    )
    assert of_batch.focal_prior is None


def test_usual_lenses_of_a_batch_are_those_of_each_image() -> None:
    problems = [
        problem_of(seed, points=12, camera=Camera.from_fov(width, 480, fov_x=40.0))
        for seed, width in enumerate((640, 1280))
    ]
    cameras = [Camera.from_size(p.camera.width, 480) for p in problems]
    points = [p.points_3d for p in problems], [p.points_2d for p in problems]
    batch = fit_batch(*points, cameras, focal="estimate")
    for b, camera in enumerate(cameras):
        single = fit(problems[b].points_3d, problems[b].points_2d, camera, focal="estimate")
        assert batch.focal_length[b] == single.camera.fx
        assert single.focal_prior == FocalPrior.from_size(camera.width, 480)


@pytest.mark.long
def test_focal_lengths_with_the_usual_prior_are_as_uncertain_as_stated() -> None:
    """Photos with lenses from the distribution in the prior's docstring."""
    rng = np.random.default_rng(5)
    inside = []
    for seed in range(80):
        focal = 640 / 36 * min(14 + 17 * float(np.exp(0.8 * rng.normal())), 140.0)
        distance = 2.5 * focal / 240  # fills a half of the image
        camera = Camera(640, 480, focal, focal, 319.5, 239.5)
        depth = (distance, distance + 1)
        problem = problem_of(seed, points=12, noise_px=1.0, camera=camera, depth=depth)
        result = fit(problem.points_3d, problem.points_2d, UNKNOWN, focal="estimate")
        inside.append(abs(np.log(result.camera.fx / focal)) < 1.96 * result.std.focal)
        assert 0.3 * 640 < result.camera.fx < 6 * 640
    assert 0.88 <= np.mean(inside) <= 0.99


@pytest.mark.parametrize(
    "prior", [{"stretch_sigma": 0.05}, {"focal_prior": FocalPrior(150.0, 0.01)}], ids=str
)
def test_priors_count_by_their_own_deviations_where_noise_is_estimated(
    prior: dict[str, Any],
) -> None:
    problem = problem_of(5, points=30, noise_px=3.0)
    result = fit_unknown(problem, sigma=None, **prior)
    assert "focal_prior" not in prior or result.std.focal < 0.01
    known = fit_unknown(problem, sigma=result.sigma, **prior)
    assert result.camera.fx == pytest.approx(known.camera.fx, rel=1e-2)
    np.testing.assert_allclose(result.alignment.scale, known.alignment.scale, rtol=1e-3)
    np.testing.assert_allclose(
        result.fisher_covariance, known.fisher_covariance, rtol=1e-2, atol=1e-8
    )


# --- robust -----------------------------------------------------------------------------------


def test_robust_search_is_reproducible_and_guided() -> None:
    problem = problem_of(2, points=100, noise_px=1.0)
    points_2d, wrong = spoiled(problem, 0.8)
    arguments = problem.points_3d, points_2d, UNKNOWN
    options = {"ransac": RansacOptions(min_iterations=1, max_iterations=10), "focal_prior": None}
    scores = np.where(wrong, 0.1, 0.9)
    first, second = (fit(*arguments, focal="estimate", scores=scores, **options) for _ in range(2))
    assert first.alignment == second.alignment
    assert not first.inliers[wrong].any()
    assert first.inliers.sum() >= 18


@pytest.mark.slow
def test_noise_without_a_model_has_no_consensus() -> None:
    rng = np.random.default_rng(0)
    given = rng.uniform(-1, 1, (40, 3)), rng.uniform(0, 480, (40, 2)), UNKNOWN
    unknown = {"focal": "estimate", "focal_prior": None}
    with pytest.raises(NoConsensusError, match="no alignment is supported"):
        fit(*given, **unknown, ransac=RansacOptions(max_iterations=200))


# --- many at once -----------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("ransac", [None, RansacOptions()], ids=["all", "robust"])
def test_batch_solves_each_problem_as_fit_does(ransac: RansacOptions | None) -> None:
    problems = [problem_of(seed, points=8 + seed) for seed in range(5)]
    short = problem_of(9, points=4)
    batch = fit_batch(
        [p.points_3d for p in [*problems, short]],
        [p.points_2d for p in [*problems, short]],
        UNKNOWN,
        focal="estimate",
        focal_prior=None,
        ransac=ransac,
        workers=2,
    )
    known = fit_batch([short.points_3d] * 2, [short.points_2d] * 2, short.camera)
    assert known.focal_length.tolist() == [150.0, 150.0]
    for b, problem in enumerate(problems):
        single = fit_unknown(problem, ransac=ransac)
        assert batch.alignment(b) == single.alignment
        assert batch.focal_length[b] == single.camera.fx
        np.testing.assert_array_equal(batch[b].fisher_covariance, single.fisher_covariance)
    assert list(batch.errors) == [5]
    assert np.isnan(batch.focal_length[5])
