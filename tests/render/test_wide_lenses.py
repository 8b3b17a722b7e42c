"""Rendering and overlays with fisheye lenses, also beside and behind the camera plane."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from support.renderers import renderer_or_skip

from cadalign import Alignment, Camera, Mesh, Model, View, align
from cadalign.export.glb import photo_plane
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.render import Scene, cast_geometry
from cadalign.render.overlay import draw_result, photo_of
from cadalign.render.raycast import RaycastRenderer
from cadalign.render.scene import LIGHT_GREY
from cadalign.render.viewpoints import visible_keypoints

FISHEYE = Camera(241, 241, 70.0, 72.0, 120.0, 119.0, (0.01, -0.003, 0.0, 0.0), lens="fisheye")
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7], [0, 5, 1], [0, 4, 5]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 7, 3], [1, 5, 7]),
    ]
)
BOX_MESH = Mesh(CORNERS, FACES)
BOX = Scene(BOX_MESH)


def placed(angle: float, about: float = 0.7, *, distance: float = 4.0) -> Alignment:
    theta = np.radians(angle)
    across = np.sin(theta) * np.array([np.cos(about), np.sin(about)])
    return Alignment(
        rotation_from_vector(np.array([0.4, -0.6, 0.3])),
        distance * np.append(across, np.cos(theta)),
        [1.0, 0.8, 1.3],
    )


@pytest.mark.parametrize("about", [0.0, 0.7, np.pi / 2])
@pytest.mark.parametrize("angle", [0, 60, 90, 104])
def test_every_pixel_shows_the_point_that_projects_to_it(angle: float, about: float) -> None:
    camera, pose = FISHEYE, placed(angle, about)
    drawn = cast_geometry(BOX, camera, pose)
    rows, columns = np.nonzero(drawn.mask)
    assert len(rows) > 200
    pixels = np.column_stack([columns, rows]).astype(float)
    points = camera.unproject(pixels) * drawn.depth[rows, columns][:, None]
    np.testing.assert_allclose(camera.project(points), pixels, atol=0.01)
    in_model = (points - pose.translation) @ pose.rotation / pose.scale
    np.testing.assert_allclose(np.abs(in_model).max(axis=1), 1.0, atol=1e-4)
    # The outline of a convex object is the outline of its projected surface points.
    share = np.random.default_rng(0).dirichlet(np.ones(3), (12, 3000))
    surface = np.einsum("fnk,fkc->fnc", share, CORNERS[FACES]).reshape(-1, 3)
    seen = camera.project_where_ahead(pose.apply(surface))
    inside = seen[camera.contains(seen, margin=1.0)].round().astype(int)
    nearly = cv2.dilate(drawn.mask.astype(np.uint8), np.ones((3, 3), np.uint8))
    assert nearly[inside[:, 1], inside[:, 0]].all()
    assert len(np.unique(inside, axis=0)) > 0.9 * len(rows)


def test_keypoints_beside_the_plane_are_visible() -> None:
    pose = placed(90)
    visible = visible_keypoints(BOX, CORNERS, FISHEYE, pose)
    distances = np.linalg.norm(pose.apply(CORNERS), axis=1)
    assert visible[distances.argmin()]
    assert not visible[distances.argmax()]
    assert 4 <= visible.sum() <= 7
    upwards = placed(90, np.pi / 2)
    assert visible_keypoints(BOX, [[0, 0, 0]], FISHEYE, upwards).tolist() == [False]
    assert visible_keypoints(BOX, CORNERS, FISHEYE, upwards).sum() >= 4


def test_an_object_around_the_axis_behind_is_not_seen() -> None:
    narrow = Camera(241, 241, 70.0, 72.0, 120.0, 119.0, (-0.1, 0.0, 0.0, 0.0), lens="fisheye")
    assert not cast_geometry(BOX, narrow, placed(180)).mask.any()
    drawn = cast_geometry(BOX, narrow, placed(100))
    assert drawn.mask.any()


def test_the_picture_of_a_result_shows_model_box_and_regions() -> None:
    pose, points = placed(93, np.pi), CORNERS[[0, 1, 2, 4, 5, 7]]
    seen = FISHEYE.project(pose.apply(points))
    view = View(FISHEYE, seen, ids=[0, 1, 2, 4, 5, 7])
    result = align(Model(points_3d=CORNERS, mesh=BOX_MESH), view)
    picture = draw_result(photo_of(None, FISHEYE), result, mesh=BOX_MESH)
    drawn = cast_geometry(BOX, FISHEYE, pose).mask
    grey = np.array(LIGHT_GREY)
    changed = (np.abs(picture.astype(int) - grey).max(axis=2) > 8) & drawn
    assert changed.sum() > 0.9 * drawn.sum()


def test_opengl_leaves_wide_lenses_to_rays() -> None:
    opengl = renderer_or_skip("pyrender")
    pose = placed(90)
    expected = RaycastRenderer().render(BOX, FISHEYE, pose, samples=4)
    drawn = opengl.render(BOX, FISHEYE, pose, samples=4)
    np.testing.assert_array_equal(drawn.color, expected.color)


def test_the_photo_of_a_wide_lens_is_exported_as_a_pinhole_photo() -> None:
    rows, columns = np.indices((241, 241))
    image = np.stack([rows, columns, 0 * rows], axis=2).astype(np.uint8)
    flat, low, high = photo_plane(FISHEYE, image)
    assert flat is not None
    height, width = flat.shape[:2]
    for u, v in ((0.0, 0.0), (0.7, -0.5), (-0.4, 0.8)):
        x, y = (np.array([u, v]) - low) / (high - low) * (width, height) - 0.5
        ((column, row),) = FISHEYE.project([[u, v, 1.0]])
        shown = flat[round(float(y)), round(float(x))].astype(float)
        np.testing.assert_allclose(shown[:2], [row, column], atol=1.5)
