"""Keypoint visibility: cubes and plates with known results, models against depth images."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from cadalign import Alignment, Camera, Mesh
from cadalign.errors import InputError
from cadalign.render import Scene, cast_geometry, look_at, sample_view, visible_keypoints
from cadalign.render.posed_scene import within_lens_field

CAMERA = Camera.from_fov(320, 240, fov_x=50)
SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
AXES = np.concatenate([np.eye(3), -np.eye(3)])


@pytest.fixture(scope="module")
def cube():
    shape = trimesh.creation.box(extents=(2, 2, 2))
    return Scene(Mesh(np.array(shape.vertices), np.array(shape.faces)))


@pytest.mark.parametrize("azimuth", [-140, -20, 5, 50, 130])
@pytest.mark.parametrize("elevation", [-35, -4, 4, 35])
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_cube_corners_and_face_centres(azimuth, elevation, size):
    shape = trimesh.creation.box(extents=(2 * size,) * 3)
    scene = Scene(Mesh(np.array(shape.vertices), np.array(shape.faces)))
    view = look_at(azimuth=azimuth, elevation=elevation, distance=8 * size)
    camera_at = view.inverse([[0, 0, 0]])[0]
    facing = AXES @ camera_at > size
    # A corner is visible if one of its three faces is.
    shows = {tuple(axis): face for axis, face in zip(AXES, facing, strict=True)}
    corners = [any(shows[tuple(sign[k] * np.eye(3)[k])] for k in range(3)) for sign in SIGNS]
    seen = visible_keypoints(scene, np.concatenate([AXES, SIGNS]) * size, CAMERA, view)
    assert seen.tolist() == facing.tolist() + corners


def test_stretch_of_the_pose_counts(cube):
    # The flattened cube does not hide a point that the cube hides.
    points = [[0.0, 0.9, -1.5]]
    for height, seen in ((1.0, False), (0.1, True)):
        view = look_at(azimuth=0, elevation=15, distance=9, scale=(1, height, 1))
        assert visible_keypoints(cube, points, CAMERA, view).tolist() == [seen]


def test_plate_hides_what_is_behind_it():
    plate = Scene(Mesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]]))
    points = [[0.3, 0.2, -0.5], [0.3, 0.2, 0.5], [1.5, 0, -0.5], [0.3, 0.2, 0.0], [0, 0, -0.05]]
    view = look_at(azimuth=0, elevation=0, distance=6)
    assert visible_keypoints(plate, points, CAMERA, view).tolist() == [
        False, True, True, True, False,
    ]  # fmt: skip


def test_keypoints_slightly_beneath_the_surface_are_seen(cube):
    view = look_at(azimuth=20, elevation=25, distance=8)
    for depth in (0.0, 1e-6, 1e-4):
        assert visible_keypoints(cube, [[0.2, 0.3, 1 - depth]], CAMERA, view)[0]
    assert not visible_keypoints(cube, [[0.2, 0.3, 0.9]], CAMERA, view)[0]


def test_points_outside_the_image_or_behind_the_camera_are_not_seen(cube):
    pose = Alignment(np.eye(3), [0, 0, 6], [1, 1, 1])
    points = [[0, 0, -1], [5, 0, -1], [0, 4, -1], [0, 0, -6], [0, 0, -12]]
    assert visible_keypoints(cube, points, CAMERA, pose).tolist() == [True] + [False] * 4


def test_a_lens_does_not_fold_far_off_points_into_the_image(cube):
    # This lens maps slopes above 1.05 back towards the centre.
    camera = Camera(320, 240, 200, 200, 159.5, 119.5, (-0.3, 0, 0, 0))
    slopes = np.array([[0.3, 0.0], [1.0, 0.0], [1.6, 0.0], [-1.2, 1.2]])
    assert camera.contains(camera.pixels_from_normalized(slopes)).all()
    rays = np.column_stack([slopes, np.ones(4)])
    assert within_lens_field(camera, rays).tolist() == [True, True, False, False]
    points = rays * 6 - np.array([0, 0, 40])
    pose = Alignment(np.eye(3), [0, 0, 40], [1, 1, 1])
    assert visible_keypoints(cube, points, camera, pose).tolist() == [True, True, False, False]


def _agrees_with_depth_image(scene, points, camera, pose, visible):
    """Compare with the depths of the 3 x 3 pixels about each keypoint; (k,) bool.

    At a silhouette these hold both sides, so either answer is right there.
    """
    depth = cast_geometry(scene, camera, pose).depth
    depth = np.pad(np.where(depth > 0, depth, np.inf), 1, constant_values=np.inf)
    in_camera = pose.apply(points)
    columns, rows = np.rint(camera.project(in_camera)).astype(int).T
    around = np.stack(
        [depth[rows + dy, columns + dx] for dy in range(3) for dx in range(3)], axis=1
    )
    slack = 0.006 * scene.diagonal
    before = in_camera[:, 2:] <= around + slack
    return np.where(visible, before.any(axis=1), ~before.all(axis=1))


def _pile_of_boxes(rng):
    parts = []
    for _ in range(12):
        part = trimesh.creation.box(extents=rng.uniform(0.1, 0.6, 3))
        part.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
        part.apply_translation(rng.uniform(-0.5, 0.5, 3))
        parts.append(part)
    whole = trimesh.util.concatenate(parts)
    return Mesh(np.array(whole.vertices), np.array(whole.faces))


@pytest.mark.slow
def test_agrees_with_depth_images_of_piled_boxes():
    rng = np.random.default_rng(5)
    agree = []
    seen = []
    for _ in range(12):
        mesh = _pile_of_boxes(rng)
        scene = Scene(mesh)
        faces = rng.integers(0, len(mesh.faces), 20)
        points = mesh.surface_points(faces, rng.dirichlet([2, 2, 2], 20))
        view = sample_view(scene, points, CAMERA, rng=rng, min_visible=1)
        agree.append(
            _agrees_with_depth_image(scene, points, CAMERA, view.cam_from_model, view.visible)
        )
        seen.append(view.visible)
    assert np.mean(agree) > 0.99
    assert 0.15 < np.mean(seen) < 0.7


@pytest.mark.parametrize("points", [[[0, 0]], [[np.nan, 0, 0]]])
def test_bad_points_are_refused(cube, points):
    view = look_at(azimuth=0, elevation=0, distance=6)
    with pytest.raises(InputError, match="points_3d"):
        visible_keypoints(cube, points, CAMERA, view)
