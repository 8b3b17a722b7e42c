"""`fit` and noise: weights of keypoints, and calibration of its uncertainty."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.special import chdtri, fdtri
from support.problems import (
    LENS,
    assert_same,
    fit_problem,
    moved,
    of_unknowns,
    problem_of,
    residuals_at,
)

from cadalign import Alignment, Camera, Model, RansacOptions, View, align, fit
from cadalign.errors import DegenerateError
from cadalign.estimation.result_parts import MISFIT_KINDS
from cadalign.evaluation.simulation import SIMULATION_CAMERA, SimulatedProblem, simulate_problem
from cadalign.metrics import rotation_error

# --- sigma ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "sigma", [np.full(12, 0.7), np.linspace(0.5, 3.0, 12)], ids=["one", "each"]
)
def test_forms_of_sigmas_agree(sigma: np.ndarray) -> None:
    problem = problem_of(1, camera=LENS)
    expected = fit_problem(problem, sigma=sigma)
    assert expected.sigma is None
    forms: list[Any] = [sigma[:, None, None] ** 2 * np.eye(2)]
    if np.ptp(sigma) == 0:
        forms += [0.7, np.float32(0.7)]
    for form in forms:
        other = fit_problem(problem, sigma=form)
        assert_same(other.alignment, expected.alignment, 1e-7)
        np.testing.assert_allclose(
            other.fisher_covariance, expected.fisher_covariance, rtol=1e-5, atol=1e-12
        )


def test_sigma_of_all_scales_the_covariance_and_nothing_else() -> None:
    problem = problem_of(1)
    one, three = fit_problem(problem, sigma=1.0), fit_problem(problem, sigma=3.0)
    assert_same(three.alignment, one.alignment, 1e-7)
    np.testing.assert_allclose(three.fisher_covariance, 9 * one.fisher_covariance, rtol=1e-5)
    assert (one.sigma, three.sigma) == (1.0, 3.0)


def test_keypoints_of_large_sigma_count_less() -> None:
    problem = problem_of(1)
    sigma = np.full(12, 1.0)
    sigma[3] = 1e3
    wrong = problem.points_2d.copy()
    wrong[3] += [40.0, -30.0]
    trusting = fit(problem.points_3d, wrong, problem.camera)
    knowing = fit(problem.points_3d, wrong, problem.camera, sigma=sigma)
    without = fit(np.delete(problem.points_3d, 3, 0), np.delete(wrong, 3, 0), problem.camera)
    assert_same(knowing.alignment, without.alignment, 1e-3)
    assert rotation_error(est=trusting.alignment, gt=without.alignment) > 1.0


@pytest.mark.parametrize("camera", [SIMULATION_CAMERA, LENS])
def test_full_covariances_weigh_directions(camera: Camera) -> None:
    problem = problem_of(5, points=10, noise_px=1.0, camera=camera)
    rng = np.random.default_rng(0)
    factors = rng.normal(size=(10, 2, 2)) + 1.5 * np.eye(2)
    covariances = factors @ factors.transpose(0, 2, 1)
    whitening = np.linalg.inv(np.linalg.cholesky(covariances))

    def errors(step: np.ndarray) -> np.ndarray:
        residuals = residuals_at(problem, moved(problem.alignment, step))
        return np.einsum("nij,nj->ni", whitening, residuals).ravel()

    found = least_squares(errors, np.zeros(8), x_scale="jac", ftol=1e-14, xtol=1e-14, gtol=1e-14)
    result = fit_problem(problem, sigma=covariances)
    unweighted = fit_problem(problem)
    # Through a lens, errors of pixels become errors of rays by the lens's derivative.
    tolerance = 1e-5 if camera is SIMULATION_CAMERA else 2e-3
    assert_same(result.alignment, moved(problem.alignment, found.x), tolerance)
    assert rotation_error(est=unweighted.alignment, gt=result.alignment) > 0.1


def test_unknown_sigma_is_estimated_from_the_residuals() -> None:
    problem = problem_of(3, points=60, noise_px=2.5)
    result = fit_problem(problem, sigma=None)
    expected = np.sqrt((result.residuals**2).sum() / (2 * 60 - 8))
    assert result.sigma == pytest.approx(expected)
    assert result.sigma == pytest.approx(2.5, rel=0.2)
    known = fit_problem(problem, sigma=result.sigma)
    assert_same(known.alignment, result.alignment, 1e-7)
    np.testing.assert_allclose(known.fisher_covariance, result.fisher_covariance, rtol=1e-5)


def said_of(problem: SimulatedProblem, points_2d: np.ndarray) -> list[bool]:
    """True for a fit, and for an estimate from two views, with a warning about large noise."""
    view = View(problem.camera, points_2d, sigma=None)
    views = [view, replace(view, points_2d=points_2d + 1.0)]
    try:
        fitted = fit(problem.points_3d, points_2d, problem.camera, sigma=None)
        aligned = align(Model(points_3d=problem.points_3d), views)
    except DegenerateError:
        return [True, True]
    return [any(each.kind == "noise" for each in r.warnings) for r in (fitted, aligned)]


def test_keypoints_in_random_order_are_warned_of_although_sigma_is_unknown() -> None:
    named = []
    for seed in range(3):
        problem = problem_of(seed)
        assert not any(said_of(problem, problem.points_2d))
        order = np.random.default_rng(seed).permutation(len(problem.points_2d))
        named += said_of(problem, problem.points_2d[order])
    assert sum(named) >= 5  # of 6


def test_unknown_sigma_is_estimated_in_spite_of_outliers_where_the_loss_is_robust() -> None:
    problem = problem_of(3, points=100, noise_px=1.0)
    wrong = problem.points_2d.copy()
    wrong[:5] += 80.0
    robust = fit(problem.points_3d, wrong, problem.camera, sigma=None, loss="cauchy")
    plain = fit(problem.points_3d, wrong, problem.camera, sigma=None)
    assert robust.sigma == pytest.approx(1.0, rel=0.3)
    assert plain.sigma > 5


# --- loss -------------------------------------------------------------------------------------


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
@pytest.mark.parametrize("seed", range(2))
def test_robust_loss_withstands_a_gross_outlier(loss: str, seed: int) -> None:
    problem = problem_of(seed, points=20, noise_px=0.5)
    wrong = problem.points_2d.copy()
    wrong[7] += [60.0, -80.0]
    clean = fit(np.delete(problem.points_3d, 7, 0), np.delete(wrong, 7, 0), problem.camera)
    robust = fit(problem.points_3d, wrong, problem.camera, loss=loss)
    plain = fit(problem.points_3d, wrong, problem.camera)
    off = rotation_error(est=robust.alignment, gt=clean.alignment)
    assert off < 3.0
    assert off < 0.25 * rotation_error(est=plain.alignment, gt=clean.alignment)


@pytest.mark.parametrize("loss", ["linear", "huber", "cauchy"])
def test_result_is_a_minimum_of_the_loss(loss: str) -> None:
    problem = problem_of(6, points=15, noise_px=3.0)

    def cost(alignment: Alignment) -> float:
        length = np.linalg.norm(residuals_at(problem, alignment), axis=1) / 1.5
        if loss == "linear":
            return float((length**2).sum())
        if loss == "huber":  # loss_scale 2: quadratic up to there, then linear
            return float(np.where(length > 2, 4 * length - 4, length**2).sum())
        return float((4 * np.log1p(length**2 / 4)).sum())

    result = fit_problem(problem, loss=loss, sigma=1.5, loss_scale=2.0)
    lowest = cost(result.alignment)
    rng = np.random.default_rng(0)
    for size in (1e-4, 1e-3, 1e-2):
        for _ in range(50):
            assert cost(moved(result.alignment, size * rng.standard_normal(8))) >= lowest - 1e-9


def test_hubers_loss_is_no_larger_than_at_the_truth() -> None:
    camera = Camera(640, 480, 935, 935, 319.5, 239.5)
    shown = {"noise_px": 1.0, "outlier_share": 0.2, "camera": camera, "stretch": (0.7, 1.4)}
    for seed in range(30):
        problem = simulate_problem(np.random.default_rng(seed), points=20, depth=(5, 9), **shown)
        result = fit(problem.points_3d, problem.points_2d, camera, loss="huber")
        off = camera.project(problem.alignment.apply(problem.points_3d)) - problem.points_2d
        lengths = np.linalg.norm(off, axis=1)
        at_truth = np.where(lengths <= 2, lengths**2, 4 * lengths - 4).sum()
        assert result.cost <= at_truth


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_robust_loss_with_a_large_scale_is_the_linear_one(loss: str) -> None:
    problem = problem_of(6)
    robust = fit_problem(problem, loss=loss, loss_scale=1e6)
    assert_same(robust.alignment, fit_problem(problem).alignment, 1e-6)


# --- uncertainty -------------------------------------------------------------------------------


@pytest.mark.parametrize(("camera", "shift"), [(SIMULATION_CAMERA, 30.0), (LENS, 0.0)])
def test_covariance_is_the_inverse_information_at_the_optimum(camera: Camera, shift: float) -> None:
    problem = problem_of(9, points=15, noise_px=0.0, camera=camera)
    points_3d = problem.points_3d + [shift, -shift, shift]
    result = fit(points_3d, problem.points_2d, camera, sigma=1.7)
    step = 1e-6

    def pixels(unknown: np.ndarray) -> np.ndarray:
        return camera.project(moved(result.alignment, unknown).apply(points_3d)).ravel()

    jacobian = np.stack([(pixels(d) - pixels(-d)) / (2 * step) for d in step * np.eye(8)], axis=1)
    expected = 1.7**2 * np.linalg.inv(jacobian.T @ jacobian)
    deviation = np.sqrt(expected.diagonal())
    difference = np.abs(of_unknowns(result.fisher_covariance) - expected) / np.outer(
        deviation, deviation
    )
    assert difference.max() < 1e-4


def test_std_restates_the_covariance() -> None:
    result = fit_problem(problem_of(9))
    std, deviation = result.std, np.sqrt(result.covariance.diagonal())
    assert std.rotation_deg == pytest.approx(np.degrees(np.linalg.norm(deviation[:3])))
    assert std.translation == pytest.approx(deviation[3:6])
    assert std.scale == pytest.approx(deviation[6:])


@pytest.mark.parametrize("method", ["aepnp", "aepnp-paper", "epnp"])
def test_methods_without_statistics_say_so(method: str) -> None:
    result = fit_problem(problem_of(9), method=method)
    assert result.fisher_covariance is None
    assert result.std is None
    assert result.warnings == ()
    assert result.alternatives == ()


def flattened(axis: int, thickness: float) -> SimulatedProblem:
    """A problem with keypoints near the plane where an axis is 0.25, without noise."""
    problem = problem_of(3, points=10, noise_px=0.0)
    factor = np.ones(3)
    factor[axis] = thickness
    points_3d = problem.points_3d * factor
    points_3d[:, axis] += 0.25 - points_3d[:, axis].mean()
    points_2d = problem.camera.project(problem.alignment.apply(points_3d))
    return SimulatedProblem(points_3d, points_2d, problem.camera, problem.alignment, None)


@pytest.mark.parametrize("axis", [1, 2])
def test_text_names_the_plane_that_hides_a_stretch(axis: int) -> None:
    result = fit_problem(flattened(axis, 0.02))
    name = "xyz"[axis]
    assert f"s_{name}" in result.uncertain
    assert f"s_{name} (the keypoints lie nearly in the plane {name} = 0.25)" in str(result)


def test_text_names_the_axis_that_is_seen_end_on() -> None:
    rng = np.random.default_rng(0)
    points_3d = rng.uniform(-0.5, 0.5, (8, 3))
    alignment = Alignment(np.eye(3), [0, 0, 60.0], np.ones(3))  # z points away from the camera
    camera = Camera(640, 480, 6000.0, 6000.0, 319.5, 239.5)
    result = fit(points_3d, camera.project(alignment.apply(points_3d)), camera)
    assert "s_z (the model's z axis is seen nearly end-on)" in str(result)


def test_warning_says_that_four_points_always_fit() -> None:
    result = fit_problem(problem_of(3, points=4, noise_px=0.0))
    assert result.warnings[0].text == (
        "4 keypoints always fit exactly: the residuals say nothing about the quality of the fit"
    )


def test_many_good_keypoints_leave_nothing_to_warn_of() -> None:
    result = fit_problem(problem_of(0, points=100))
    assert result.warnings == ()
    assert result.alternatives == ()


ALARMING = {
    "lens": {"camera": LENS},
    "stretch": {"stretch_sigma": 0.5},
    "each": {"sigma": np.ones(8)},
}
ALARMING |= {loss: {"loss": loss} for loss in ("linear", "huber", "cauchy")}
ALARMING["ransac"] = {"ransac": RansacOptions(max_iterations=200)}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ALARMING)
def test_right_data_raise_no_alarm(kind: str) -> None:
    """At the allowed rate of 1 %, 4 false alarms of 40 have a probability of 0.001."""
    options = dict(ALARMING[kind])
    camera, alarms = options.pop("camera", SIMULATION_CAMERA), 0
    for seed in range(40):
        problem = problem_of(seed, points=8, noise_px=1.0, camera=camera)
        with suppress(DegenerateError):  # with few keypoints, the noise may leave no solution
            result = fit_problem(problem, **options)
            alarms += any(each.kind in MISFIT_KINDS for each in result.warnings)
    assert alarms < 4


def test_nothing_is_more_certain_than_the_cramer_rao_bound() -> None:
    for seed in range(10):
        result = fit_problem(problem_of(seed, points=7, noise_px=1.0))
        bound = of_unknowns(result.fisher_covariance)
        excess = of_unknowns(result.covariance) - bound
        scale = np.sqrt(np.outer(bound.diagonal(), bound.diagonal()))
        assert np.linalg.eigvalsh(excess / scale)[0] > -1e-6 * np.abs(excess / scale).max() - 1e-9


def test_many_keypoints_leave_the_inverse_fisher_information() -> None:
    result = fit_problem(problem_of(1, points=150, noise_px=1.0))
    np.testing.assert_array_equal(result.covariance, result.fisher_covariance)


@pytest.mark.parametrize(("loss", "least"), [("linear", 1.0), ("cauchy", 1.001)])
def test_estimated_noise_widens_the_covariance_as_the_f_distribution_does(
    loss: str, least: float
) -> None:
    """Coverage of 95 % ellipsoids; a robust loss has fewer keypoints to estimate the noise."""
    problem = problem_of(1, points=150, noise_px=1.0)
    result = fit_problem(problem, sigma=None, loss=loss)
    usual = 8 * fdtri(8, 2 * 150 - 8, 0.95) / chdtri(8, 0.05)
    widened = result.covariance[0, 0] / result.fisher_covariance[0, 0]
    assert least - 1e-4 < widened / usual < least + 0.02
    few = problem_of(1, points=6, noise_px=1.0)
    estimated = fit_problem(few, sigma=None, loss=loss)
    known = fit_problem(few, sigma=estimated.sigma, loss=loss)
    assert estimated.std.rotation_deg > 1.2 * known.std.rotation_deg


@pytest.mark.slow
def test_robust_sigma_does_not_collapse() -> None:
    problems = (problem_of(seed, points=8, noise_px=1.0) for seed in range(40))
    sigmas = [fit_problem(each, sigma=None, loss="cauchy").sigma for each in problems]
    assert min(sigmas) > 0.01
    assert 0.5 < np.median(sigmas) < 1.5


def test_stats_count_the_work() -> None:
    problem = problem_of(0)
    start = time.perf_counter()
    stats = fit_problem(problem).stats
    elapsed = time.perf_counter() - start
    assert stats.iterations > 0
    assert stats.hypotheses > 0
    assert 0 < stats.seconds <= elapsed
