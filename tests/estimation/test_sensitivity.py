"""Sensitivity: derivatives of the optimum agree with finite differences of the estimates."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.problems import LENS, fit_problem, problem_of

from cadalign import Camera, RansacOptions, Result, ShapeModel, View, align, fit
from cadalign.errors import CadalignError, InputError
from cadalign.evaluation.simulation.problems import Problem
from cadalign.shapes.examples import Example

pytestmark = pytest.mark.slow
POINTS = 12


def unknowns(result: Result, base: Result) -> np.ndarray:
    """The unknowns (10,) of a result, its rotation vector from that of another."""
    turn = Rotation.from_matrix(result.alignment.rotation @ base.alignment.rotation.T)
    logs = np.log(result.bounds[1] - result.bounds[0] if result.model else result.alignment.scale)
    place = result.alignment.translation
    return np.concatenate([turn.as_rotvec(), place, logs, [np.log(result.camera.fx)]])


def difference(estimate: Any, step: float) -> np.ndarray | None:
    """Derivative of an estimate at 0, by central differences of two steps (Richardson).

    None where they disagree: the estimate leaps to another optimum, or did not reach its own.
    """
    one = (estimate(step) - estimate(-step)) / (2 * step)
    two = (estimate(2 * step) - estimate(-2 * step)) / (4 * step)
    return (4 * one - two) / 3 if relative_error(one, two) < 0.02 else None


def relative_error(found: np.ndarray, expected: np.ndarray | None) -> float:
    return (
        np.nan
        if expected is None
        else float(np.linalg.norm(found - expected) / np.linalg.norm(expected))
    )


def errors_of_fit(problem: Problem, rng: np.random.Generator, **options: Any) -> list[float]:
    """Relative errors by pixels, log sigmas and model points; none where little is determined."""
    try:
        base = fit_problem(problem, **options)
    except CadalignError:
        return []
    lengths = np.linalg.norm(base.residuals, axis=1)
    is_kinked = options.get("loss") == "huber" and np.abs(lengths - 2).min() < 0.02
    deviations = np.sqrt(np.diag(base.fisher_covariance))
    if is_kinked or base.alternatives or deviations[[0, 1, 2, 7, 8]].max() > 0.1:
        return []
    found, n = base.sensitivity(), len(problem.points_2d)
    size = len(found.by_log_sigma)

    def again(**changed: Any) -> np.ndarray:
        given = {"points_3d": problem.points_3d, "points_2d": problem.points_2d, "sigma": 1.0}
        given |= {"camera": problem.camera} | options | changed
        return unknowns(fit(**given), base)[:size]

    pixels, logs, points = (rng.standard_normal(s) for s in ((n, 2), n, (n, 3)))
    return [
        relative_error(by @ towards.ravel(), difference(estimate, step))
        for by, towards, estimate, step in (
            (
                found.by_points_2d.reshape(size, -1),
                pixels,
                lambda h: again(points_2d=problem.points_2d + h * pixels),
                0.02,
            ),
            (found.by_log_sigma, logs, lambda h: again(sigma=np.exp(h * logs)), 0.02),
            (
                found.by_points_3d.reshape(size, -1),
                points,
                lambda h: again(points_3d=problem.points_3d + h * points),
                2e-4,
            ),
        )
    ]


@pytest.mark.parametrize(
    ("count", "options"),
    [
        (500, {}),
        (150, {"loss": "cauchy"}),
        (150, {"loss": "huber"}),
        (30, {"focal": "estimate"}),
        (100, {"stretch": "y", "known_axis": "z", "scale_prior_sigma": 0.1}),
    ],
    ids=lambda value: str(value),
)
def test_derivatives_are_those_of_the_estimate(count: int, options: dict[str, Any]) -> None:
    rng = np.random.default_rng(0)
    errors: list[list[float]] = []
    for seed in range(10 * count):
        errors += [each for each in [errors_of_fit(problem_of(seed), rng, **options)] if each]
        if len(errors) == count:
            break
    assert len(errors) == count
    assert np.isfinite(errors).mean() > 0.95
    assert np.nanmedian(errors, axis=0).max() < 1e-4
    assert np.nanmax(errors) < 1e-2


def test_a_lens_is_honoured() -> None:
    rng, errors = np.random.default_rng(0), []
    for seed in range(40):
        problem = problem_of(seed)
        pixels = LENS.project(problem.alignment.apply(problem.points_3d))
        if LENS.contains(pixels).all():
            noisy = pixels + rng.normal(0, 0.5, pixels.shape)
            seen = Problem(problem.points_3d, noisy, LENS, problem.alignment, None)
            errors.append(errors_of_fit(seen, rng))
    errors = [each for each in errors if each]
    assert len(errors) > 5
    assert np.nanmedian(errors) < 1e-3  # the lens's second derivatives are left out


def learned(n: int) -> tuple[ShapeModel, np.ndarray]:
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (n, 3))
    examples = [
        Example(f"m{k}", range(n), points * rng.uniform(0.75, 1.3, 3) + rng.normal(0, 0.02, (n, 3)))
        for k in range(60)
    ]
    return ShapeModel.learn(examples), points


@pytest.mark.parametrize("loss", ["linear", "cauchy"])
def test_derivatives_of_a_learned_shape(loss: str) -> None:
    n, camera = 9, Camera(640, 480, 900, 900, 319.5, 239.5)
    model, points = learned(n)
    rng, errors = np.random.default_rng(1), []
    for seed in range(35):
        turn = Rotation.random(random_state=seed).as_matrix()
        own = points * rng.uniform(0.8, 1.25, 3) + rng.normal(0, 0.02, (n, 3))
        seen = camera.project(own @ turn.T + [0.1, 0.1, 3]) + rng.normal(0, 1, (n, 2))

        def state(pixels: np.ndarray, sigma: Any) -> tuple[Result, np.ndarray]:
            found = align(model, View(camera, pixels, sigma=sigma), loss=loss)
            return found, found.points_3d.ravel()

        base, _ = state(seen, np.ones(n))
        if base.alternatives or base.std.rotation_deg > 5:
            continue
        found = base.sensitivity()
        pixels, logs = rng.standard_normal((n, 2)), rng.standard_normal(n)

        def estimate(pixels: np.ndarray, sigma: np.ndarray, base: Result = base) -> np.ndarray:
            result, shape = state(pixels, sigma)
            return np.concatenate([unknowns(result, base)[:9], shape])

        by_pixels = np.concatenate(
            [
                found.by_points_2d.reshape(9, -1) @ pixels.ravel(),
                found.points_by_points_2d.reshape(3 * n, -1) @ pixels.ravel(),
            ]
        )
        by_logs = np.concatenate(
            [found.by_log_sigma @ logs, (found.points_by_log_sigma @ logs).ravel()]
        )
        errors.append(
            [
                relative_error(
                    by_pixels,
                    difference(lambda h: estimate(seen + h * pixels, np.ones(n)), 0.01),  # noqa: B023
                ),
                relative_error(
                    by_logs,
                    difference(lambda h: estimate(seen, np.exp(h * logs)), 0.01),  # noqa: B023
                ),
            ]
        )
    assert len(errors) >= 20
    assert np.isfinite(errors).mean() > 0.9
    assert np.nanmedian(errors) < 1e-4
    assert np.nanmax(errors) < 1e-2


def test_the_mean_of_a_learned_shape_moves_the_estimate_as_its_points_do() -> None:
    model, points = learned(9)
    camera = Camera(640, 480, 900, 900, 319.5, 239.5)
    turn = Rotation.random(random_state=3).as_matrix()
    view = View(camera, camera.project(points @ turn.T + [0.1, 0.1, 3]))
    found = align(model, view).sensitivity()
    # A shift of the whole mean is one of the translation by the rotated shift.
    moved = found.by_points_3d.sum(axis=1)
    np.testing.assert_allclose(moved[:3], 0, atol=1e-4)
    rotation = align(model, view).alignment.rotation
    np.testing.assert_allclose(moved[3:6], -rotation, atol=1e-4)


def test_outliers_have_no_influence_and_the_strongest_keypoint_is_named() -> None:
    problem = problem_of(4, points=20)
    pixels = problem.points_2d.copy()
    pixels[3] += 80
    result = fit(problem.points_3d, pixels, problem.camera, ransac=RansacOptions())
    assert not result.inliers[3]
    found = result.sensitivity()
    assert not found.by_points_2d[:, 3].any()
    assert found.influence[3] == 0
    assert found.strongest == int(np.argmax(found.influence))
    assert str(found).splitlines()[1].startswith(f"  {found.strongest}: ")


def test_gauss_newton_and_hessian_agree_without_residuals() -> None:
    result = fit_problem(problem_of(2, noise_px=0.0))
    exact, rough = result.sensitivity(), result.sensitivity(exact=False)
    np.testing.assert_allclose(exact.by_points_2d, rough.by_points_2d, rtol=1e-5, atol=1e-9)


def test_a_pixel_of_noise_makes_the_covariance_to_first_order() -> None:
    result = fit_problem(problem_of(2))
    by_pixels = result.sensitivity(exact=False).by_points_2d.reshape(9, -1)
    np.testing.assert_allclose(
        by_pixels @ by_pixels.T, result.fisher_covariance, rtol=1e-6, atol=1e-12
    )


def test_what_has_no_evidence_is_refused() -> None:
    result = Result.from_dict(fit_problem(problem_of(2)).to_dict())
    with pytest.raises(InputError) as refused:
        result.sensitivity()
    assert str(refused.value) == (
        "sensitivity: only keypoints of one view, of an exact, stretched or learned model, aligned "
        "by maximum likelihood without a wide lens or unknown principal point, have a sensitivity; "
        "align these alone, in this program: files do not hold the evidence"
    )
