"""Camera files of other programs: round trips, their own conventions, and what is refused."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cadalign import Alignment, Camera
from cadalign.datasets.sfm.colmap import write_colmap
from cadalign.datasets.sfm.correspondences import CameraView
from cadalign.errors import DataError, InputError
from cadalign.export.camera_files import read_camera_views, write_nerf, write_open3d
from cadalign.geometry.conventions import (
    alignment_from_opengl,
    opengl_from_model,
    opengl_projection,
)
from cadalign.render import look_at

PLAIN = Camera(width=641, height=480, fx=510.25, fy=498.5, cx=321.75, cy=236.125)
BENT = replace(PLAIN, distortion=(-0.2, 0.05, 0.003, -0.001))
WRITERS = {"open3d": write_open3d, "nerf": write_nerf, "colmap": write_colmap}


def _view(camera, name, azimuth):
    pose = look_at(azimuth=azimuth, elevation=17, distance=3.3, roll=11, target=(0.1, 0.2, 0.3))
    return CameraView(camera, pose, name)


def _pixels(view):
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    return view.camera.project(view.cam_from_world.apply(points))


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("count", [1, 3])
def test_what_is_written_is_read_again(tmp_path, kind, count):
    cameras = [PLAIN if kind == "open3d" else BENT, replace(PLAIN, width=800, fx=600), PLAIN]
    views = [_view(camera, f"{n}.jpg", 100 * n) for n, camera in enumerate(cameras[:count])]
    path = tmp_path / ("a/new/model" if kind == "colmap" else "cameras.json")
    WRITERS[kind](path, views)
    again = read_camera_views(path)
    assert len(again) == count
    for before, after in zip(views, again, strict=True):
        np.testing.assert_allclose(_pixels(after), _pixels(before), atol=1e-9)
        assert (after.camera.width, after.camera.height) == (
            before.camera.width,
            before.camera.height,
        )
        assert after.name == ("" if kind == "open3d" else before.name)


def test_open3d_file_as_the_viewer_writes_it(tmp_path):
    # 1920 x 1080, the camera 2 before the origin and 0.5 above it; columns follow one another.
    path = tmp_path / "ScreenCamera.json"
    path.write_text(
        json.dumps(
            {
                "class_name": "PinholeCameraParameters",
                "extrinsic": [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0, 0.0, 0.5, 2.0, 1.0],
                "intrinsic": {
                    "height": 1080,
                    "intrinsic_matrix": [935.3, 0, 0, 0, 935.3, 0, 959.5, 539.5, 1],
                    "width": 1920,
                },
                "version_major": 1,
                "version_minor": 0,
            }
        )
    )
    (view,) = read_camera_views(path)
    assert (view.camera.cx, view.camera.cy) == (959.5, 539.5)
    np.testing.assert_allclose(
        view.camera.project(view.cam_from_world.apply([[0, 0, 0], [0, 1, 0]])),
        [[959.5, 539.5 + 935.3 / 4], [959.5, 539.5 - 935.3 / 4]],
    )


def test_open3d_reads_what_is_written(tmp_path):
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    view = _view(PLAIN, "", 30)
    write_open3d(tmp_path / "view.json", [view])
    read = open3d.io.read_pinhole_camera_parameters(str(tmp_path / "view.json"))
    np.testing.assert_allclose(read.extrinsic, view.cam_from_world.cam_from_model)
    np.testing.assert_allclose(read.intrinsic.intrinsic_matrix, PLAIN.matrix)
    open3d.io.write_pinhole_camera_parameters(str(tmp_path / "again.json"), read)
    (again,) = read_camera_views(tmp_path / "again.json")
    np.testing.assert_allclose(_pixels(again), _pixels(view), atol=1e-6)


def test_nerf_file_with_a_field_of_view_only(tmp_path):
    # A camera at (0, 0, 4) that looks down -z: OpenGL's axes are the world's own.
    matrix = np.eye(4)
    matrix[2, 3] = 4
    frame = {"file_path": "./train/r_0", "transform_matrix": matrix.tolist()}
    path = tmp_path / "transforms.json"
    path.write_text(
        json.dumps({"camera_angle_x": np.pi / 2, "w": 800, "h": 600, "frames": [frame]})
    )
    (view,) = read_camera_views(path)
    assert view.name == "./train/r_0"
    assert view.camera.fx == pytest.approx(400)
    assert (view.camera.cx, view.camera.cy) == (399.5, 299.5)
    up, right = view.camera.project(view.cam_from_world.apply([[0, 1, 0], [1, 0, 0]]))
    np.testing.assert_allclose(up, [399.5, 199.5])
    np.testing.assert_allclose(right, [499.5, 299.5])
    angles = {"camera_angle_x": np.pi / 2, "camera_angle_y": np.pi / 3}
    path.write_text(json.dumps({**angles, "w": 800, "h": 600, "frames": [frame]}))
    (view,) = read_camera_views(path)
    assert view.camera.fy == pytest.approx(300 * np.sqrt(3))


def test_nerf_keeps_what_all_cameras_share_at_the_top(tmp_path):
    views = [_view(PLAIN, "a", 0), _view(replace(PLAIN, fx=700), "b", 40)]
    write_nerf(tmp_path / "t.json", views)
    data = json.loads((tmp_path / "t.json").read_text())
    assert data["cx"] == PLAIN.cx + 0.5
    assert "fl_x" not in data
    assert [frame["fl_x"] for frame in data["frames"]] == [PLAIN.fx, 700]


def test_colmap_writes_equal_cameras_once(tmp_path):
    write_colmap(tmp_path, [_view(PLAIN, "a.jpg", 0), _view(PLAIN, "b.jpg", 40)])
    assert (tmp_path / "cameras.txt").read_text().split()[:2] == ["1", "PINHOLE"]
    assert len((tmp_path / "cameras.txt").read_text().splitlines()) == 1


def test_names_that_other_programs_would_cut_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"views\[1\]: .* end the name 'b c.jpg' at"):
        write_colmap(tmp_path, [_view(PLAIN, "a.jpg", 0), _view(PLAIN, "b c.jpg", 40)])


def test_real_colmap_model_is_read(tmp_path):
    data = os.environ.get("CADALIGN_DATA")
    if not data:
        pytest.skip("set CADALIGN_DATA to the real data")
    views = read_camera_views(Path(data) / "sfm" / "maupertuis_colmap")
    assert len(views) == 4
    write_nerf(tmp_path / "t.json", views)
    again = read_camera_views(tmp_path / "t.json")
    for before, after in zip(views, again, strict=True):
        np.testing.assert_allclose(
            after.cam_from_world.cam_from_model, before.cam_from_world.cam_from_model, atol=1e-9
        )
        assert after.camera == before.camera


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not valid JSON"),
        ("[]", "not a camera file that is known"),
        ("{}", "not a camera file that is known"),
        ('{"class_name": "PinholeCameraParameters"}', "intrinsic: missing"),
        (
            '{"class_name": "PinholeCameraTrajectory", "parameters": []}',
            r"parameters: \[\] is not a list",
        ),
        (
            '{"extrinsic": [1], "intrinsic": {"intrinsic_matrix": [1]}}',
            "intrinsic_matrix: is not 3",
        ),
        ('{"frames": [3]}', r"frames\[0\]: 3 is not an object"),
        ('{"frames": [{}]}', r"transform_matrix: missing"),
    ],
)
def test_malformed_files_are_refused_by_name(tmp_path, text, message):
    path = tmp_path / "cameras.json"
    path.write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        read_camera_views(path)
    assert "cameras.json" in str(caught.value)


def _nerf(tmp_path, matrix=None, **fields):
    frame = {"transform_matrix": (np.eye(4) if matrix is None else matrix).tolist()}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"w": 8, "h": 8, "fl_x": 5, "frames": [frame], **fields}))
    return path


@pytest.mark.parametrize(
    ("matrix", "fields", "message"),
    [
        (np.zeros((4, 4)), {}, "has no inverse"),
        (np.diag([2.0, 2, 2, 1]), {}, "not a rotation|orthonormal"),
        (None, {"fl_x": None}, "neither fl_x nor camera_angle_x"),
        (None, {"fl_x": "wide"}, "'wide' is not a finite number"),
        (None, {"w": None}, "w and h"),
        (None, {"w": 0}, "is not a size"),
        (None, {"k4": 0.1}, "k4 is not a coefficient of the model OPENCV"),
        (None, {"p1": 0.1, "is_fisheye": True}, "p1 is not a coefficient of the model OPENCV_FISH"),
        (None, {"camera_model": "EQUIRECTANGULAR"}, "'EQUIRECTANGULAR' is not a camera model"),
        (
            None,
            {"camera_model": "OPENCV_FISHEYE", "fl_x": None, "camera_angle_x": 1},
            "fl_x, a fisheye's focal length",
        ),
    ],
)
def test_impossible_nerf_cameras_are_refused(tmp_path, matrix, fields, message):
    with pytest.raises(DataError, match=message):
        read_camera_views(_nerf(tmp_path, matrix, **fields))


def test_missing_files_and_what_cannot_be_written(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read_camera_views(tmp_path / "nothing.json")
    view = _view(PLAIN, "a", 0)
    with pytest.raises(DataError, match="cannot be written"):
        write_open3d(tmp_path / "no" / "folder.json", [view])
    with pytest.raises(InputError, match="give at least one view"):
        write_nerf(tmp_path / "t.json", [])
    with pytest.raises(InputError, match="no place for lens distortion"):
        write_open3d(tmp_path / "t.json", [_view(BENT, "a", 0)])
    with pytest.raises(InputError, match="of its own"):
        write_colmap(tmp_path, [view, view])
    stretched = CameraView(PLAIN, Alignment(np.eye(3), [0, 0, 3], [1, 2, 1]), "a")
    for write in WRITERS.values():
        with pytest.raises(InputError, match=r"views\[0\]: the pose has the scale"):
            write(tmp_path / "t", [stretched])


def test_opengl_matrices_project_as_the_camera_does():
    pose = look_at(azimuth=50, elevation=-20, distance=3, scale=(1, 0.5, 2))
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 3))
    homogeneous = np.column_stack([points, np.ones(50)])
    for window in (None, (100, 50, 320, 200)):
        projection = opengl_projection(PLAIN, near=0.5, far=9, window=window)
        clip = homogeneous @ (projection @ opengl_from_model(pose)).T
        device = clip[:, :3] / clip[:, 3:]
        assert (np.abs(device[:, 2]) < 1).all()
        ends = projection @ np.array([[0, 0, -0.5, 1], [0, 0, -9, 1]]).T
        np.testing.assert_allclose(ends[2] / ends[3], [-1, 1], atol=1e-12)
        left, top, width, height = window or (0, 0, PLAIN.width, PLAIN.height)
        # In the window's pixels from its borders, y up.
        x = left + (device[:, 0] + 1) / 2 * width - 0.5
        y = top + (1 - device[:, 1]) / 2 * height - 0.5
        expected = PLAIN.project(pose.apply(points))
        np.testing.assert_allclose(np.column_stack([x, y]), expected, atol=1e-9)


def test_opengl_poses_go_both_ways():
    pose = look_at(azimuth=50, elevation=-20, distance=3)
    again = alignment_from_opengl(opengl_from_model(pose))
    np.testing.assert_allclose(again.cam_from_model, pose.cam_from_model, atol=1e-12)
    with pytest.raises(InputError, match="last row"):
        alignment_from_opengl(np.ones((4, 4)))
