"""Coordinates in which a posterior is sampled: alignments and costs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import cadalign
from cadalign import Alignment, Camera
from cadalign.estimation.options import FitOptions
from cadalign.estimation.uncertainty.posterior import Chart, FittedKeypoints
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.solvers.draws import weigh_draws

CAMERA = Camera(640, 480, 900.0, 880.0, 330.0, 250.0)
LENS = Camera(640, 480, 900.0, 880.0, 330.0, 250.0, distortion=(-0.2, 0.05, 1e-3, -1e-3))
POINTS = np.random.default_rng(3).uniform(-0.5, 0.5, (9, 3)) + [0.3, 0.1, -0.2]
STEPS = 0.05 * np.random.default_rng(4).normal(size=(40, 10))


def fitted(camera: Camera, **options: object) -> cadalign.Result:
    turn = Rotation.random(random_state=np.random.default_rng(5)).as_matrix()
    truth = Alignment(turn, [0.4, -0.3, 4.0], np.array([1.0, 1.3, 0.8]))
    noise = np.random.default_rng(6).normal(size=(9, 2))
    pixels = camera.project(truth.apply(POINTS)) + noise
    return cadalign.fit(POINTS, pixels, camera, **{"sigma": 2.0, **options})


def chart_of(result: cadalign.Result, widening: float = 1.0) -> Chart:
    alignment, camera, view = result.alignment, result.camera, result.views[0]
    options = result.options
    assert isinstance(options, FitOptions)
    keypoints = FittedKeypoints(POINTS, view.residuals, view.inliers, alignment, camera, options)
    return Chart.from_fit(keypoints, widening)


def moved(result: cadalign.Result, deviation: np.ndarray) -> tuple[Alignment, Camera]:
    """The alignment and camera at deviations (10,) of the unknowns."""
    own, camera = result.alignment, result.camera
    alignment = Alignment(
        rotation_from_vector(deviation[:3]) @ own.rotation,
        own.translation + deviation[3:6],
        own.scale * np.exp(deviation[6:9]),
    )
    longer = np.exp(deviation[9])
    return alignment, Camera(
        *(camera.width, camera.height, camera.fx * longer, camera.fy * longer),
        *(camera.cx, camera.cy),
        distortion=camera.distortion,
    )


def cost_of(
    result: cadalign.Result, deviation: np.ndarray, weights: np.ndarray | float = 1.0
) -> float:
    alignment, camera = moved(result, deviation)
    seen = result.camera.project(result.alignment.apply(POINTS)) - result.residuals
    squares = ((camera.project(alignment.apply(POINTS)) - seen) ** 2).sum(axis=1)
    return float((weights * squares).sum()) / 2.0**2


def test_costs_are_those_of_the_reprojection_errors() -> None:
    result = fitted(CAMERA)
    deviations, costs, _ = weigh_draws(*chart_of(result), STEPS)
    np.testing.assert_allclose(costs, [cost_of(result, each) for each in deviations], rtol=1e-9)
    np.testing.assert_allclose(weigh_draws(*chart_of(result, 4.0), STEPS)[1], costs / 4)


def test_a_lens_counts_by_its_derivatives_at_the_estimate() -> None:
    result = fitted(LENS)
    deviations, costs, _ = weigh_draws(*chart_of(result), STEPS / 20)
    expected = [cost_of(result, each) for each in deviations]
    np.testing.assert_allclose(costs, expected, rtol=2e-3)


def test_a_loss_counts_by_its_weights_at_the_estimate() -> None:
    result = fitted(CAMERA, loss="cauchy", loss_scale=0.5)
    weights = 1 / (1 + (result.residuals**2).sum(axis=1) / (2.0 * 0.5) ** 2)
    deviations, costs, _ = weigh_draws(*chart_of(result), STEPS)
    expected = [cost_of(result, each, weights) for each in deviations]
    np.testing.assert_allclose(costs, expected, rtol=1e-9)


def test_deviations_are_to_first_order_those_of_the_unknowns() -> None:
    chart, step = chart_of(fitted(CAMERA)), 1e-6
    deviations = weigh_draws(*chart, step * np.concatenate([np.eye(10), -np.eye(10)]))[0]
    measured = (deviations[:10] - deviations[10:]) / (2 * step)
    np.testing.assert_allclose(measured.T @ chart.jacobian(), np.eye(10), atol=1e-6)


def test_priors_cost_what_their_deviations_say() -> None:
    prior = cadalign.FocalPrior(1000.0, 0.1)
    result = fitted(CAMERA, focal="estimate", focal_prior=prior, stretch_sigma=0.2)
    deviations, costs, _ = weigh_draws(*chart_of(result), STEPS)
    logs = np.log(result.alignment.scale) + deviations[:, 6:9]
    focal = np.log(result.camera.fx / 1000.0) + deviations[:, 9]
    expected = [cost_of(result, each) for each in deviations]
    expected += (logs[:, 1:] ** 2).sum(axis=1) / 0.2**2 + (logs[:, 0] / 0.2) ** 2
    np.testing.assert_allclose(costs, expected + focal**2 / 0.1**2, rtol=1e-9)


def test_rotations_have_their_uniform_measure() -> None:
    steps = np.zeros((3, 10))
    steps[1:, 0] = 1.0, 3.0
    _, costs, logs = weigh_draws(*chart_of(fitted(CAMERA)), steps)
    density = (np.sin(steps[1:, 0] / 2) / (steps[1:, 0] / 2)) ** 2
    np.testing.assert_allclose(np.exp(logs + costs / 2), [1.0, *density])


@pytest.mark.parametrize(
    ("coordinate", "value"), [(1, 3.2), (5, 3.1), (7, -3.1), (9, 3.1)], ids=str
)
def test_beyond_the_priors_ends_nothing_is_likely(coordinate: int, value: float) -> None:
    step = np.zeros((1, 10))
    step[0, coordinate] = value
    _, costs, logs = weigh_draws(*chart_of(fitted(CAMERA)), step)
    assert logs == -np.inf
    assert costs > 0


def test_behind_the_camera_the_cost_is_infinite() -> None:
    result = fitted(CAMERA)
    step = np.zeros((1, 10))
    step[0, 5] = np.log(0.01)  # the centroid comes nearer than keypoints are to it
    _, costs, logs = weigh_draws(*chart_of(result), step)
    assert costs == np.inf
    assert logs == -np.inf
