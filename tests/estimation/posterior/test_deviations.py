"""Covariances of large rotation errors."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign.estimation.estimates import curvature_of_rotations
from cadalign.geometry.rotations import rotation_from_vector, vector_from_rotation


@pytest.mark.long
def test_turns_about_two_axes_turn_about_the_third() -> None:
    """The second-order term, against the composition of random rotations."""
    rng, deviations = np.random.default_rng(0), np.array([0.01, 0.25, 0.35])
    turns = deviations * rng.normal(size=(2, 4000, 3)) / np.sqrt(2)
    found = [
        vector_from_rotation(rotation_from_vector(first) @ rotation_from_vector(second))
        for first, second in zip(*turns, strict=True)
    ]
    # Each turn has half the variance.
    expected = deviations[0] ** 2 + curvature_of_rotations(np.diag(deviations**2 / 2))[0, 0]
    assert np.isclose(np.var(np.array(found)[:, 0]), expected, rtol=0.1)


def test_small_errors_have_no_curvature() -> None:
    covariance = np.diag([1e-6, 2e-6, 3e-6])
    assert (curvature_of_rotations(covariance).diagonal() < 1e-5 * 1e-6).all()


def test_the_curvature_turns_with_the_covariance() -> None:
    turn = rotation_from_vector(np.array([0.3, -0.7, 0.2]))
    covariance = np.diag([0.1, 0.4, 0.6])
    turned = curvature_of_rotations(turn @ covariance @ turn.T)
    assert np.allclose(turned, turn @ curvature_of_rotations(covariance) @ turn.T)
