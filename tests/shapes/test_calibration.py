"""Calibration of shape models: factor of the standard deviations, and tails of errors."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign.shapes.calibration import ShapeCalibration, calibrate
from cadalign.shapes.gaussians import Gaussians

pytestmark = pytest.mark.long

SIGMA = 0.005


def shapes(count: int, factor: float) -> tuple[np.ndarray, Gaussians]:
    """Models of nine rows, and a Gaussian with their standard deviations over a factor."""
    rng = np.random.default_rng(0)
    mean = rng.uniform(-0.5, 0.5, 27)
    modes = 0.03 * rng.normal(size=(12, 27))
    covariance = modes.T @ modes + 0.003**2 * np.eye(27)
    rows = rng.multivariate_normal(mean, factor**2 * covariance, count).reshape(-1, 9, 3)
    return rows, Gaussians(np.ones(1), mean[None], covariance[None])


@pytest.mark.parametrize("factor", [1.0, 1.5, 2.2])
def test_the_factor_of_the_deviations_is_found(factor: float) -> None:
    found = calibrate([shapes(300, factor)], sigma=SIGMA, rng=np.random.default_rng(1))
    assert found.inflation == pytest.approx(factor, rel=0.12)


def test_deviations_are_never_reduced() -> None:
    found = calibrate([shapes(100, 0.3)], sigma=SIGMA, rng=np.random.default_rng(1))
    assert found.inflation == 1


def test_missing_keypoints_are_left_out() -> None:
    rows, mixture = shapes(300, 1.5)
    rows[::2, 0] = np.nan
    rows[:20, :5] = np.nan
    found = calibrate([(rows, mixture)], sigma=SIGMA, rng=np.random.default_rng(1))
    assert found.inflation == pytest.approx(1.5, rel=0.12)
    rows[:, 2:] = np.nan
    found = calibrate([(rows, mixture)], sigma=SIGMA, rng=np.random.default_rng(1))
    assert found == ShapeCalibration(1.0, None)


def test_shapes_with_heavy_tails_have_few_degrees_of_freedom() -> None:
    rows, mixture = shapes(300, 1.0)
    mean = mixture.means[0].reshape(9, 3)
    rng = np.random.default_rng(2)
    far = np.sqrt((4 - 2) / rng.chisquare(4, 300))[:, None, None]  # a t distribution
    found = calibrate([(mean + far * (rows - mean), mixture)], sigma=SIGMA, rng=rng)
    assert found.degrees_of_freedom is not None
    assert found.degrees_of_freedom <= 7
    assert found.inflation == pytest.approx(1, abs=0.25)


def test_few_keypoints_need_less_inflation_of_fine_modes() -> None:
    """The deviations of fine modes are three times the Gaussian's, of main modes the same."""
    rng = np.random.default_rng(0)
    mean, modes = rng.uniform(-0.5, 0.5, 42), np.linalg.qr(rng.normal(size=(42, 42)))[0]
    deviations = np.where(np.arange(42) < 8, 0.1, 0.006)
    covariance = (modes * deviations**2) @ modes.T
    fine = np.where(np.arange(42) < 8, 1.0, 3.0) * deviations
    rows = mean + rng.normal(size=(200, 42)) * fine @ modes.T
    mixture = Gaussians(np.ones(1), mean[None], covariance[None])
    found = calibrate([(rows.reshape(-1, 14, 3), mixture)], sigma=SIGMA, rng=rng)
    assert found.few_keypoints is not None
    assert found.few_keypoints.typical == 12
    assert found.few_keypoints.share < 0.9


def test_models_of_few_keypoints_give_no_decrease() -> None:
    rows, mixture = shapes(50, 1.5)
    rows[:, 6:-2] = np.nan
    found = calibrate([(rows, mixture)], sigma=SIGMA, rng=np.random.default_rng(1))
    assert found.few_keypoints is None
