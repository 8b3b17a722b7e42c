"""The search for the few keypoints that contradict the others."""

from __future__ import annotations

import numpy as np

from cadalign import Alignment, Camera
from cadalign.annotate.outliers import PlacedRows, Rows, find_outliers


def test_a_search_that_goes_round_in_circles_ends() -> None:
    """Each of two groups agrees with the fit to the other: without end, for thousands of points."""
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
    points = np.random.default_rng(0).uniform(-1, 1, (40, 3))
    shift, calls = np.repeat([0.0, 0.1, -0.1], [20, 10, 10]), []
    seen = camera.project(points + np.column_stack([shift, 0 * shift, 5 + 0 * shift]))
    noise = np.tile(np.eye(2), (40, 1, 1))
    noise[:20] *= 1e4  # these agree with both

    def fit_rows(rows: Rows, robust: bool) -> PlacedRows:
        calls.append(rows)
        side = -0.1 if 20 in rows else 0.1
        return Alignment(np.eye(3), [side, 0.0, 5.0], np.ones(3)), camera, None

    find_outliers(points, seen, fit_rows, unknowns=8, noise=noise)
    assert len(calls) < 10
