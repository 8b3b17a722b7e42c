"""What `fit` refuses, word for word."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.problems import problem_of
from support.refusals import refusal

from cadalign import Camera, RansacOptions, fit
from cadalign.errors import CadalignError, DegenerateError, InputError, quote
from cadalign.evaluation.simulation import simulate_problem

GOOD = problem_of(3, points=8, noise_px=0.0)
METHODS = ["optimal", "aepnp", "aepnp-paper", "epnp"]
SIGMA_FIX = (
    "give a positive number, one per keypoint, or a 2 x 2 covariance per keypoint, in pixels"
)
SPAN_FIX = "a linear solver needs keypoints that span a volume"


def fit_refusal(points_3d: Any, points_2d: Any, camera: Any, **options: Any) -> CadalignError:
    return refusal(lambda: fit(points_3d, points_2d, camera, **options))


@pytest.mark.parametrize(
    ("method", "count", "text"),
    [
        (
            "optimal",
            3,
            "points_3d: 3 keypoints are too few for 8 unknowns; "
            "give at least 4, fewer unknowns by stretch=, or a prior",
        ),
        (
            "optimal",
            0,
            "points_3d: 0 keypoints are too few for 8 unknowns; "
            "give at least 4, fewer unknowns by stretch=, or a prior",
        ),
        (
            "aepnp",
            5,
            "points_3d: 5 keypoints are too few for the method 'aepnp'; give at least 6",
        ),
        (
            "aepnp",
            0,
            "points_3d: 0 keypoints are too few for the method 'aepnp'; give at least 6",
        ),
        (
            "aepnp-paper",
            5,
            "points_3d: 5 points are too few for a linear solver; give at least 6",
        ),
        ("epnp", 3, "points_3d: 3 points are too few for EPnP; give at least 4"),
    ],
)
def test_too_few_points_are_refused(method: str, count: int, text: str) -> None:
    error = fit_refusal(GOOD.points_3d[:count], GOOD.points_2d[:count], GOOD.camera, method=method)
    assert isinstance(error, DegenerateError)
    assert str(error) == text


def with_value(array: np.ndarray, row: int, value: float) -> np.ndarray:
    changed = array.copy()
    changed[row, 1] = value
    return changed


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("points_3d", "points_2d", "text"),
    [
        (
            GOOD.points_3d,
            GOOD.points_2d[:5],
            "points_2d: 8 model points but 5 image points; row i of both must be the same keypoint",
        ),
        (GOOD.points_3d[:, :2], GOOD.points_2d, "points_3d: shape (8, 2), expected (n, 3)"),
        (GOOD.points_3d, GOOD.points_3d, "points_2d: shape (8, 3), expected (n, 2)"),
        (GOOD.points_3d[0], GOOD.points_2d, "points_3d: shape (3,), expected (n, 3)"),
        (
            with_value(GOOD.points_3d, 6, np.nan),
            GOOD.points_2d,
            "points_3d: NaN or infinite values in row 6; remove or repair these",
        ),
        (
            GOOD.points_3d,
            with_value(GOOD.points_2d, 2, -np.inf),
            "points_2d: NaN or infinite values in row 2; remove or repair these",
        ),
        (
            [["a", 0, 0]] * 8,
            GOOD.points_2d,
            "points_3d: not an array of numbers (could not convert string to float: 'a')",
        ),
        (
            GOOD.points_3d.astype(complex),
            GOOD.points_2d,
            "points_3d: not an array of numbers (they are complex128)",
        ),
        (
            np.ma.masked_greater(GOOD.points_3d, 0.0),
            GOOD.points_2d,
            "points_3d: not an array of numbers (some are masked)",
        ),
    ],
)
def test_points_that_are_none_are_refused(
    method: str, points_3d: Any, points_2d: Any, text: str
) -> None:
    error = fit_refusal(points_3d, points_2d, GOOD.camera, method=method)
    assert isinstance(error, InputError)
    assert str(error) == text


@pytest.mark.parametrize("method", METHODS)
def test_something_else_than_a_camera_is_refused(method: str) -> None:
    error = fit_refusal(GOOD.points_3d, GOOD.points_2d, np.eye(3), method=method)
    assert str(error) == "camera: expected a cadalign.Camera, got ndarray"


OPTIMAL_FIX = "add keypoints elsewhere, hold scales fixed with stretch=, or give stretch_sigma"


def in_plane(axis: int) -> tuple[np.ndarray, np.ndarray]:
    points_3d = GOOD.points_3d.copy()
    points_3d[:, axis] = 0.1
    return points_3d, GOOD.camera.project(GOOD.alignment.apply(points_3d))


def test_linear_solver_names_the_normal_of_an_oblique_plane() -> None:
    points_3d = GOOD.points_3d.copy()
    points_3d[:, 2] = points_3d[:, 1]
    error = fit_refusal(points_3d, GOOD.points_2d, GOOD.camera, method="aepnp")
    normals = ["(0, -0.707, 0.707)", "(0, 0.707, -0.707)"]
    normals += [text.replace("(0,", "(-0,") for text in normals]
    assert str(error) in [
        f"points_3d: the points lie in one plane, with the normal {normal}; {SPAN_FIX}"
        for normal in normals
    ]


def test_four_keypoints_that_no_alignment_reprojects_are_refused() -> None:
    rng = np.random.default_rng(0)
    points_3d, points_2d = rng.uniform(-1, 1, (4, 3)), rng.uniform(0, 480, (4, 2))
    error = fit_refusal(points_3d, points_2d, Camera(640, 480, 600, 600, 319.5, 239.5))
    assert isinstance(error, DegenerateError)
    assert "is not determined: seen from there, the keypoints leave it open" in str(error)


@pytest.mark.parametrize("method", ["aepnp", "aepnp-paper"])
@pytest.mark.parametrize(
    ("points", "text"),
    [
        (in_plane(0), "the points lie in the plane x = 0.1"),
        (in_plane(1), "the points lie in the plane y = 0.1"),
        (in_plane(2), "the points lie in the plane z = 0.1"),
        ((GOOD.points_3d * [1, 0, 0], GOOD.points_2d), "the points lie on one line"),
        ((np.full((8, 3), 0.3), GOOD.points_2d), "all points are the same"),
    ],
)
def test_linear_solvers_refuse_points_that_span_no_volume(
    method: str, points: tuple[np.ndarray, np.ndarray], text: str
) -> None:
    error = fit_refusal(*points, GOOD.camera, method=method)
    assert isinstance(error, DegenerateError)
    assert str(error) == f"points_3d: {text}; {SPAN_FIX}"


@pytest.mark.parametrize("axis", [1, 2])
def test_optimum_says_which_stretch_a_plane_leaves_open(axis: int) -> None:
    for seed in range(10):
        problem = problem_of(seed, points=8, noise_px=0.0)
        points_3d = problem.points_3d.copy()
        points_3d[:, axis] = 0.1
        points_2d = problem.camera.project(problem.alignment.apply(points_3d))
        error = fit_refusal(points_3d, points_2d, problem.camera)
        assert isinstance(error, DegenerateError)
        assert str(error) == (
            f"points_3d: the scale s_{'xyz'[axis]} is not determined: "
            f"the points lie in the plane {'xyz'[axis]} = 0.1; {OPTIMAL_FIX}"
        )


@pytest.mark.parametrize(
    ("points_3d", "reason"),
    [
        (GOOD.points_3d * [1, 0, 0], "the points lie on one line"),
        (np.full((8, 3), 0.3), "all points are the same"),
    ],
)
def test_optimum_says_why_nothing_is_determined(points_3d: np.ndarray, reason: str) -> None:
    points_2d = GOOD.camera.project(GOOD.alignment.apply(points_3d))
    error = fit_refusal(points_3d, points_2d, GOOD.camera)
    assert isinstance(error, DegenerateError)
    assert reason in str(error)
    assert error.fix == OPTIMAL_FIX


def test_linear_solver_never_puts_keypoints_behind_the_camera() -> None:
    rng = np.random.default_rng(0)
    refusals = []
    for _ in range(20):
        points_2d = rng.uniform(0, 480, GOOD.points_2d.shape)
        try:
            result = fit(GOOD.points_3d, points_2d, GOOD.camera, method="aepnp")
        except DegenerateError as error:
            refusals.append(str(error))
        else:
            assert (result.alignment.apply(GOOD.points_3d)[:, 2] > 0).all()
    assert set(refusals) == {
        "points_2d: no alignment with all keypoints in front of the camera was found; "
        "check that points_3d and points_2d correspond, row by row, and the camera"
    }


def test_pixels_beyond_the_lens_are_refused() -> None:
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, (-0.4, 0.0, 0.0, 0.0))
    points_2d = GOOD.points_2d.copy()
    points_2d[5] = [5000, 240]
    assert str(fit_refusal(GOOD.points_3d, points_2d, camera)) == (
        "points_2d: the lens distortion cannot be undone at 1 of 8 pixels, the first is point 5; "
        "these lie outside the area in which the lens model is valid; drop them"
    )


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"sigma": 0}, f"sigma: 0 is not a standard deviation; {SIGMA_FIX}"),
        ({"sigma": -1.0}, f"sigma: -1.0 is not a standard deviation; {SIGMA_FIX}"),
        ({"sigma": np.nan}, f"sigma: nan is not a standard deviation; {SIGMA_FIX}"),
        ({"sigma": np.ones(5)}, "sigma: shape (5,), expected (8)"),
        ({"sigma": np.zeros(8)}, f"sigma: has values that are not positive; {SIGMA_FIX}"),
        (
            {"sigma": with_value(np.ones((8, 2)), 0, np.nan)[:, 1]},
            "sigma: NaN or infinite values in row 0; remove or repair these",
        ),
        (
            {"sigma": np.array([np.eye(2)] * 7 + [np.diag([1.0, -1.0])])},
            "sigma: the covariance of keypoint 7 is not symmetric and positive definite; "
            + SIGMA_FIX,
        ),
        (
            {"sigma": np.array([np.eye(2)] * 6 + [[[1, 0.5], [0, 1]]] + [np.eye(2)])},
            "sigma: the covariance of keypoint 6 is not symmetric and positive definite; "
            + SIGMA_FIX,
        ),
        ({"method": "aepnp", "sigma": np.ones(5)}, "sigma: shape (5,), expected (8)"),
        (
            {"method": "epnp", "sigma": np.zeros(8)},
            f"sigma: has values that are not positive; {SIGMA_FIX}",
        ),
        ({"loss": "l1"}, "loss: unknown loss 'l1'; known are linear, huber, cauchy"),
        ({"loss_scale": 0}, "loss_scale: 0 is not positive"),
        ({"loss_scale": np.nan}, "loss_scale: nan is not positive"),
        ({"loss_scale": "2"}, "loss_scale: '2' is not positive"),
        ({"stretch_sigma": -0.1}, "stretch_sigma: -0.1 is not positive"),
        ({"stretch_sigma": "0.3"}, "stretch_sigma: '0.3' is not positive"),
        (
            {"stretch_sigma": 1e-200},
            "stretch_sigma: 1e-200 is not between 1e-100 and 1e+100",
        ),
        ({"sigma": [[1.0], [1.0, 2.0]]}, "sigma: its entries are not of one shape"),
        (
            {"sigma": 10**400},
            f"sigma: {quote(10**400)} is not a standard deviation; " + SIGMA_FIX,
        ),
        ({"loss": ["huber"]}, "loss: unknown loss ['huber']; known are linear, huber, cauchy"),
        ({"ransac": True}, "ransac: expected a cadalign.RansacOptions, got bool"),
        (
            {"ransac": RansacOptions(), "sigma": np.ones(3)},
            "sigma: shape (3,), expected (8)",
        ),
        (
            {"stretch": "x"},
            "stretch: unknown stretch 'x'; known are yz, y, z, none",
        ),
        (
            {"stretch": np.array(["y", "z"])},
            "stretch: unknown stretch array(['y', 'z'], dtype='<U1'); known are yz, y, z, none",
        ),
        (
            {"stretch": "a" * 300},
            f"stretch: unknown stretch {quote('a' * 300)}; known are yz, y, z, none",
        ),
        (
            {"stretch_sigma": np.timedelta64(2, "s")},
            f"stretch_sigma: {np.timedelta64(2, 's')!r} is not positive",
        ),
        (
            {"method": "best"},
            "method: unknown method 'best'; known are optimal, aepnp, aepnp-paper, epnp",
        ),
        (
            {"method": "aepnp", "loss": "huber"},
            "method: the method 'aepnp' supports neither loss, stretch, scale prior nor an unknown "
            "focal length; "
            "use the method 'optimal', or leave these options at their defaults",
        ),
        (
            {"method": "epnp", "stretch": "none"},
            "method: the method 'epnp' supports neither loss, stretch, scale prior nor an unknown "
            "focal length; "
            "use the method 'optimal', or leave these options at their defaults",
        ),
    ],
)
def test_wrong_options_are_refused(options: dict[str, Any], text: str) -> None:
    error = fit_refusal(GOOD.points_3d, GOOD.points_2d, GOOD.camera, **options)
    assert isinstance(error, InputError)
    assert str(error) == text


def test_noise_of_keypoints_that_always_fit_cannot_be_estimated() -> None:
    error = fit_refusal(GOOD.points_3d[:4], GOOD.points_2d[:4], GOOD.camera, sigma=None)
    assert isinstance(error, DegenerateError)
    assert str(error) == (
        "sigma: 4 keypoints fit exactly, so their noise cannot be estimated; "
        "give sigma, or more keypoints"
    )


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


def test_noise_beyond_all_numbers_is_refused() -> None:
    size = 1e200
    error = fit_refusal(
        GOOD.points_3d, size * GOOD.points_2d, GOOD.camera, sigma=None, stretch_sigma=0.1
    )
    assert isinstance(error, InputError | DegenerateError)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("method", METHODS)
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


@pytest.mark.parametrize(
    ("sigma", "message"),
    [
        (np.ones(7), "sigma: shape (7,), expected (8)"),
        (np.inf, "sigma: inf is not a standard deviation"),
        (np.ones((2, 2, 8)), "sigma: shape (2, 2, 8), expected (8, 2, 2)"),
    ],
)
def test_sigma_of_an_unrefined_robust_search_is_checked(sigma: Any, message: str) -> None:
    problem = simulate_problem(np.random.default_rng(0), points=8, noise_px=1.0)
    ransac = RansacOptions(refine=False)
    with pytest.raises(InputError) as caught:
        fit(problem.points_3d, problem.points_2d, problem.camera, sigma=sigma, ransac=ransac)
    assert str(caught.value).startswith(message)
