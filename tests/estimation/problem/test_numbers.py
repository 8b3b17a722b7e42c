"""`fit` of numbers of any kind and size: a valid result or a clear error."""

from __future__ import annotations

import numpy as np
import pytest
from support.problems import problem_of

from cadalign import Camera, fit
from cadalign.errors import DegenerateError

GOOD = problem_of(3, points=8, noise_px=0.0)


def test_linear_solver_never_puts_keypoints_behind_the_camera() -> None:
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(20):
        points_2d = rng.uniform(0, 480, GOOD.points_2d.shape)
        try:
            result = fit(GOOD.points_3d, points_2d, GOOD.camera, method="aepnp")
        except DegenerateError:
            refused += 1
        else:
            assert (result.alignment.apply(GOOD.points_3d)[:, 2] > 0).all()
    assert 0 < refused < 20


def test_matrices_and_numbers_of_any_width_are_taken() -> None:
    given = [GOOD.points_2d, GOOD.camera]
    expected = fit(GOOD.points_3d, *given, loss="huber")
    result = fit(np.asmatrix(GOOD.points_3d), *given, loss="huber", loss_scale=np.float32(2.0))
    assert type(result.points_3d) is np.ndarray
    assert result.alignment == expected.alignment
    wide = fit(GOOD.points_3d, *given, loss="huber", loss_scale=np.longdouble(2.0))
    assert wide.alignment == expected.alignment
    sigma = memoryview(np.ones(len(GOOD.points_2d)))
    assert fit(GOOD.points_3d, *given, loss="huber", sigma=sigma).alignment == expected.alignment


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("method", ["optimal", "aepnp", "aepnp-paper", "epnp"])
@pytest.mark.parametrize("size", [1e20, 1e80, 1e160, 1e300])
def test_numbers_beyond_the_range_give_a_rotation_or_a_clear_error(
    method: str, size: float
) -> None:
    for points_3d, points_2d in (
        (size * GOOD.points_3d, GOOD.points_2d),
        (GOOD.points_3d, size * GOOD.points_2d),
        (size * GOOD.points_3d, size * GOOD.points_2d),
    ):
        try:
            result = fit(points_3d, points_2d, GOOD.camera, method=method)
        except DegenerateError:
            continue
        rotation = result.alignment.rotation
        assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-9
        assert np.isfinite(result.alignment.translation).all()
        assert np.isfinite(result.rms)


def test_covariance_that_overflows_is_refused() -> None:
    points_3d = 1e143 * np.array(
        [
            *([-3.01921926, -1.40069160, -0.323787504], [1.58918449, 3.68002198, 0.902957127]),
            *([1.69184056, 2.79916949, 2.08083567], [-1.34626278, 0.547198609, 0.955675583]),
            *([-1.47428239, -0.348814863, -2.27185582], [0.442739103, -3.00925987, 3.05553329]),
            [-2.62555778, -3.21181564, -2.75531399],
        ]
    )
    points_2d = 1e59 * np.array(
        [
            *([4.40611523, 1.85512196], [0.987048282, 2.31473839], [3.12152510, 1.74570863]),
            *([3.44817634, 1.86680212], [3.90888677, 0.418181099], [0.522368448, 3.15601929]),
            [2.26568202, 0.575478618],
        ]
    )
    camera = Camera(640, 480, 1048204.971549734, 245403.3967991035, 319.5, 239.5)
    with pytest.raises(DegenerateError, match="overflows floating-point numbers"):
        fit(points_3d, points_2d, camera, stretch="none", stretch_sigma=0.001, sigma=None)
