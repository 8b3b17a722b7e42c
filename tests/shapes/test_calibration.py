"""Factor by which stated deviations of shapes are widened."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign.shapes.calibration import find_inflation
from cadalign.shapes.gaussians import Gaussians

SIGMA = 0.005


def shapes(count: int, factor: float) -> tuple[np.ndarray, Gaussians]:
    """Models of nine rows and a Gaussian whose deviations are theirs over a factor."""
    rng = np.random.default_rng(0)
    mean = rng.uniform(-0.5, 0.5, 27)
    modes = 0.03 * rng.normal(size=(12, 27))
    covariance = modes.T @ modes + 0.003**2 * np.eye(27)
    rows = rng.multivariate_normal(mean, factor**2 * covariance, count).reshape(-1, 9, 3)
    return rows, Gaussians(np.ones(1), mean[None], covariance[None])


@pytest.mark.parametrize("factor", [1.0, 1.5, 2.2])
def test_the_factor_is_that_of_the_deviations(factor: float) -> None:
    found = find_inflation([shapes(300, factor)], sigma=SIGMA, rng=np.random.default_rng(1))
    assert found == pytest.approx(factor, rel=0.12)


def test_deviations_are_never_narrowed() -> None:
    assert find_inflation([shapes(100, 0.3)], sigma=SIGMA, rng=np.random.default_rng(1)) == 1


def test_missing_keypoints_are_left_out() -> None:
    rows, mixture = shapes(300, 1.5)
    rows[::2, 0] = np.nan
    rows[:20, :5] = np.nan
    found = find_inflation([(rows, mixture)], sigma=SIGMA, rng=np.random.default_rng(1))
    assert found == pytest.approx(1.5, rel=0.12)
    rows[:, 2:] = np.nan
    assert find_inflation([(rows, mixture)], sigma=SIGMA, rng=np.random.default_rng(1)) == 1
