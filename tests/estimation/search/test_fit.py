"""`fit`: estimates with all unknowns or fewer, and alternatives."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from support.problems import (
    LENS,
    assert_same,
    fit_problem,
    moved,
    of_unknowns,
    problem_of,
    residuals_at,
)

from cadalign import Alignment, Camera, fit
from cadalign.errors import DegenerateError
from cadalign.estimation.options import BOUNDING_PRIOR
from cadalign.evaluation.simulation import SIMULATION_CAMERA, SimulatedProblem
from cadalign.metrics import rotation_error

# --- estimates --------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["optimal", "aepnp", "aepnp-paper"])
@pytest.mark.parametrize(("points", "camera"), [(6, LENS), (7, SIMULATION_CAMERA), (300, LENS)])
def test_noise_free_keypoints_give_the_truth(method: str, points: int, camera: Camera) -> None:
    for seed in range(5):
        problem = problem_of(seed, points=points, noise_px=0.0, camera=camera)
        result = fit_problem(problem, method=method)
        assert_same(result.alignment, problem.alignment, 1e-7)
        assert result.rms < 1e-6


def test_epnp_knows_no_stretch() -> None:
    plain = problem_of(0, points=12, noise_px=0.0, stretch=(1.0, 1.0))
    result = fit_problem(plain, method="epnp")
    assert_same(result.alignment, plain.alignment, 1e-5)
    stretched = problem_of(1, points=12, noise_px=0.0, stretch=(1.5, 1.6))
    assert fit_problem(stretched, method="epnp").alignment.scale.tolist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize("camera", [SIMULATION_CAMERA, LENS])
@pytest.mark.parametrize("points", [8, 100])
def test_optimum_agrees_with_an_independent_least_squares_fit(camera: Camera, points: int) -> None:
    problem = problem_of(4, points=points, noise_px=1.0, camera=camera)

    def errors(step: np.ndarray) -> np.ndarray:
        return residuals_at(problem, moved(problem.alignment, step)).ravel()

    found = least_squares(errors, np.zeros(8), x_scale="jac", ftol=1e-14, xtol=1e-14, gtol=1e-14)
    result = fit_problem(problem)
    # Errors behind a lens are linearised, which moves the optimum slightly.
    exact = camera is SIMULATION_CAMERA
    assert np.sum(result.residuals**2) <= 2 * found.cost * (1 + (1e-10 if exact else 1e-5))
    expected = moved(problem.alignment, found.x)
    deviation = result.std.rotation_deg
    off = rotation_error(est=result.alignment, gt=expected)
    assert off < (1e-5 if exact else 0.01) * deviation
    np.testing.assert_allclose(result.alignment.scale, expected.scale, rtol=1e-6 if exact else 1e-3)


@pytest.mark.parametrize("method", ["optimal", "aepnp", "aepnp-paper", "epnp"])
@pytest.mark.parametrize("camera", [SIMULATION_CAMERA, LENS])
def test_residuals_are_projected_minus_observed(method: str, camera: Camera) -> None:
    problem = problem_of(2, camera=camera)
    result = fit_problem(problem, method=method)
    expected = residuals_at(problem, result.alignment)
    np.testing.assert_allclose(result.residuals, expected, rtol=0, atol=1e-9)
    assert result.rms == pytest.approx(np.sqrt((expected**2).sum(axis=1).mean()))
    assert result.inliers.tolist() == [True] * 12


def test_input_is_neither_changed_nor_kept() -> None:
    problem = problem_of(0)
    points_3d, points_2d = problem.points_3d.copy(), problem.points_2d.copy()
    result = fit(points_3d, points_2d, problem.camera)
    assert (points_3d == problem.points_3d).all()
    assert (points_2d == problem.points_2d).all()
    text = json.dumps(result.to_dict())
    points_3d[:] = 99.0
    points_2d[:] = 99.0
    assert json.dumps(result.to_dict()) == text


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("kind", [np.float32, np.float64, list])
def test_array_layout_and_type_do_not_matter(order: str, kind: Any) -> None:
    problem = problem_of(0)
    rounded = [a.astype(np.float32) for a in (problem.points_3d, problem.points_2d)]
    expected = fit(*(a.astype(float) for a in rounded), problem.camera)
    given = [a.tolist() if kind is list else np.array(a, dtype=kind, order=order) for a in rounded]
    for array in given:
        if kind is not list:
            array.flags.writeable = False
    assert fit(*given, problem.camera).alignment == expected.alignment


# --- fewer unknowns ---------------------------------------------------------------------------


@pytest.mark.parametrize(("stretch", "held"), [("y", [0, 2]), ("z", [0, 1]), ("none", [0, 1, 2])])
def test_scales_that_do_not_stretch_stay_exactly_one(stretch: str, held: list[int]) -> None:
    result = fit_problem(problem_of(2), stretch=stretch)
    assert (result.alignment.scale[held] == 1.0).all()
    assert result.stretched_axes == stretch.replace("none", "")
    covariance = result.fisher_covariance
    fixed = [6 + axis for axis in held]
    assert (covariance[fixed] == 0).all()
    assert (covariance[:, fixed] == 0).all()
    assert np.linalg.matrix_rank(covariance) == 9 - len(fixed)
    assert [s == 0.0 for s in result.std.scale] == [axis in held for axis in range(3)]


@pytest.mark.parametrize(("stretch", "points"), [("y", 4), ("z", 4), ("none", 3)])
def test_fewer_unknowns_need_fewer_points(stretch: str, points: int) -> None:
    scale = {"y": (1.0, 1.4, 1.0), "z": (1.0, 1.0, 1.4), "none": (1.0, 1.0, 1.0)}[stretch]
    simulated = problem_of(11, points=points, noise_px=0.0, stretch=(1.0, 1.0))
    gt = simulated.alignment
    alignment = Alignment(gt.rotation, gt.translation, scale)
    points_3d = simulated.points_3d / scale
    result = fit(points_3d, simulated.points_2d, simulated.camera, stretch=stretch)
    explanations = [result.alignment, *(other.alignment for other in result.alternatives)]
    assert result.rms < 1e-5
    assert min(rotation_error(est=each, gt=alignment) for each in explanations) < 1e-3


def test_weak_prior_changes_nothing_and_a_strong_one_holds_the_scale() -> None:
    problem = problem_of(2, points=20)
    free = fit_problem(problem)
    weak = fit_problem(problem, stretch_sigma=1e4)
    assert_same(weak.alignment, free.alignment, 1e-5)
    strong = fit_problem(problem, stretch_sigma=1e-6)
    held = fit_problem(problem, stretch="none")
    assert_same(strong.alignment, held.alignment, 1e-3)
    np.testing.assert_allclose(strong.alignment.scale, 1.0, atol=1e-5)


def test_prior_adds_its_information() -> None:
    problem = problem_of(2, points=20, noise_px=0.0, stretch=(1.0, 1.0))
    free, prior = fit_problem(problem), fit_problem(problem, stretch_sigma=0.02)
    information, without = (
        np.linalg.inv(of_unknowns(each.fisher_covariance)) for each in (prior, free)
    )
    added = information - without
    expected = np.diag([0.0] * 6 + [2500.0] * 2)
    sizes = np.sqrt(information.diagonal())
    assert (np.abs(added - expected) < 1e-5 * np.outer(sizes, sizes)).all()


@pytest.mark.parametrize("axis", [1, 2])
def test_prior_makes_keypoints_in_one_plane_solvable(axis: int) -> None:
    rng = np.random.default_rng(1)
    problem = problem_of(1, points=10, noise_px=0.0)
    points_3d = problem.points_3d.copy()
    points_3d[:, axis] = 0.1
    points_2d = problem.camera.project(problem.alignment.apply(points_3d))
    points_2d += 0.2 * rng.standard_normal(points_2d.shape)
    result = fit(points_3d, points_2d, problem.camera, stretch_sigma=0.5)
    assert result.rms < 1.0
    # Only the prior determines this scale.
    assert result.std.scale[axis] == pytest.approx(0.5, rel=0.25)
    assert f"in the plane {'xyz'[axis]} = 0.1" in str(result)


def test_exchanging_the_axes_that_stretch_exchanges_their_deviations() -> None:
    problem = problem_of(8, points=6)
    base = fit_problem(problem)
    exchanged = problem.points_3d[:, [0, 2, 1]] * [1, 1, -1]
    other = fit(exchanged, problem.points_2d, problem.camera)
    assert other.std.scale == pytest.approx([base.std.scale[axis] for axis in (0, 2, 1)], rel=1e-3)
    assert other.std.rotation_deg == pytest.approx(base.std.rotation_deg, rel=1e-3)


# --- alternatives -----------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_four_points_give_every_exact_solution_least_stretch_first(seed: int) -> None:
    problem = problem_of(seed, points=4, noise_px=0.0)
    result = fit_problem(problem)
    found = [result.alignment, *(other.alignment for other in result.alternatives)]
    for alignment in found:
        assert np.abs(residuals_at(problem, alignment)).max() < 1e-5
    stretch = [float((np.log(alignment.scale) ** 2).sum()) for alignment in found]
    assert stretch == sorted(stretch)
    assert min(rotation_error(est=each, gt=problem.alignment) for each in found) < 1e-3
    assert all(other.relative_likelihood > 0.99 for other in result.alternatives)


def cost_at(problem: SimulatedProblem, alignment: Alignment) -> float:
    """The objective at a deviation of 1 px, with the bound of the log scales."""
    weight, width = BOUNDING_PRIOR
    excess = np.maximum(np.abs(np.log(alignment.scale)) - width, 0.0)
    return float((residuals_at(problem, alignment) ** 2).sum() + weight * (excess**2).sum())


@pytest.mark.parametrize("points", [5, 6])
def test_alternatives_are_other_minima_with_their_likelihood(points: int) -> None:
    seen = 0
    for seed in range(40):
        problem = problem_of(seed, points=points, noise_px=1.0)
        try:
            result = fit_problem(problem)
        except DegenerateError:  # happens once in hundreds: noise on so few points leaves nothing
            continue
        best = cost_at(problem, result.alignment)
        likelihoods = [other.relative_likelihood for other in result.alternatives]
        assert likelihoods == sorted(likelihoods, reverse=True)
        for other in result.alternatives:
            seen += 1
            excess = cost_at(problem, other.alignment) - best
            assert other.relative_likelihood == pytest.approx(np.exp(-excess / 2), rel=1e-4)
            assert 1e-3 <= other.relative_likelihood <= 1.0
            turn = rotation_error(est=other.alignment, gt=result.alignment)
            stretch = np.abs(np.log(other.alignment.scale / result.alignment.scale)).max()
            assert turn > 0.01 or stretch > 1e-4
    assert seen >= 3
