"""Camera: projection, lens, COLMAP's form and validation."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cadalign import Camera
from cadalign.errors import InputError
from cadalign.geometry.camera import COLMAP_PARAMS

PLAIN = Camera(width=640, height=480, fx=500.0, fy=520.0, cx=310.5, cy=245.25)
# Strong enough that a missing term shows; all can be inverted in the image.
LENSES = {
    "none": (),
    "radial": (-0.2, 0.05, 0.0, 0.0),
    "tangential": (0.0, 0.0, 0.01, -0.02),
    "opencv4": (-0.28, 0.09, 0.003, -0.002),
    "opencv5": (-0.28, 0.09, 0.003, -0.002, -0.01),
    "rational": (0.3, -0.1, 0.001, 0.002, 0.02, 0.4, -0.05, 0.01),
}


def make_camera(distortion: tuple[float, ...]) -> Camera:
    return Camera(640, 480, 500.0, 520.0, 310.5, 245.25, distortion)


def points_in_view(seed: int, count: int = 40) -> np.ndarray:
    """Camera-frame points whose undistorted projections lie in or near the image."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.5, 20.0, (count, 1))
    return np.hstack([rng.uniform(-0.65, 0.65, (count, 2)) * [1.0, 0.75] * depth, depth])


@pytest.mark.slow
@pytest.mark.parametrize("lens", LENSES)
@given(seed=st.integers(0, 2**32 - 1))
def test_project_agrees_with_opencv(lens: str, seed: int) -> None:
    camera = make_camera(LENSES[lens])
    points = points_in_view(seed)
    coefficients = np.array(camera.distortion) if camera.distortion else None
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, coefficients)
    np.testing.assert_allclose(camera.project(points), expected[:, 0], rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("lens", LENSES)
@given(seed=st.integers(0, 2**32 - 1))
def test_normalize_inverts_project(lens: str, seed: int) -> None:
    camera = make_camera(LENSES[lens])
    points = points_in_view(seed)
    rays = camera.normalize(camera.project(points))
    np.testing.assert_allclose(rays, points[:, :2] / points[:, 2:], rtol=0, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_distortion_jacobian_is_the_derivative_of_the_lens(lens: str) -> None:
    camera = make_camera(LENSES[lens])
    rays = np.random.default_rng(1).uniform(-0.6, 0.6, (30, 2))
    step = 1e-6
    columns = []
    for axis in np.eye(2):
        ahead = camera.pixels_from_normalized(rays + step * axis)
        behind = camera.pixels_from_normalized(rays - step * axis)
        columns.append((ahead - behind) / (2 * step) / [camera.fx, camera.fy])
    expected = np.stack(columns, axis=2)
    np.testing.assert_allclose(camera.distortion_jacobian(rays), expected, rtol=0, atol=1e-8)


def test_x_points_right_and_y_down() -> None:
    right, down = PLAIN.project([[1.0, 0.0, 5.0], [0.0, 1.0, 5.0]])
    assert right.tolist() == [PLAIN.cx + 100.0, PLAIN.cy]
    assert down.tolist() == [PLAIN.cx, PLAIN.cy + 104.0]


@pytest.mark.parametrize(
    ("pixel", "inside"),
    [
        ((-0.5, -0.5), True),
        ((639.5, 479.5), True),
        ((-0.51, 0.0), False),
        ((0.0, -0.51), False),
        ((639.51, 0.0), False),
        ((0.0, 479.51), False),
    ],
)
def test_image_reaches_half_a_pixel_beyond_the_outer_centres(
    pixel: tuple[float, float], inside: bool
) -> None:
    assert PLAIN.contains(np.array([pixel])).tolist() == [inside]


@given(
    width=st.integers(1, 8000),
    height=st.integers(1, 8000),
    fov=st.floats(1.0, 175.0, allow_nan=False),
)
def test_from_fov_sees_exactly_the_field_of_view(width: int, height: int, fov: float) -> None:
    camera = Camera.from_fov(width, height, fov_x=fov)
    edges = camera.normalize([[-0.5, camera.cy], [width - 0.5, camera.cy]])
    angle = np.degrees(np.arctan(edges[1, 0]) - np.arctan(edges[0, 0]))
    assert angle == pytest.approx(fov, abs=1e-8)
    assert camera.fx == camera.fy
    np.testing.assert_allclose(edges[0, 0], -edges[1, 0], rtol=1e-9)
    assert camera.cy == (height - 1) / 2


# --- COLMAP's form ---------------------------------------------------------------------------

PARAMS = {
    "SIMPLE_PINHOLE": [500.0, 320.0, 240.0],
    "PINHOLE": [500.0, 520.0, 320.0, 240.0],
    "SIMPLE_RADIAL": [500.0, 320.0, 240.0, 0.1],
    "RADIAL": [500.0, 320.0, 240.0, 0.1, -0.05],
    "OPENCV": [500.0, 520.0, 320.0, 240.0, 0.1, -0.05, 0.01, -0.02],
    "FULL_OPENCV": [500.0, 520.0, 320.0, 240.0, 0.1, -0.05, 0.01, -0.02, 0.3, 0.4, -0.5, 0.6],
    "OPENCV_FISHEYE": [200.0, 210.0, 320.0, 240.0, 0.1, -0.05, 0.01, -0.02],
}
RADIAL, ALL = (0.1, -0.05, 0, 0), (0.1, -0.05, 0.01, -0.02)
# Focal lengths, coefficients and lens.
EXPECTED: dict[str, tuple[float, float, tuple[float, ...], Any]] = {
    "SIMPLE_PINHOLE": (500, 500, (), "perspective"),
    "PINHOLE": (500, 520, (), "perspective"),
    "SIMPLE_RADIAL": (500, 500, (0.1, 0, 0, 0), "perspective"),
    "RADIAL": (500, 500, RADIAL, "perspective"),
    "OPENCV": (500, 520, ALL, "perspective"),
    "FULL_OPENCV": (500, 520, (*ALL, 0.3, 0.4, -0.5, 0.6), "perspective"),
    "OPENCV_FISHEYE": (200, 210, ALL, "fisheye"),
}
WRITTEN = {
    "SIMPLE_PINHOLE": "PINHOLE",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
}


def test_all_known_colmap_models_are_tested() -> None:
    assert set(PARAMS) == set(COLMAP_PARAMS)


@pytest.mark.parametrize("model", PARAMS)
def test_cameras_are_written_as_the_simplest_colmap_model(
    model: str,
) -> None:
    data = {"model": model, "width": 640, "height": 480, "params": PARAMS[model]}
    camera = Camera.from_dict(data)
    fx, fy, distortion, lens = EXPECTED[model]
    assert camera == Camera(640, 480, fx, fy, 319.5, 239.5, distortion, lens=lens)
    written = camera.to_dict()
    assert written["model"] == WRITTEN.get(model, model)
    assert Camera.from_dict(written) == camera


# --- values ----------------------------------------------------------------------------------


def test_camera_is_a_value() -> None:
    same = Camera(640, 480, 500, 520, 310.5, 245.25, (0, 0, 0, 0))
    assert same == PLAIN
    assert hash(same) == hash(PLAIN)
    with pytest.raises(AttributeError):
        PLAIN.fx = 1.0  # type: ignore[misc]


def test_camera_takes_numpy_numbers_and_keeps_python_ones() -> None:
    camera = Camera(np.int64(640), np.float32(480), np.float32(500), np.int32(500), 1, 2)
    kinds = [type(getattr(camera, name)) for name in ("width", "height", "fx", "fy", "cx", "cy")]
    assert kinds == [int, int, float, float, float, float]


# --- refusals --------------------------------------------------------------------------------

GOOD: dict[str, Any] = {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240}
LENGTH_FIX = "give (k1, k2, p1, p2), optionally followed by k3 or k3, k4, k5, k6"


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            {"fx": 0},
            "camera.fx: the focal length is 0; give the calibrated one in pixels",
        ),
        ({"fx": None}, "camera.fx: None is not a finite number"),
        ({"cx": np.inf}, "camera.cx: inf is not a finite number"),
        ({"fx": True}, "camera.fx: True is not a finite number"),
        ({"width": 0}, "camera.width: 0 is not a size; give the image size in whole pixels"),
        (
            {"width": 640.5},
            "camera.width: 640.5 is not a size; give the image size in whole pixels",
        ),
        (
            {"distortion": (0.1, 0.2)},
            "camera.distortion: (0.1, 0.2) are not distortion coefficients; " + LENGTH_FIX,
        ),
        (
            {"distortion": (0.1, 0, 0, np.nan)},
            "camera.distortion: (0.1, 0.0, 0.0, nan) are not distortion coefficients; "
            + LENGTH_FIX,
        ),
        ({"distortion": 0.1}, "camera.distortion: not a sequence of numbers"),
        ({"distortion": np.full(4, 0.1j)}, "camera.distortion: not a sequence of numbers"),
        (
            {"distortion": np.ma.masked_equal(np.array([0.1, 0.0, 0.0, 0.0]), 0.1)},
            "camera.distortion: not a sequence of numbers",
        ),
    ],
)
def test_camera_refuses_wrong_values(change: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError) as caught:
        Camera(**GOOD | change)
    assert str(caught.value) == text


COLMAP_DATA: dict[str, Any] = {
    "model": "PINHOLE",
    "width": 640,
    "height": 480,
    "params": [500, 500, 320, 240],
}


@pytest.mark.parametrize(
    ("data", "text"),
    [
        ([1, 2], "camera: expected an object, got list"),
        (
            {"model": "PINHOLE", "params": []},
            'camera: missing width, height; give {"model", "width", "height", "params"} '
            "as COLMAP does, or width and height alone if the focal length is unknown",
        ),
        (
            COLMAP_DATA | {"model": "FOV"},
            "camera.model: unknown model 'FOV'; known are SIMPLE_PINHOLE, PINHOLE, "
            "SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV, OPENCV_FISHEYE; for others undistort the "
            "images",
        ),
        (
            COLMAP_DATA | {"params": [500, 320, 240]},
            "camera.params: [500, 320, 240] are not the parameters of PINHOLE; give fx, fy, cx, cy",
        ),
        (
            COLMAP_DATA | {"params": [500, None, 320, 240]},
            "camera.params: fy is None, not a finite number",
        ),
        (
            COLMAP_DATA | {"params": [0, 500, 320, 240]},
            "camera.fx: the focal length is 0; give the calibrated one in pixels",
        ),
        (
            COLMAP_DATA | {"width": "640"},
            "camera.width: '640' is not a size; give the image size in whole pixels",
        ),
    ],
)
def test_from_dict_refuses_malformed_cameras(data: Any, text: str) -> None:
    with pytest.raises(InputError) as caught:
        Camera.from_dict(data)
    assert str(caught.value) == text


def test_points_behind_the_camera_are_refused() -> None:
    with pytest.raises(InputError) as caught:
        PLAIN.project([[0, 0, 1], [0, 0, -2], [0, 0, 0]])
    assert str(caught.value) == (
        "points_cam: 2 of 3 points lie behind the camera, the first is point 1; "
        "only points with z > 0 have a projection"
    )


def test_pixels_beyond_the_lens_are_refused() -> None:
    camera = make_camera((-0.4, 0.0, 0.0, 0.0))
    pixels = [[310.0, 245.0], [5000.0, 245.0]]
    with pytest.raises(InputError) as caught:
        camera.normalize(pixels)
    assert str(caught.value) == (
        "points_2d: the lens distortion cannot be undone at 1 of 2 pixels, the first is point 1; "
        "these lie outside the area in which the lens model is valid; drop them"
    )
    rays, valid = camera.normalize_where_valid(pixels)
    assert valid.tolist() == [True, False]
    assert np.isfinite(rays).all()


@pytest.mark.parametrize(
    ("points", "text"),
    [
        ([[0, 0]], "points_cam: shape (1, 2), expected (n, 3)"),
        ([0, 0, 1], "points_cam: shape (3,), expected (n, 3)"),
        (
            [[0, 0, 1], [np.nan, 0, 1], [0, np.inf, 1]],
            "points_cam: NaN or infinite values in rows 1, 2; remove or repair these",
        ),
    ],
)
def test_project_refuses_wrong_points(points: Any, text: str) -> None:
    with pytest.raises(InputError) as caught:
        PLAIN.project(points)
    assert str(caught.value) == text


# --- without focal length ---------------------------------------------------------------------


def test_camera_without_focal_length_has_its_principal_point_in_the_centre() -> None:
    camera = Camera.from_size(641, 480)
    assert (camera.cx, camera.cy) == (320.0, 239.5)
    assert not camera.focal_known
    assert camera.fx == camera.fy
    given = Camera.from_size(640, 480, cx=300.0, cy=200.0, distortion=(0.1, 0, 0, 0))
    assert (given.cx, given.cy, given.distortion) == (300.0, 200.0, (0.1, 0.0, 0.0, 0.0))


def test_replace_focal_makes_the_focal_length_known() -> None:
    camera = Camera.from_size(640, 480).replace_focal(700)
    assert camera == Camera(640, 480, 700, 700, 319.5, 239.5)
    assert camera != Camera.from_size(640, 480)
    stretched = Camera(640, 480, 500, 550, 320, 240).replace_focal(1000)
    assert (stretched.fx, stretched.fy) == (1000.0, 1100.0)


@pytest.mark.parametrize("use", ["project", "normalize"])
def test_camera_without_focal_length_refuses_projection(use: str) -> None:
    camera = Camera.from_size(640, 480)
    points = [[0.0, 0.0, 2.0]] if use == "project" else [[3.0, 4.0]]
    with pytest.raises(InputError) as caught:
        getattr(camera, use)(points)
    assert str(caught.value) == (
        'camera: the focal length is unknown; estimate it with focal="estimate", '
        "or give it: camera.replace_focal(...)"
    )


NO_FOCAL = COLMAP_DATA | {"params": [None, None, 320.0, 240.0]}


@pytest.mark.parametrize(
    "data",
    [
        {"width": 640, "height": 480},
        COLMAP_DATA | {"model": "SIMPLE_PINHOLE", "params": [None, 320.0, 240.0]},
        NO_FOCAL,
    ],
)
def test_unknown_focal_length_is_null_in_files(data: dict[str, Any]) -> None:
    camera = Camera.from_dict(data)
    assert camera == Camera.from_size(640, 480)
    assert camera.to_dict() == NO_FOCAL
    assert Camera.from_dict(camera.to_dict()) == camera


COEFFICIENTS = (0.1, -0.05, 0.001, 0.002, 0.03, 0.02, -0.01, 0.005, *(0.0,) * 6)


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
@pytest.mark.parametrize("shape", [(-1,), (1, -1), (-1, 1)])
@pytest.mark.parametrize("form", [tuple, list, np.asarray])
def test_coefficients_have_the_shapes_of_opencv(count: int, shape: Any, form: Any) -> None:
    given = np.array(COEFFICIENTS[:count]).reshape(shape)
    camera = make_camera(given if form is np.asarray else form(given.tolist()))
    assert camera.distortion == COEFFICIENTS[: min(count, 8)]
    matrix = camera.matrix.tolist()
    read = Camera.from_dict(
        {"matrix": matrix, "width": 640, "height": 480, "distortion": given.tolist()}
    )
    assert read.distortion == camera.distortion
    point, zero = np.array([[0.2, -0.1, 1.5]]), np.zeros(3)
    expected, _ = cv2.projectPoints(point, zero, zero, camera.matrix, given.ravel())
    np.testing.assert_allclose(camera.project(point), expected[0], atol=1e-9)


@pytest.mark.parametrize(
    ("row", "text"),
    [
        (13, "camera.distortion: thin prisms and a tilted sensor, (0.0, 0.0, 0.0, 0.0, 0.0, 0.01"),
        (8, "camera.distortion: thin prisms and a tilted sensor, (0.01, 0.0, 0.0, 0.0, 0.0, 0.0)"),
    ],
)
def test_unsupported_distortion_terms_are_refused_by_name(row: int, text: str) -> None:
    given = np.array(COEFFICIENTS)
    given[row] = 0.01
    with pytest.raises(InputError) as caught:
        make_camera(tuple(given.tolist()))
    assert str(caught.value).startswith(text)
