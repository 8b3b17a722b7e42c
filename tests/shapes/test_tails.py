"""Regions of Gaussian errors and of errors with heavier tails."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign.shapes.parts import probability_within, radius_of


@pytest.mark.parametrize("freedom", [None, 3.0, 5.0, 20.0])
@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_the_radius_is_the_inverse(dimension: int, freedom: float | None) -> None:
    for probability in (0.05, 0.68, 0.95, 0.999):
        square = radius_of(probability, dimension, freedom) ** 2
        assert probability_within(square, dimension, freedom) == pytest.approx(probability)


@pytest.mark.parametrize("freedom", [5.0, 8.0])
def test_regions_hold_errors_of_their_covariance(freedom: float) -> None:
    rng = np.random.default_rng(0)
    scale = np.sqrt((freedom - 2) / rng.chisquare(freedom, 100_000))
    errors = scale[:, None] * rng.normal(size=(100_000, 3))
    assert np.allclose(np.cov(errors.T), np.eye(3), atol=0.15)
    squares = (errors**2).sum(axis=1)
    for probability in (0.5, 0.68, 0.95, 0.99):
        inside = (squares < radius_of(probability, 3, freedom) ** 2).mean()
        assert inside == pytest.approx(probability, abs=0.005)


def test_many_degrees_of_freedom_are_gaussian() -> None:
    assert radius_of(0.95, 3, 1e6) == pytest.approx(radius_of(0.95, 3), rel=1e-4)
