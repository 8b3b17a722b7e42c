"""Feature lines, keypoint pictures, named views and contact sheets."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from cadalign import Camera, Mesh
from cadalign.errors import InputError
from cadalign.render import Angles, Scene, cast_geometry, look_at, pose_in_view
from cadalign.render.layers import contact_sheet, feature_lines, keypoint_picture

CAMERA = Camera.from_fov(160, 120, fov_x=50)


def _box() -> Scene:
    box = trimesh.creation.box()
    return Scene(Mesh(np.array(box.vertices), np.array(box.faces)))


@pytest.fixture(scope="module")
def geometry():
    return cast_geometry(_box(), CAMERA, look_at(azimuth=35, elevation=25, distance=3))


def test_lines_follow_outline_and_edges_but_not_diagonals(geometry):
    lines = feature_lines(geometry)
    rounded = geometry.normal.round(3).reshape(-1, 3)
    side = np.unique(rounded, axis=0, return_inverse=True)[1].reshape(120, 160)
    assert lines.sum() > 150
    assert lines.mean() < 0.1
    # There are no lines away from the outline and the creases.
    border = np.zeros_like(lines)
    for shift in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        rolled = np.roll(side, shift, (0, 1)), np.roll(geometry.mask, shift, (0, 1))
        border |= (rolled[0] != side) | (rolled[1] != geometry.mask)
    assert not lines[~border].any()


def test_a_step_in_depth_is_a_line_and_a_grazing_floor_has_none():
    front = [[-0.5, -0.5, 1], [0.5, -0.5, 1], [0.5, 0.5, 1], [-0.5, 0.5, 1]]
    back = [[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]]
    faces = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    steps = cast_geometry(
        Scene(Mesh(np.array(front + back, float), faces)),
        CAMERA,
        look_at(azimuth=0, elevation=0, distance=5),
    )
    assert feature_lines(steps)[60, 40:120].sum() == 2
    floor = Scene(Mesh([[-9, 0, -9], [9, 0, -9], [9, 0, 9], [-9, 0, 9]], [[0, 1, 2], [0, 2, 3]]))
    flat = cast_geometry(floor, CAMERA, look_at(azimuth=0, elevation=4, distance=5))
    inner = flat.mask[1:-1, 1:-1] & flat.mask[:-2, 1:-1] & flat.mask[2:, 1:-1]
    assert inner.sum() > 4000
    assert not feature_lines(flat)[1:-1, 1:-1][inner].any()


def test_keypoints_are_ringed_where_they_are(geometry):
    image = np.full((120, 160, 3), 128, np.uint8)
    pose = look_at(azimuth=0, elevation=0, distance=3)
    points = np.array([[0.5, 0.5, 0.5], [-0.5, 0.5, 0.5], [0, 0, 50]])
    drawn = keypoint_picture(image, CAMERA, points, pose, np.array([True, False, True]))
    changed = (drawn != image).any(axis=2)
    places = CAMERA.project(pose.apply(points[:2]))
    rows, columns = np.nonzero(changed)
    below = columns[rows > places[0, 1] + 1]  # the numbers are above
    assert below.mean() == pytest.approx(places[:, 0].mean(), abs=0.6)
    assert np.ptp(below) > np.ptp(places[:, 0])
    seen = drawn[:, 80:].reshape(-1, 3).astype(int)
    hidden = drawn[:, :80].reshape(-1, 3).astype(int)
    assert (seen[:, 0] - seen[:, 2]).max() > 100
    assert (hidden[:, 0] - hidden[:, 2]).max() < 10


def test_unknown_views_are_refused():
    for text in ("sideways", "1", "1,2,3,4", "nan,0", ""):
        with pytest.raises(InputError, match="is not a view"):
            Angles.parse(text)
    with pytest.raises(InputError, match="elevation"):
        pose_in_view(_box(), CAMERA, Angles.parse("0,95"))


@pytest.mark.parametrize(
    ("name", "axis", "sign"), [("right", 0, 1), ("top", 1, 1), ("front", 2, -1)]
)
def test_named_views_look_from_their_side(name, axis, sign):
    pose = pose_in_view(_box(), CAMERA, Angles.parse(name))
    eye = pose.inverse([[0, 0, 0]])[0]
    assert np.argmax(np.abs(eye)) == axis
    assert np.sign(eye[axis]) == sign


def test_a_contact_sheet_contains_every_picture():
    values = {"a": 10, "b": 90, "c": 170}
    images = {name: np.full((30, 40, 3), value, np.uint8) for name, value in values.items()}
    sheet = contact_sheet(images)
    for value in values.values():
        assert (sheet == value).all(axis=2).sum() == 1200
