"""Sampled views: camera position, framing and visible keypoints."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from cadalign import Box, Camera, Mesh
from cadalign.errors import InputError, RenderError
from cadalign.render import Scene, cast_geometry, frame_object, look_at, sample_view

CAMERA = Camera.from_fov(320, 240, fov_x=50)
CAMERAS = [
    CAMERA,
    Camera(200, 300, 260.0, 300.0, 80.0, 170.0),
    Camera(320, 240, 300.0, 310.0, 165.0, 115.0, (-0.2, 0.05, 0.002, -0.001)),
]


@pytest.fixture(scope="module")
def scene():
    shape = trimesh.creation.box(extents=(0.4, 1.0, 0.6))
    shape.apply_translation([0.2, 0.1, -0.15])
    return Scene(Mesh(np.array(shape.vertices), np.array(shape.faces), source="crate"))


@pytest.fixture(scope="module")
def corners(scene):
    return np.array(scene.mesh.vertices)


@pytest.mark.parametrize(
    ("azimuth", "elevation", "expected"),
    [
        (0, 0, [0, 0, 5]),
        (90, 0, [5, 0, 0]),
        (180, 0, [0, 0, -5]),
        (0, 90, [0, 5, 0]),
        (0, 30, [0, 2.5, 5 * np.cos(np.pi / 6)]),
    ],
)
def test_camera_stands_at_azimuth_elevation_and_distance(azimuth, elevation, expected):
    pose = look_at(azimuth=azimuth, elevation=elevation, distance=5)
    np.testing.assert_allclose(pose.inverse([[0, 0, 0]])[0], expected, atol=1e-12)
    np.testing.assert_allclose(pose.apply([[0, 0, 0]])[0], [0, 0, 5], atol=1e-12)


def test_y_is_up_and_roll_turns_the_object_counterclockwise():
    up = np.array([[0.0, 1.0, 0.0]])
    for azimuth in (-170, -30, 0, 60, 100):
        pose = look_at(azimuth=azimuth, elevation=40, distance=3)
        x, y, _ = (pose.apply(up) - pose.apply([[0, 0, 0]]))[0]
        assert abs(x) < 1e-12
        assert y < 0
    x, y, _ = (look_at(azimuth=0, elevation=0, distance=3, roll=90).apply(up))[0]
    np.testing.assert_allclose([x, y], [-1, 0], atol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("scale", [(1, 1, 1), (1, 2, 0.5), (1, 0.5, 2)])
def test_object_lies_inside_the_image_and_fills_its_share(scene, corners, camera, scale):
    rng = np.random.default_rng(3)
    for _ in range(10):
        view = sample_view(scene, corners, camera, rng=rng, fill=(0.5, 0.8), scale=scale, roll=10.0)
        box = Box.from_model(scene.bounds, view.cam_from_model)
        pixels = camera.project(box.corners)
        middle = np.array([camera.width - 1, camera.height - 1]) / 2
        reach = (2 * np.abs(pixels - middle) / (camera.width, camera.height)).max()
        assert 0.499 < reach < 0.801
        np.testing.assert_allclose(view.cam_from_model.scale, scale)
        mask = cast_geometry(scene, camera, view.cam_from_model).mask
        assert mask.any()
        assert mask[1:-1, 1:-1].sum() == mask.sum()


@pytest.mark.parametrize("size", [1e-3, 1e3])
def test_distance_scales_with_the_model(scene, size):
    rotation = look_at(azimuth=30, elevation=20, distance=1).rotation
    one = frame_object(scene.bounds, CAMERA, rotation=rotation, fill=0.7)
    other = frame_object(scene.bounds * size, CAMERA, rotation=rotation, fill=0.7)
    np.testing.assert_allclose(other.translation, one.translation * size, rtol=1e-9)


@pytest.mark.long
def test_views_are_spread_evenly_within_the_band(scene, corners):
    rng = np.random.default_rng(0)
    directions = []
    for _ in range(400):
        pose = sample_view(
            scene, corners, CAMERA, rng=rng, min_visible=0, elevation=(10.0, 50.0)
        ).cam_from_model
        directions.append(-pose.rotation[2])
    height = np.array(directions)[:, 1]
    low, high = np.sin(np.radians([10, 50]))
    assert low - 1e-9 <= height.min() < low + 0.03
    assert high - 0.03 < height.max() <= high + 1e-9
    # A uniform distribution on the sphere is uniform in height.
    assert height.mean() == pytest.approx((low + high) / 2, abs=0.03)
    azimuth = np.arctan2(*np.array(directions)[:, [0, 2]].T)
    assert np.histogram(azimuth, bins=4, range=(-np.pi, np.pi))[0].min() > 70


def test_enough_keypoints_are_seen_and_the_seed_decides(scene, corners):
    views = [
        sample_view(scene, corners, CAMERA, rng=np.random.default_rng(seed), min_visible=7)
        for seed in (1, 1, 2)
    ]
    assert all(view.visible.sum() >= 7 for view in views)
    assert views[0].cam_from_model == views[1].cam_from_model
    assert views[0].cam_from_model != views[2].cam_from_model


def test_too_few_visible_keypoints_are_reported(scene, corners):
    rng = np.random.default_rng(0)
    message = r"crate: 8 of 8 keypoints should be visible, but the best of 100 views shows 7;"
    with pytest.raises(RenderError, match=message):
        sample_view(scene, corners, CAMERA, rng=rng, min_visible=8)
    with pytest.raises(RenderError, match="6 of 3 keypoints should be visible, but there are no"):
        sample_view(scene, corners[:3], CAMERA, rng=rng, min_visible=6)


def test_flat_and_point_like_models_can_be_framed():
    rotation = look_at(azimuth=30, elevation=20, distance=1).rotation
    flat = frame_object([[-1, -1, 0], [1, 1, 0]], CAMERA, rotation=rotation, fill=0.7)
    assert flat.translation[2] > 0
    with pytest.raises(RenderError, match="cannot be made to fill"):
        frame_object([[1, 1, 1], [1, 1, 1]], CAMERA, rotation=rotation, fill=0.7)


@pytest.mark.parametrize(
    ("function", "wrong"),
    [
        *((look_at, {name: bad}) for name, bad in (("elevation", 91), ("distance", 0))),
        *((look_at, {name: bad}) for name, bad in (("azimuth", np.nan), ("scale", (1, 0, 1)))),
        *((sample_view, {"elevation": bad}) for bad in ((50.0, 10.0), (0.0, 95.0))),
        (sample_view, {"fill": (0.0, 0.5)}),
    ],
)
def test_bad_values_are_refused(scene, corners, function, wrong):
    (where,) = wrong
    given, usual = (), {"azimuth": 0, "elevation": 0, "distance": 3}
    if function is sample_view:
        given, usual = (scene, corners, CAMERA), {"rng": np.random.default_rng(0)}
    with pytest.raises(InputError, match="look_at" if where == "azimuth" else where):
        function(*given, **usual | wrong)
