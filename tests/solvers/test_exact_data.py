"""Solvers on data without noise: the truth, wherever in the image the object is seen."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cadalign import Alignment, Camera, fit
from cadalign.metrics import rotation_error

CAMERA = Camera(2000, 1500, 900.0, 880.0, 950.0, 720.0)


@pytest.mark.parametrize("method", ["aepnp", "optimal"])
@pytest.mark.parametrize("place", [(0.0, 0.0, 5.0), (-4.0, 1.0, 5.0), (2.0, -3.5, 6.0)])
def test_the_truth_is_found_at_any_place_of_the_image(
    method: str, place: tuple[float, float, float]
) -> None:
    for seed in range(6):
        rng = np.random.default_rng(seed)
        points = rng.uniform(-0.5, 0.5, (8, 3)) + [1.0, -2.0, 0.5]  # off the model's origin, too
        rotation = Rotation.random(random_state=seed).as_matrix()
        scale = np.array([1.0, *rng.uniform(0.6, 1.6, 2)])
        middle = rotation @ (scale * points.mean(axis=0))
        truth = Alignment(rotation, np.array(place) - middle, scale)
        found = fit(points, CAMERA.project(truth.apply(points)), CAMERA, method=method).alignment
        assert rotation_error(est=found, gt=truth) < 1e-3
        assert found.scale == pytest.approx(scale, rel=1e-4)
        assert found.translation == pytest.approx(truth.translation, rel=1e-4, abs=1e-4)
