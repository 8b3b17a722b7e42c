"""Sensitivity: derivatives of the optimum agree with finite differences of the estimates."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.problems import LENS, fit_problem, problem_of

from cadalign import (
    Alignment,
    Camera,
    FocalPrior,
    Mesh,
    Model,
    RansacOptions,
    Result,
    ShapeModel,
    View,
    align,
    fit,
)
from cadalign.errors import CadalignError, InputError
from cadalign.evaluation.simulation import Problem
from cadalign.render import Scene, cast_geometry
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
        (40, {}),
        (30, {"loss": "cauchy"}),
        (30, {"loss": "huber"}),
        (12, {"focal": "estimate"}),
        (20, {"stretch": "y", "known_axis": "z", "stretch_sigma": 0.1}),
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


PIN = Camera(640, 480, 900, 900, 319.5, 239.5)
FISHEYE = Camera(640, 480, 300, 300, 319.5, 239.5, (0.02, -0.01, 0.0, 0.0), lens="fisheye")
N = 9


@cache
def learned(n: int) -> tuple[ShapeModel, np.ndarray]:
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (n, 3))
    examples = [
        Example(f"m{k}", range(n), points * rng.uniform(0.75, 1.3, 3) + rng.normal(0, 0.02, (n, 3)))
        for k in range(60)
    ]
    return ShapeModel.learn(examples), points


def aligned(model: Any, camera: Camera, **options: Any) -> Any:
    """An estimate of views' pixels and standard deviations."""

    def estimate(pixels: list[np.ndarray], sigmas: list[np.ndarray]) -> Result:
        pairs = zip(pixels, sigmas, strict=True)
        return align(model, [View(camera, seen, sigma=each) for seen, each in pairs], **options)

    return estimate


def seen_by(camera: Camera, count: int, seed: int) -> list[np.ndarray]:
    """Keypoints of one object in views from all around, with half a pixel of noise."""
    rng = np.random.default_rng(seed)
    _, points = learned(N)
    own = points * rng.uniform(0.8, 1.25, 3) + rng.normal(0, 0.02, points.shape)
    place = [1.5, 0.3, 1.0] if camera.is_wide else [0.1, 0.1, 3.0]
    views = []
    for turn in Rotation.random(count, random_state=seed).as_matrix():
        pixels = camera.project(own @ turn.T + place)
        views.append(pixels + rng.normal(0, 0.5, pixels.shape))
    return views


def differences_of(
    estimate: Any, pixels: list[np.ndarray], view: int, step: float, rng: np.random.Generator
) -> list[float]:
    """Relative errors of derivatives along random directions of pixels and log sigmas."""
    sigmas = [np.ones(len(each)) for each in pixels]
    base = estimate(pixels, sigmas)
    hardly_settles = base.stats.iterations > 100  # on a ridge, which differences stray along
    if base.alternatives or base.std.rotation_deg > 5 or hardly_settles:
        return []
    found = base.sensitivity(view=view)
    size = len(found.by_log_sigma)

    def state(pixels: list[np.ndarray], sigmas: list[np.ndarray]) -> np.ndarray:
        result = estimate(pixels, sigmas)
        turn = result.poses[view].rotation @ base.poses[view].rotation.T
        lengths = result.alignment.scale
        if isinstance(result.model, ShapeModel):
            lengths = result.bounds[1] - result.bounds[0]
        own = Rotation.from_matrix(turn).as_rotvec(), result.poses[view].translation
        whole = np.concatenate([*own, np.log(lengths), [np.log(result.cameras[view].fx)]])[:size]
        has_shape = found.points_by_points_2d is not None
        return np.concatenate([whole, result.points_3d.ravel()]) if has_shape else whole

    def along(by_data: np.ndarray, of_points: np.ndarray | None, step: np.ndarray) -> np.ndarray:
        parts = [by_data] if of_points is None else [by_data, of_points]
        return np.concatenate([each.reshape(-1, step.size) @ step.ravel() for each in parts])

    towards = [rng.standard_normal(each.shape) for each in pixels]
    logs = [rng.standard_normal(len(each)) for each in pixels]
    by_pixels = along(found.by_points_2d, found.points_by_points_2d, np.concatenate(towards))
    by_logs = along(found.by_log_sigma, found.points_by_log_sigma, np.concatenate(logs))
    return [
        relative_error(
            by_pixels,
            difference(
                lambda h: state([p + h * d for p, d in zip(pixels, towards, strict=True)], sigmas),
                step,
            ),
        ),
        relative_error(
            by_logs,
            difference(
                lambda h: state(
                    pixels, [s * np.exp(h * d) for s, d in zip(sigmas, logs, strict=True)]
                ),
                step,
            ),
        ),
    ]


SHAPE, MEAN = learned(N)
EXACT, SIMILAR = Model(points_3d=MEAN), Model(points_3d=MEAN, shape_sigma=0.03)


@pytest.mark.parametrize(
    ("model", "camera", "views", "options"),
    [
        (SHAPE, PIN, 1, {}),
        (SHAPE, PIN, 1, {"loss": "cauchy"}),
        (SHAPE, PIN, 1, {"focal": "estimate", "focal_prior": FocalPrior(900, 0.2)}),
        (SHAPE, PIN, 3, {}),
        (SHAPE, PIN, 3, {"loss": "cauchy"}),
        (SIMILAR, PIN, 1, {}),
        (SIMILAR, LENS, 2, {"focal": "estimate", "loss": "huber"}),
        (SIMILAR, FISHEYE, 2, {}),
        (EXACT, PIN, 3, {}),
        (EXACT, FISHEYE, 1, {}),
        (EXACT, FISHEYE, 2, {}),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Model | ShapeModel) else None,
)
def test_derivatives_of_every_estimate(
    model: Any, camera: Camera, views: int, options: dict[str, Any]
) -> None:
    rng, errors = np.random.default_rng(1), []
    for seed in range(3 if views > 1 else 6):
        pixels = seen_by(camera, views, seed)
        if camera.is_wide or all(camera.contains(each).all() for each in pixels):
            found = aligned(model, camera, **options)
            errors += [differences_of(found, pixels, seed % views, 0.02, rng)]
    errors = [each for each in errors if each]
    assert len(errors) >= 2
    assert np.isfinite(errors).mean() > 0.8
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


def test_the_model_s_points_move_estimates_of_several_views() -> None:
    pixels, step = seen_by(PIN, 2, 3), np.random.default_rng(0).standard_normal((N, 3))

    def state(h: float) -> np.ndarray:
        moved = Model(points_3d=MEAN + h * step, shape_sigma=0.03)
        result = aligned(moved, PIN)(pixels, [np.ones(N)] * 2)
        return np.append(unknowns(result, base)[:6], np.log(result.alignment.scale))

    base = aligned(SIMILAR, PIN)(pixels, [np.ones(N)] * 2)
    found = base.sensitivity()
    assert found.views.tolist() == [0] * N + [1] * N
    np.testing.assert_array_equal(found.by_points_3d[:, :N], found.by_points_3d[:, N:])
    moved = found.by_points_3d[:, :N].reshape(9, -1) @ step.ravel()
    assert relative_error(moved, difference(state, 1e-5)) < 1e-4
    assert str(found).splitlines()[1].startswith("  views[")


def test_the_unit_of_the_model_changes_derivatives_of_the_translation_alone() -> None:
    pixels, unit = seen_by(PIN, 1, 0), 1e5

    def of(points: np.ndarray, spread: float) -> np.ndarray:
        estimate = aligned(Model(points_3d=points, shape_sigma=spread), PIN, focal="estimate")
        return np.asarray(estimate(pixels, [np.ones(N)]).sensitivity().by_points_2d)

    expected, found = of(MEAN, 0.03), of(unit * MEAN, unit * 0.03)
    found[3:6] /= unit
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max())


def test_a_mask_leaves_keypoints_little_influence() -> None:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) - 0.5
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))])
    model = Model(points_3d=corners, mesh=Mesh(corners, faces))
    turn = Rotation.from_euler("xyz", [0.4, 0.5, 0.1]).as_matrix()
    truth = Alignment(turn, [0.1, 0.0, 4.0], [1.0, 1.2, 0.9])
    mask = cast_geometry(Scene(model.mesh), PIN, truth).mask
    pixels = PIN.project(truth.apply(corners)) + np.random.default_rng(0).normal(0, 1, (8, 2))
    alone = align(model, View(PIN, pixels)).sensitivity()
    found = align(model, View(PIN, pixels, mask=mask)).sensitivity()
    assert (found.rotation_deg < 0.5 * alone.rotation_deg).all()
    moves = found.by_points_2d.reshape(9, -1)  # what keypoints tell is a part of all
    assert (np.diag(moves @ moves.T) <= 1.05 * np.diag(found.covariance)).all()


def test_a_fit_from_a_file_has_its_sensitivity() -> None:
    result = fit_problem(problem_of(2))
    read = Result.from_dict(result.to_dict())
    np.testing.assert_allclose(
        read.sensitivity().by_points_2d, result.sensitivity().by_points_2d, rtol=1e-4, atol=1e-9
    )


def test_what_has_no_evidence_is_refused() -> None:
    result = aligned(SIMILAR, PIN)(seen_by(PIN, 1, 0), [np.ones(N)])
    linear = fit(MEAN, seen_by(PIN, 1, 0)[0], PIN, method="aepnp")
    refusals = [
        (
            lambda: Result.from_dict(result.to_dict()).sensitivity(),
            "sensitivity: the result holds no evidence: it was read from a file; align again",
        ),
        (
            lambda: linear.sensitivity(),
            "sensitivity: the method aepnp minimises no cost, and has no derivatives; fit with "
            'method="optimal"',
        ),
        (
            lambda: result.sensitivity(exact=False),
            "exact: only keypoints of one view of an exact model have a Gauss-Newton sensitivity; "
            "leave it at True",
        ),
        (
            lambda: result.sensitivity(view=1),
            "view: 1 is none of the result's 1 views; give 0 to 0",
        ),
    ]
    for call, message in refusals:
        with pytest.raises(InputError) as refused:
            call()
        assert str(refused.value) == message
