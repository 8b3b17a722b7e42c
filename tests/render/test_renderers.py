"""Rendering against `Camera.project` and against the cast geometry; light and materials."""

from __future__ import annotations

import pickle
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from cadalign import Alignment, Camera, Material, Mesh
from cadalign.errors import InputError, RenderError
from cadalign.render import (
    RaycastRenderer,
    Scene,
    Studio,
    frame_object,
    look_at,
)

CAMERA = Camera(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)
SKEWED = Camera(width=160, height=120, fx=170.0, fy=140.0, cx=60.25, cy=71.75)
BENT = Camera(160, 120, 170.0, 140.0, 66.0, 63.0, (-0.25, 0.06, 0.004, -0.003))


def _knot() -> Mesh:
    """A chain of rings with many silhouettes inside the object."""
    rings = [trimesh.creation.torus(0.6, 0.2, major_sections=48, minor_sections=20)]
    for turn, shift in ((90, 0.7), (0, 1.4)):
        ring = rings[0].copy()
        ring.apply_transform(trimesh.transformations.rotation_matrix(np.radians(turn), [1, 0, 0]))
        ring.apply_translation([shift, 0.1, 0])
        rings.append(ring)
    chain = trimesh.util.concatenate(rings)
    return Mesh(np.array(chain.vertices), np.array(chain.faces))


QUAD = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
FACES = [[0, 1, 2], [0, 2, 3]]


def _textured(texture) -> Mesh:
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])[FACES]
    return Mesh(QUAD, FACES, corner_uv=uv, materials=(Material("m", (1, 1, 1, 1), texture),))


def _view(scene, camera, **angles):
    rotation = look_at(azimuth=35, elevation=25, distance=3, **angles).rotation
    return frame_object(scene.bounds, camera, rotation=rotation, fill=0.9)


@pytest.mark.slow
@pytest.mark.parametrize("camera", [CAMERA, SKEWED, BENT], ids=["plain", "skewed", "bent"])
def test_mask_edges_of_the_colour_lie_within_a_pixel_of_the_cast_ones(camera):
    scene = Scene(_knot())
    frame = RaycastRenderer().render(scene, camera, _view(scene, camera))
    drawn = (frame.color[:, :, 3] > 127).astype(np.uint8)
    cast = frame.mask.astype(np.uint8)
    around = np.ones((3, 3), np.uint8)
    assert cast.sum() > 2000
    assert (drawn <= cv2.dilate(cast, around)).all()
    assert (drawn >= cv2.erode(cast, around)).all()


@pytest.mark.long
@pytest.mark.parametrize("camera", [CAMERA, SKEWED, BENT], ids=["plain", "skewed", "bent"])
@pytest.mark.parametrize("place", [(20.3, 30.8), (79.5, 59.5), (130.62, 95.37)])
def test_a_marker_is_drawn_where_project_says(camera, place):
    # A disc parallel to the image, whose stretch is undone by its pose.
    size = 14.0
    if camera.distortion:
        camera = Camera(640, 480, 680.0, 560.0, 265.5, 253.5, camera.distortion)
        place = (4 * place[0] + 1.5, 4 * place[1] + 1.5)
        size = 30.0
    center = 3 * np.append(camera.normalize([place])[0], 1.0)
    radius = 3 * size / camera.fx
    angle = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    rim = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(90)])
    vertices = np.concatenate([[[0, 0, 0]], rim])
    faces = [[0, 1 + i, 1 + (i + 1) % 90] for i in range(90)]
    scale = np.array([1.0, 2.0, 0.5])
    scene = Scene(Mesh(vertices / scale, faces))
    frame = RaycastRenderer().render(scene, camera, Alignment(np.eye(3), center, scale), samples=64)
    opacity = frame.color[:, :, 3].astype(float)
    rows, columns = np.indices(opacity.shape)
    found = np.array([(columns * opacity).sum(), (rows * opacity).sum()]) / opacity.sum()
    np.testing.assert_allclose(found, _picture_middle(camera, center, radius), atol=0.05)


def _picture_middle(camera, center, radius):
    """Where the middle of a disc's picture is: a lens shifts it against the middle's picture."""
    grid = np.linspace(-radius, radius, 801)
    x, y = (values.ravel() for values in np.meshgrid(grid, grid))
    inside = x**2 + y**2 < radius**2
    points = center + np.column_stack([x, y, np.zeros(len(x))])[inside]
    rays = points[:, :2] / points[:, 2:]
    # Parts that the lens enlarges count for more.
    weight = np.linalg.det(camera.distortion_jacobian(rays))
    return np.average(camera.pixels_from_normalized(rays), axis=0, weights=weight)


def test_a_texture_lies_as_its_coordinates_say() -> None:
    texture = np.zeros((2, 2, 3), np.uint8)
    texture[0], texture[1] = (220, 60, 40), (40, 90, 220)
    view = look_at(azimuth=20, elevation=20, distance=4)
    frame = RaycastRenderer().render(Scene(_textured(texture)), CAMERA, view)
    upper = frame.color[45, 80].astype(int)
    lower = frame.color[75, 80].astype(int)
    assert upper[0] > upper[2] + 60
    assert lower[2] > lower[0] + 60


def test_both_sides_of_a_face_are_lit_alike():
    view = look_at(azimuth=20, elevation=10, distance=4)
    there = RaycastRenderer().render(Scene(Mesh(QUAD, FACES)), CAMERA, view).color
    turned = RaycastRenderer().render(Scene(Mesh(QUAD, [[2, 1, 0], [3, 2, 0]])), CAMERA, view).color
    assert np.abs(there.astype(int) - turned).max() <= 1
    assert there[60, 80, :3].min() > 100


def test_of_coincident_faces_the_one_wound_to_the_camera_is_drawn():
    faces = [*FACES, [2, 1, 0], [3, 2, 0]]
    materials = (Material(color=(1, 0, 0, 1)), Material(color=(0, 0, 1, 1)))
    mesh = Mesh(QUAD, faces, materials=materials, face_material=np.array([0, 0, 1, 1]))
    for azimuth, channel in ((0, 0), (180, 2)):
        view = look_at(azimuth=azimuth, elevation=0, distance=4)
        color = RaycastRenderer().render(Scene(mesh), CAMERA, view).color
        assert color[60, 80, :3].argmax() == channel


def test_nothing_is_drawn_out_of_view_and_no_image_too_large():
    scene = Scene(_knot())
    frame = RaycastRenderer().render(scene, CAMERA, Alignment(np.eye(3), [0, 0, -9], [1, 1, 1]))
    assert not frame.mask.any()
    assert not frame.color.any()
    looking = _view(scene, CAMERA)
    with pytest.raises(RenderError, match="the limits are"):
        RaycastRenderer().render(
            scene, Camera.from_fov(20000, 20000, fov_x=60), _view(scene, CAMERA)
        )
    with pytest.raises(InputError, match="samples"):
        RaycastRenderer().render(scene, CAMERA, looking, samples=0)


@pytest.mark.slow
def test_lens_that_cannot_be_inverted_everywhere_leaves_those_pixels_empty():
    camera = replace(BENT, fx=60.0, fy=60.0, distortion=(-0.4, 0.05, 0.0, 0.0))
    corners = [[0, 0], [159, 0], [0, 119], [159, 119]]
    assert not camera.normalize_where_valid(corners)[1].any()
    wall = Mesh([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], [[0, 1, 2], [0, 2, 3]])
    frame = RaycastRenderer().render(
        Scene(wall), camera, Alignment(np.eye(3), [0, 0, 3], [1, 1, 1])
    )
    assert not frame.mask[0, 0]
    assert frame.color[0, 0, 3] == 0
    assert frame.mask[63, 66]
    assert frame.color[63, 66, 3] == 255


def test_what_is_prepared_of_a_mesh_is_prepared_once():
    scene = Scene(_knot())
    RaycastRenderer().render(scene, CAMERA, _view(scene, CAMERA))
    before = {name: id(value) for name, value in vars(scene).items()}
    RaycastRenderer().render(scene, CAMERA, look_at(azimuth=80, elevation=5, distance=5))
    assert {name: id(vars(scene)[name]) for name in before} == before


def test_scenes_survive_pickling() -> None:
    scene = Scene(_knot())
    view = _view(scene, CAMERA)
    again = pickle.loads(pickle.dumps(scene))
    np.testing.assert_array_equal(
        RaycastRenderer().render(again, CAMERA, view).color,
        RaycastRenderer().render(scene, CAMERA, view).color,
    )


def test_ambient_occlusion_darkens_corners_alone():
    floor = [[-2, -1, -2], [2, -1, -2], [2, -1, 2], [-2, -1, 2]]
    wall = [[-2, -1, -2], [2, -1, -2], [2, 2, -2], [-2, 2, -2]]
    faces = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    scene = Scene(Mesh(np.array(floor + wall, dtype=float), faces))
    view = look_at(azimuth=0, elevation=20, distance=8)
    plain = RaycastRenderer(studio=Studio(occlusion=0)).render(scene, CAMERA, view)
    dark = RaycastRenderer(studio=Studio(occlusion=1)).render(scene, CAMERA, view)
    ratio = dark.color[:, 80, 1] / np.maximum(plain.color[:, 80, 1], 1)
    corner = np.flatnonzero(np.diff(plain.face_id[:, 80] // 2) != 0)[1]
    assert ratio[corner - 1 : corner + 2].max() < 0.85
    seen = np.flatnonzero(plain.mask[:, 80])
    assert ratio[seen[2]] > 0.99
    np.testing.assert_array_equal(plain.color[:, :, 3], dark.color[:, :, 3])
