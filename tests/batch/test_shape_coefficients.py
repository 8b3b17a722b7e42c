"""Coefficients of modes in tables: the likeliest beside displacements of each keypoint."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cadalign.batch.outputs import shape_coefficients


@pytest.mark.parametrize("residual_sigma", [0.0, 0.02, 0.5])
def test_coefficients_are_the_likeliest(residual_sigma: float) -> None:
    rng = np.random.default_rng(0)
    mean, modes = rng.normal(size=(6, 3)), rng.normal(size=(2, 6, 3))
    points = mean + np.tensordot([0.7, -1.2], modes, axes=1) + 0.01 * rng.normal(size=(6, 3))
    component = SimpleNamespace(modes=modes, mean=mean, residual_sigma=residual_sigma)
    shape: Any = SimpleNamespace(components=[component], ids=range(6))
    result: Any = SimpleNamespace(component=0, points_3d=points)
    # Offsets over their deviations, beside the coefficients over theirs.
    rows, offsets = modes.reshape(2, -1).T, (points - mean).ravel()
    if residual_sigma:
        rows = np.concatenate([rows / residual_sigma, np.eye(2)])
        offsets = np.concatenate([offsets / residual_sigma, np.zeros(2)])
    expected = np.linalg.lstsq(rows, offsets, rcond=None)[0]
    np.testing.assert_allclose(shape_coefficients(result, shape), expected)
