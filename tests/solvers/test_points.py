"""Center, size and plane of a set of points."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign.geometry.alignment import describe_plane
from cadalign.solvers.alignment import center_and_unit


def test_unit_is_the_rms_distance_from_the_mean() -> None:
    points = np.random.default_rng(0).normal(0, 2.0, (30, 3)) + (100.0, -50.0, 7.0)
    center, unit = center_and_unit(points)
    np.testing.assert_allclose(center, points.mean(axis=0))
    assert unit == pytest.approx(np.linalg.norm(points.std(axis=0)))


def test_plane_of_many_points_takes_linear_memory() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (300_000, 3))
    assert describe_plane(points) is None
    points[:, 1] = 0.5
    assert describe_plane(points) == "the points lie in the plane y = 0.5"
    points[:, 2] = points[:, 0]
    assert describe_plane(points[:8]) == "the points lie on one line"
    points[:8, 1] = np.linspace(0, 1, 8) ** 2
    assert describe_plane(points[:8]) == "the points lie in one plane"
