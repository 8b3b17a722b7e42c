"""Solvers return rotations for any keypoints."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cadalign import Camera, Result, fit
from cadalign.errors import DegenerateError
from cadalign.solvers import aepnp, aepnp_paper
from cadalign.solvers.linalg import rotation_from_quaternion

CAMERA = Camera(640, 480, 935, 935, 319.5, 239.5)
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


def departure(rotation: np.ndarray) -> float:
    """Largest entry of R R' - I; infinite for a reflection."""
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    return float(error) if np.linalg.det(rotation) > 0 else np.inf


def test_length_of_a_quaternion_does_not_matter() -> None:
    rng = np.random.default_rng(0)
    for x, y, z, w in rng.normal(size=(20, 4)) * rng.uniform(0.1, 10, (20, 1)):
        found = np.empty((3, 3))
        rotation_from_quaternion(w, x, y, z, found)
        np.testing.assert_allclose(found, Rotation.from_quat([x, y, z, w]).as_matrix(), atol=1e-12)


def test_start_far_from_a_rotation_does_not_reach_the_result() -> None:
    points_2d = [
        [265, 200],
        [268, 157],
        [293, 230],
        [296, 190],
        [346, 197],
        [348, 153],
        [368, 228],
        [370, 187],
    ]
    result = fit(0.25 * CORNERS, points_2d, CAMERA, stretch="none")
    assert departure(result.alignment.rotation) < 1e-9
    assert result.rms == pytest.approx(10.462, abs=1e-3)  # the global minimum
    assert Result.from_dict(result.to_dict()).alignment == result.alignment


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("solver", [aepnp, aepnp_paper])
def test_linear_solvers_never_return_nan(solver: Callable[..., tuple[np.ndarray, ...]]) -> None:
    rng = np.random.default_rng(8)
    for size in 10.0 ** np.arange(0, 300, 10):
        try:
            rotation, translation, scale = solver(
                rng.uniform(-1, 1, (8, 3)) * size, rng.uniform(-1, 1, (8, 2)) * size
            )
        except DegenerateError:
            continue
        assert departure(rotation) < 1e-9
        assert np.isfinite([translation, scale]).all()
