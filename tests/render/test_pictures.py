"""Plain pictures and sheets: they show what they say."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import trimesh

from cadalign import Alignment, Camera, Mesh
from cadalign.errors import InputError
from cadalign.render import (
    Angles,
    Scene,
    cast_geometry,
    contact_sheet,
    depth_picture,
    draw_still,
    face_picture,
    feature_lines,
    keypoint_picture,
    line_picture,
    look_at,
    make_renderer,
    normal_picture,
    pose_in_view,
)

CAMERA = Camera.from_fov(160, 120, fov_x=50)


def _box() -> Scene:
    box = trimesh.creation.box()
    return Scene(Mesh(np.array(box.vertices), np.array(box.faces)))


@pytest.fixture(scope="module")
def geometry():
    return cast_geometry(_box(), CAMERA, look_at(azimuth=35, elevation=25, distance=3))


def test_depth_picture_is_yellow_where_near_and_violet_where_far(geometry):
    picture = depth_picture(geometry)
    near = np.unravel_index(np.where(geometry.mask, geometry.depth, 9).argmin(), (120, 160))
    far = np.unravel_index(geometry.depth.argmax(), (120, 160))
    assert picture[near][:2].min() > 200
    assert picture[near][2] < 60
    assert picture[far][2] > picture[far][1]
    np.testing.assert_array_equal(picture[:, :, 3] == 255, geometry.mask)


def test_depth_of_a_flat_or_an_empty_frame_is_drawn():
    square = Scene(Mesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0]], [[0, 1, 2]]))
    for z in (4, -4):
        pose = Alignment(np.eye(3), [0, 0, z], [1, 1, 1])
        picture = depth_picture(cast_geometry(square, CAMERA, pose))
        assert picture[:, :, 3].any() == (z > 0)


def test_normal_picture_is_green_upwards_and_red_to_the_right(geometry):
    picture = normal_picture(geometry)
    top = geometry.normal[:, :, 1] < -0.8
    assert (picture[top][:, 1] > 230).all()
    right = geometry.normal[:, :, 0] > 0.7
    assert (picture[right][:, 0] > 210).all()
    assert (picture[geometry.mask][:, 2] >= 127).all()


def test_face_picture_has_a_colour_for_each_triangle(geometry):
    picture = face_picture(geometry)
    faces = np.unique(geometry.face_id[geometry.mask])
    colors = {tuple(picture[geometry.face_id == face][0]) for face in faces}
    assert len(colors) == len(faces)
    for face in faces:
        assert (np.ptp(picture[geometry.face_id == face], axis=0) == 0).all()


def test_lines_follow_outline_and_edges_but_not_diagonals(geometry):
    lines = feature_lines(geometry)
    rounded = geometry.normal.round(3).reshape(-1, 3)
    side = np.unique(rounded, axis=0, return_inverse=True)[1].reshape(120, 160)
    assert lines.sum() > 150
    assert lines.mean() < 0.1
    # Away from the outline and from where two sides meet there are none.
    border = np.zeros_like(lines)
    for shift in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        rolled = np.roll(side, shift, (0, 1)), np.roll(geometry.mask, shift, (0, 1))
        border |= (rolled[0] != side) | (rolled[1] != geometry.mask)
    assert not lines[~border].any()
    assert (line_picture(geometry)[:, :, 3] > 0).sum() == lines.sum()


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
    points = [[0.5, 0.5, 0.5], [-0.5, 0.5, 0.5], [0, 0, 50]]
    drawn = keypoint_picture(
        image, CAMERA, points, pose, visible=[True, False, True], numbers=False
    )
    changed = (drawn != image).any(axis=2)
    middle = CAMERA.project(pose.apply(points[:2])).mean(axis=0)
    rows, columns = np.nonzero(changed)
    np.testing.assert_allclose([columns.mean(), rows.mean()], middle, atol=0.6)
    seen = drawn[:, 80:].reshape(-1, 3).astype(int)
    hidden = drawn[:, :80].reshape(-1, 3).astype(int)
    assert (seen[:, 0] - seen[:, 2]).max() > 100
    assert (hidden[:, 0] - hidden[:, 2]).max() < 10
    with pytest.raises(InputError, match="visible"):
        keypoint_picture(image, CAMERA, points, pose, visible=[True])


@pytest.mark.parametrize("style", ["color", "depth", "normals", "faces", "lines"])
def test_every_style_draws_the_model_where_it_is(style):
    scene = _box()
    pose = pose_in_view(scene, CAMERA, Angles.parse("iso"))
    picture = draw_still(make_renderer("raycast"), scene, CAMERA, pose, style=style)
    assert picture.shape == (120, 160, 4)
    mask = cast_geometry(scene, CAMERA, pose).mask
    wide = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
    assert (picture[:, :, 3] > 0).any()
    assert not picture[:, :, 3][wide == 0].any()


def test_unknown_styles_and_views_are_refused():
    with pytest.raises(InputError, match="known are color, depth"):
        draw_still(make_renderer("raycast"), _box(), CAMERA, Alignment.identity(), style="oil")
    for text in ("sideways", "1", "1,2,3,4", "nan,0", ""):
        with pytest.raises(InputError, match="is not a view"):
            Angles.parse(text)
    with pytest.raises(InputError, match="elevation"):
        pose_in_view(_box(), CAMERA, Angles.parse("0,95"))


@pytest.mark.parametrize(
    ("name", "axis", "sign"), [("right", 0, 1), ("top", 1, 1), ("front", 2, -1)]
)
def test_named_views_look_from_where_they_say(name, axis, sign):
    pose = pose_in_view(_box(), CAMERA, Angles.parse(name))
    eye = pose.inverse([[0, 0, 0]])[0]
    assert np.argmax(np.abs(eye)) == axis
    assert np.sign(eye[axis]) == sign


def test_a_contact_sheet_holds_every_picture_and_refuses_odd_ones():
    images = [np.full((30, 40, 3), value, np.uint8) for value in (10, 90, 170)]
    sheet = contact_sheet(images, ["a", "b", "c"])
    for value in (10, 90, 170):
        assert (sheet == value).all(axis=2).sum() == 1200
    with pytest.raises(InputError, match="must have the same size"):
        contact_sheet([images[0], images[1][1:]], ["a", "b"])
    with pytest.raises(InputError, match="labels"):
        contact_sheet(images, ["a"])
