"""Fisheye lenses: projection, inverse and derivatives, also beyond 90 degrees."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.files import write_cameras

from cadalign import Camera
from cadalign.datasets.colmap import Colmap
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.pixels import largest_angle
from cadalign.geometry.rotations import rotation_from_vector

LENSES = {
    "equidistant": Camera(640, 640, 180.0, 185.0, 320.25, 318.5, lens="fisheye"),
    "opencv": Camera(
        640, 640, 180.0, 185.0, 320.25, 318.5, (0.05, -0.02, 0.01, -0.001), lens="fisheye"
    ),
}
WIDEST = math.radians(110)  # all lenses above can be inverted up to this angle
every_lens = pytest.mark.parametrize("name", LENSES)
any_seed = given(seed=st.integers(0, 2**32 - 1))


def directions(seed: int, *, widest: float = WIDEST, count: int = 40) -> np.ndarray:
    """Points at random angles and distances; the first lies on the axis."""
    rng = np.random.default_rng(seed)
    theta, phi = rng.uniform(0, widest, count), rng.uniform(0, 2 * np.pi, count)
    theta[0] = 0.0
    rows = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    return np.stack(rows, axis=1) * rng.uniform(0.1, 20, (count, 1))


@every_lens
@any_seed
def test_fisheye_projection_agrees_with_opencv(name: str, seed: int) -> None:
    camera, points = LENSES[name], directions(seed, widest=math.radians(89.5))
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion)
    )
    np.testing.assert_allclose(camera.project(points), expected[:, 0], rtol=0, atol=1e-8)


@every_lens
@any_seed
def test_unproject_inverts_project(name: str, seed: int) -> None:
    camera, points = LENSES[name], directions(seed)
    expected = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(camera.unproject(camera.project(points)), expected, atol=1e-9)


@every_lens
@any_seed
def test_a_turned_frame_changes_no_pixel(name: str, seed: int) -> None:
    camera, points = LENSES[name], directions(seed)
    turn = rotation_from_vector(np.random.default_rng(seed).normal(size=3))
    turned = camera.rotate(turn)
    pixels = camera.project(points)
    np.testing.assert_allclose(turned.project(points @ turn.T), pixels, atol=1e-9)
    np.testing.assert_allclose(turned.unproject(pixels), camera.unproject(pixels) @ turn.T)
    slopes = camera.projection_slopes(points)
    np.testing.assert_allclose(turned.projection_slopes(points @ turn.T) @ turn, slopes, atol=1e-8)


@every_lens
@any_seed
def test_derivatives_agree_with_finite_differences(name: str, seed: int) -> None:
    camera = LENSES[name]
    points = directions(seed)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    steps = 1e-6 * np.eye(3)
    expected = [(camera.project(points + s) - camera.project(points - s)) / 2e-6 for s in steps]
    np.testing.assert_allclose(
        camera.projection_slopes(points), np.stack(expected, axis=2), rtol=1e-6, atol=1e-5
    )


def test_perspective_derivatives_agree_with_finite_differences() -> None:
    camera = Camera(640, 480, 500, 520, 310, 245, (-0.2, 0.05, 0.01, 0.02))
    points = directions(3, widest=0.5)
    steps = 1e-6 * np.eye(3)
    expected = [(camera.project(points + s) - camera.project(points - s)) / 2e-6 for s in steps]
    slopes = camera.projection_slopes(points)
    np.testing.assert_allclose(slopes, np.stack(expected, axis=2), rtol=1e-5, atol=1e-4)


def test_beyond_the_fold_nothing_is_seen() -> None:
    camera = Camera(640, 640, 180, 180, 320, 320, (-0.1, 0, 0, 0), lens="fisheye")
    limit = largest_angle(camera.distortion)
    assert limit == pytest.approx(math.sqrt(1 / 0.3))
    angles = np.array([limit - 0.01, limit + 0.01])
    points = np.stack([np.sin(angles), np.zeros(2), np.cos(angles)], axis=1)
    assert camera.sees(points).tolist() == [True, False]
    with pytest.raises(InputError) as caught:
        camera.project(points)
    assert str(caught.value) == (
        "points_cam: 1 of 2 points lie outside the lens's field of view, the first is point 1; "
        "only points less than 104.6 degrees off the axis have a projection"
    )
    assert np.isinf(camera.project_where_ahead(points)[1]).all()
    rays, valid = camera.rays_where_valid([[320.0, 320.0], [3200.0, 320.0]])
    assert valid.tolist() == [True, False]
    assert np.isfinite(rays).all()


def test_normalize_refuses_rays_beside_the_camera() -> None:
    camera = LENSES["equidistant"]
    pixels = camera.project([[0, 0, 1], [1, 0, -0.1], [0, 1, -0.2]])
    with pytest.raises(InputError) as caught:
        camera.normalize(pixels)
    assert str(caught.value) == (
        "points_2d: the rays of 2 of 3 pixels are 90 degrees or more off the z axis, the first is "
        "point 1; these have no normalised coordinates; use unproject"
    )


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"lens": "wide"}, "camera.lens: 'wide' is not a kind of lens; known are perspective,"),
        (
            {"lens": "fisheye", "distortion": (0.1,)},
            r"camera.distortion: \(0.1,\) are not distortion coefficients; give \(k1, k2, k3, k4\)",
        ),
        (
            {"lens": "fisheye", "focal_known": False},
            "camera.lens: the focal length of a fisheye lens is unknown; calibrate the camera",
        ),
    ],
)
def test_impossible_lenses_are_refused(given: dict[str, object], text: str) -> None:
    with pytest.raises(InputError, match=text):
        Camera(640, 480, 500, 500, 320, 240, **given)  # type: ignore[arg-type]


def test_files_of_wide_lenses_need_a_focal_length() -> None:
    data = {
        "model": "OPENCV_FISHEYE",
        "width": 9,
        "height": 9,
        "params": [None, None, 4, 4, *[0] * 4],
    }
    with pytest.raises(InputError, match=r"camera.params: the focal length of a fisheye lens"):
        Camera.from_dict(data)


def test_a_turned_frame_is_not_written() -> None:
    with pytest.raises(InputError, match="a camera with a turned frame cannot be written"):
        LENSES["opencv"].rotate(np.eye(3)).to_dict()


def test_a_pinhole_is_not_turned() -> None:
    with pytest.raises(InputError, match="a perspective camera cannot be turned"):
        Camera(640, 480, 500, 500, 320, 240).rotate(np.eye(3))


@every_lens
def test_colmap_keeps_wide_lenses(name: str, tmp_path) -> None:
    pose = Alignment(np.eye(3), [0.0, 0.0, 3.0], np.ones(3))
    write_cameras(tmp_path, {"a.png": (LENSES[name], pose)})
    assert Colmap(tmp_path)["a.png"].camera == LENSES[name]
