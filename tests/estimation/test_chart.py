"""Coordinates in which a posterior is sampled: their derivatives are those of the projection."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import cadalign
from cadalign import Alignment, Camera
from cadalign.estimation.uncertainty.posterior import _Chart
from cadalign.solvers.projection import projection_jacobian

CAMERA = Camera(640, 480, 900.0, 880.0, 330.0, 250.0)


@pytest.fixture
def chart() -> _Chart:
    rng = np.random.default_rng(3)
    turn = Rotation.random(random_state=rng).as_matrix()
    alignment = Alignment(turn, [0.4, -0.3, 4.0], np.array([1.0, 1.3, 0.8]))
    points = rng.uniform(-0.5, 0.5, (9, 3)) + [0.3, 0.1, -0.2]
    result = cadalign.fit(points, CAMERA.project(alignment.apply(points)), CAMERA, sigma=1.0)
    return _Chart.of(result)  # type: ignore[arg-type]


def test_pixels_change_as_the_projection_does(chart: _Chart) -> None:
    step = 1e-5
    steps = step * np.concatenate([np.eye(10), -np.eye(10)])
    pixels = chart.evaluate(steps)[0]
    measured = (pixels[:10] - pixels[10:]) / (2 * step)
    points = chart.points + chart.center
    by_unknowns = projection_jacobian(points, chart.camera, chart.alignment)[:, :, :10]
    expected = by_unknowns @ np.linalg.inv(chart.jacobian())
    np.testing.assert_allclose(measured, expected.transpose(2, 0, 1), rtol=1e-5, atol=1e-4)


def test_a_longer_focal_length_enlarges_about_the_principal_point(chart: _Chart) -> None:
    steps = np.zeros((2, 10))
    steps[1, 9] = np.log(2.0)
    pixels, deviations, _, log_focals = chart.evaluate(steps)
    centre = np.array([CAMERA.cx, CAMERA.cy])
    np.testing.assert_allclose(pixels[1] - centre, 2 * (pixels[0] - centre))
    assert np.exp(log_focals[1] - log_focals[0]) == pytest.approx(2.0)
    np.testing.assert_allclose(deviations[:, :9], 0.0, atol=1e-9)
