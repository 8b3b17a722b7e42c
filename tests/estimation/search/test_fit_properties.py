"""Properties of `fit` that hold for every problem: recovery, equivariance, valid results."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.problems import of_unknowns, problem_of

from cadalign import Alignment, Camera, Result, fit
from cadalign.errors import DegenerateError
from cadalign.evaluation.simulation import SIMULATION_CAMERA, SimulatedProblem
from cadalign.geometry.camera import rotate_alignment
from cadalign.metrics import rotation_error

SEEDS = st.integers(0, 2**32 - 1)
COUNTS = st.integers(7, 60)
METHODS = pytest.mark.parametrize("method", ["optimal", "aepnp"])
UNITS = st.sampled_from([1e-6, 1e-3, 1e3, 1e6])


def assert_aligned(result: Result, expected: Alignment, tolerance: float = 1e-6) -> None:
    """Rotation [rad], translation over the distance and relative scale within the tolerance."""
    est = result.alignment
    assert np.radians(rotation_error(est=est, gt=expected)) < tolerance
    distance = np.linalg.norm(expected.translation)
    assert np.linalg.norm(est.translation - expected.translation) < tolerance * distance
    assert np.abs(est.scale / expected.scale - 1).max() < tolerance


def assert_explains(result: Result, problem: SimulatedProblem, tolerance_px: float = 1e-5) -> None:
    """No residual exceeds the limit; any of several exact alignments passes."""
    assert np.abs(result.residuals).max() < tolerance_px
    assert (result.alignment.apply(problem.points_3d)[:, 2] > 0).all()


# --- noise-free recovery ---------------------------------------------------------------------


@METHODS
@pytest.mark.parametrize(
    ("camera", "depth", "explained", "tolerance"),
    [
        (SIMULATION_CAMERA, (4.0, 8.0), 1e-5, 1e-6),
        (Camera(640, 480, 6000.0, 6000.0, 319.5, 239.5), (60.0, 100.0), 1e-6, 1e-5),
        # At a thousand sizes, depths differ by a thousandth, and pixels are exact to 1e-13.
        (Camera(640, 480, 1e5, 1e5, 319.5, 239.5), (900.0, 1100.0), 1e-5, 1e-4),
        (Camera.from_fov(640, 480, fov_x=120.0), (2.0, 3.0), 1e-5, 1e-6),
    ],
    ids=["simulation", "far", "perspective lost", "near and wide"],
)
@given(seed=SEEDS, points=COUNTS)
def test_recovery_without_noise(
    method: str,
    camera: Camera,
    depth: tuple[float, float],
    explained: float,
    tolerance: float,
    seed: int,
    points: int,
) -> None:
    problem = problem_of(seed, points=points, noise_px=0.0, camera=camera, depth=depth)
    result = fit(problem.points_3d, problem.points_2d, camera, method=method)
    assert_explains(result, problem, explained)
    assert_aligned(result, problem.alignment, tolerance)


@METHODS
@given(seed=SEEDS, points=COUNTS, axis=st.integers(0, 2), thickness=st.sampled_from([0.1, 0.01]))
def test_recovery_of_keypoints_near_a_plane(
    method: str, seed: int, points: int, axis: int, thickness: float
) -> None:
    problem = problem_of(seed, points=points, noise_px=0.0)
    factor = np.ones(3)
    factor[axis] = thickness
    points_3d = problem.points_3d * factor
    points_2d = problem.camera.project(problem.alignment.apply(points_3d))
    result = fit(points_3d, points_2d, problem.camera, method=method)
    assert_aligned(result, problem.alignment, 1e-6 / thickness)


# --- equivariance ----------------------------------------------------------------------------


@METHODS
@given(seed=SEEDS, points=COUNTS, angle=st.floats(-np.pi, np.pi))
def test_equivariance_under_turning_the_image(
    method: str, seed: int, points: int, angle: float
) -> None:
    problem = problem_of(seed, points=points, noise_px=0.5)
    turn = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    center = np.array([problem.camera.cx, problem.camera.cy])
    points_2d = (problem.points_2d - center) @ turn[:2, :2].T + center
    before = fit(problem.points_3d, problem.points_2d, problem.camera, method=method)
    after = fit(problem.points_3d, points_2d, problem.camera, method=method)
    assert_aligned(after, rotate_alignment(before.alignment, turn), 1e-4)


@given(seed=SEEDS, points=COUNTS)
def test_optimum_is_equivariant_under_stretching_the_model(seed: int, points: int) -> None:
    problem = problem_of(seed, points=points, noise_px=0.5)
    factor = np.array([1.0, *np.random.default_rng(seed).uniform(0.3, 3, 2)])
    before = fit(problem.points_3d, problem.points_2d, problem.camera)
    after = fit(problem.points_3d * factor, problem.points_2d, problem.camera)
    old = before.alignment
    assert_aligned(after, Alignment(old.rotation, old.translation, old.scale / factor), 1e-4)
    np.testing.assert_allclose(
        after.fisher_covariance, before.fisher_covariance, rtol=1e-2, atol=1e-6
    )


@METHODS
@given(seed=SEEDS, points=COUNTS, size=st.sampled_from([5.0, 1e3]))
def test_equivariance_under_shifting_the_model(
    method: str, seed: int, points: int, size: float
) -> None:
    problem = problem_of(seed, points=points, noise_px=0.5)
    shift = size * np.random.default_rng(seed).uniform(-1, 1, 3)
    before = fit(problem.points_3d, problem.points_2d, problem.camera, method=method).alignment
    after = fit(problem.points_3d + shift, problem.points_2d, problem.camera, method=method)
    expected = Alignment(before.rotation, before.translation - before.linear @ shift, before.scale)
    assert_aligned(after, expected, 1e-4)


@METHODS
@given(seed=SEEDS, points=COUNTS, unit=UNITS)
def test_equivariance_under_a_change_of_the_models_unit(
    method: str, seed: int, points: int, unit: float
) -> None:
    problem = problem_of(seed, points=points, noise_px=0.5)
    before = fit(problem.points_3d, problem.points_2d, problem.camera, method=method)
    after = fit(unit * problem.points_3d, problem.points_2d, problem.camera, method=method)
    old = before.alignment
    assert_aligned(after, Alignment(old.rotation, unit * old.translation, old.scale), 1e-5)
    if before.fisher_covariance is not None:
        factor = np.array([1, 1, 1, unit, unit, unit, 1, 1, 1])
        deviation = np.sqrt(before.fisher_covariance.diagonal())
        difference = after.fisher_covariance / np.outer(factor, factor) - before.fisher_covariance
        assert (np.abs(difference) <= 1e-4 * np.outer(deviation, deviation)).all()


@METHODS
@given(seed=SEEDS, points=COUNTS, resolution=st.sampled_from([0.1, 3.0, 100.0]))
def test_invariance_to_the_images_resolution(
    method: str, seed: int, points: int, resolution: float
) -> None:
    problem = problem_of(seed, points=points, noise_px=0.5)
    camera = problem.camera
    scaled = Camera(
        6400,
        4800,
        resolution * camera.fx,
        resolution * camera.fy,
        resolution * camera.cx,
        resolution * camera.cy,
    )
    before = fit(problem.points_3d, problem.points_2d, camera, method=method)
    after = fit(
        problem.points_3d, resolution * problem.points_2d, scaled, method=method, sigma=resolution
    )
    assert_aligned(after, before.alignment, 1e-5)


@METHODS
@given(seed=SEEDS, points=COUNTS)
def test_invariance_to_the_points_order(method: str, seed: int, points: int) -> None:
    problem = problem_of(seed, points=points, noise_px=0.5)
    order = np.random.default_rng(seed).permutation(points)
    before = fit(problem.points_3d, problem.points_2d, problem.camera, method=method)
    after = fit(problem.points_3d[order], problem.points_2d[order], problem.camera, method=method)
    assert_aligned(after, before.alignment, 1e-4)
    np.testing.assert_allclose(after.residuals, before.residuals[order], rtol=0, atol=1e-3)


def test_cauchys_optimum_does_not_depend_on_where_outliers_stand() -> None:
    differences = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        problem = problem_of(seed, points=10, noise_px=1.0)
        pixels = problem.points_2d.copy()
        pixels[:2] += rng.normal(0, 40, (2, 2))
        costs = []
        for order in (rng.permutation(10) for _ in range(4)):
            given = problem.points_3d[order], pixels[order], problem.camera
            costs.append(fit(*given, loss="cauchy").cost)
        differences.append(np.ptp(costs))
    assert np.mean(np.array(differences) > 1e-3) < 0.05


@given(seed=SEEDS, points=COUNTS)
def test_measuring_every_point_again_halves_the_variance(seed: int, points: int) -> None:
    problem = problem_of(seed, points=points, noise_px=0.5)
    once = fit(problem.points_3d, problem.points_2d, problem.camera)
    rows = np.tile(np.arange(points), 2)
    again = np.repeat([0.0, 1e-5], points)[:, None]  # what is the same counts once
    twice = fit(problem.points_3d[rows], problem.points_2d[rows] + again, problem.camera)
    assert_aligned(twice, once.alignment, 1e-4)
    deviation = np.sqrt(once.fisher_covariance.diagonal())
    difference = np.abs(2 * twice.fisher_covariance - once.fisher_covariance)
    assert (difference <= 1e-3 * np.outer(deviation, deviation)).all()


# --- valid results ---------------------------------------------------------------------------


def assert_valid(alignment: Alignment, points_3d: np.ndarray) -> None:
    rotation = alignment.rotation
    assert np.abs(rotation.T @ rotation - np.eye(3)).max() < 1e-12
    assert abs(np.linalg.det(rotation) - 1) < 1e-12
    assert (alignment.scale > 0).all()
    assert alignment.scale[0] == 1.0
    assert np.isfinite(alignment.translation).all()
    assert (alignment.apply(points_3d)[:, 2] > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["optimal", "aepnp", "aepnp-paper", "epnp"])
@given(seed=SEEDS, points=st.integers(6, 30), noise=st.sampled_from([0.0, 1.0, 10.0, 100.0]))
def test_every_result_is_a_valid_alignment(
    method: str, seed: int, points: int, noise: float
) -> None:
    problem = problem_of(seed, points=points, noise_px=noise)
    try:
        result = fit(problem.points_3d, problem.points_2d, problem.camera, method=method)
    except DegenerateError:
        assert noise > 0  # keypoints that contradict each other may leave no alignment
        return
    assert_valid(result.alignment, problem.points_3d)
    for other in result.alternatives:
        assert_valid(other.alignment, problem.points_3d)
    assert np.isfinite(result.residuals).all()
    if result.fisher_covariance is not None:
        assert (np.linalg.eigvalsh(of_unknowns(result.fisher_covariance)) > 0).all()
        assert (result.fisher_covariance == result.fisher_covariance.T).all() or np.allclose(
            result.fisher_covariance, result.fisher_covariance.T, rtol=1e-6
        )
