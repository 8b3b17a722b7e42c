"""Renderers compared with each other and with `Camera.project`; broken graphics libraries."""

from __future__ import annotations

import json
import pickle
import re
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from support.renderers import ball, renderer_or_skip

from cadalign import Alignment, Camera, Mesh
from cadalign.errors import InputError, RenderError
from cadalign.geometry import Material
from cadalign.render import (
    RaycastRenderer,
    Scene,
    Studio,
    cast_geometry,
    frame_object,
    look_at,
    make_renderer,
)
from cadalign.render import probe as probing
from cadalign.render.probe import Probe

CAMERA = Camera(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)
SKEWED = Camera(width=160, height=120, fx=170.0, fy=140.0, cx=60.25, cy=71.75)
BENT = Camera(160, 120, 170.0, 140.0, 66.0, 63.0, (-0.25, 0.06, 0.004, -0.003))
NAMES = ("raycast", "open3d", "pyrender")


@pytest.fixture(params=NAMES)
def renderer(request):
    return renderer_or_skip(request.param)


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


@pytest.mark.long
def test_open3d_agrees_with_embreex_on_depth_and_faces():
    renderer_or_skip("open3d")
    camera = Camera.from_fov(640, 480, fov_x=50)
    differing, total = 0, 0
    for mesh in (_knot(), ball(5)):
        scene = Scene(mesh)
        pose = _view(scene, camera)
        one = cast_geometry(scene, camera, pose)
        other = make_renderer("open3d").render(scene, camera, pose, samples=1)
        same = one.face_id == other.face_id
        differing += (~same).sum()
        total += same.size
        np.testing.assert_array_equal(one.depth[same], other.depth[same])
        near = np.abs(one.depth - other.depth) <= 1e-6 * one.depth.max()
        assert near.mean() > 0.9999
    assert differing < 1e-4 * total


@pytest.mark.slow
@pytest.mark.parametrize("camera", [CAMERA, SKEWED, BENT], ids=["plain", "skewed", "bent"])
def test_mask_edges_of_the_colour_lie_within_a_pixel_of_the_cast_ones(renderer, camera):
    scene = Scene(_knot())
    frame = renderer.render(scene, camera, _view(scene, camera))
    drawn = (frame.color[:, :, 3] > 127).astype(np.uint8)
    cast = frame.mask.astype(np.uint8)
    around = np.ones((3, 3), np.uint8)
    assert cast.sum() > 2000
    assert (drawn <= cv2.dilate(cast, around)).all()
    assert (drawn >= cv2.erode(cast, around)).all()


@pytest.mark.long
@pytest.mark.parametrize("camera", [CAMERA, SKEWED, BENT], ids=["plain", "skewed", "bent"])
@pytest.mark.parametrize("place", [(20.3, 30.8), (79.5, 59.5), (130.62, 95.37)])
def test_a_marker_is_drawn_at_its_projection(renderer, camera, place):
    # A disc parallel to the image; its pose inverts the stretch of its mesh.
    size = 14.0
    if camera.distortion:
        # Larger, since OpenGL has only four samples per pixel.
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
    frame = renderer.render(scene, camera, Alignment(np.eye(3), center, scale), samples=64)
    opacity = frame.color[:, :, 3].astype(float)
    rows, columns = np.indices(opacity.shape)
    found = np.array([(columns * opacity).sum(), (rows * opacity).sum()]) / opacity.sum()
    np.testing.assert_allclose(found, _picture_middle(camera, center, radius), atol=0.05)


def _picture_middle(camera, center, radius):
    """Centre of a disc's image, which distortion shifts from the image of its centre."""
    grid = np.linspace(-radius, radius, 801)
    x, y = (values.ravel() for values in np.meshgrid(grid, grid))
    inside = x**2 + y**2 < radius**2
    points = center + np.column_stack([x, y, np.zeros(len(x))])[inside]
    rays = points[:, :2] / points[:, 2:]
    # Parts that the lens enlarges have more weight.
    weight = np.linalg.det(camera.distortion_jacobian(rays))
    return np.average(camera.pixels_from_normalized(rays), axis=0, weights=weight)


def test_all_renderers_draw_about_the_same_colours(renderer):
    texture = np.zeros((2, 2, 3), np.uint8)
    texture[0], texture[1] = (220, 60, 40), (40, 90, 220)
    mesh = _textured(texture)
    view = look_at(azimuth=20, elevation=20, distance=4)
    frame = renderer.render(Scene(mesh), CAMERA, view)
    truth = RaycastRenderer().render(Scene(mesh), CAMERA, view)
    np.testing.assert_allclose(frame.depth, truth.depth, rtol=1e-9)  # for any renderer's colour
    both = (frame.color[:, :, 3] == 255) & (truth.color[:, :, 3] == 255)
    difference = np.abs(frame.color[both].astype(int) - truth.color[both])
    assert np.median(difference) < 25
    upper = frame.color[45, 80].astype(int)
    lower = frame.color[75, 80].astype(int)
    assert upper[0] > upper[2] + 60
    assert lower[2] > lower[0] + 60


@pytest.mark.slow
@pytest.mark.parametrize("width", [1, 2, 3, 5, 7])
def test_textures_of_odd_widths_are_read_row_by_row(renderer, width):
    texture = np.zeros((4, width, 3), np.uint8)
    texture[:2], texture[2:] = (255, 0, 0), (0, 255, 0)
    mesh = _textured(texture)
    color = renderer.render(Scene(mesh), CAMERA, look_at(azimuth=0, elevation=0, distance=4)).color
    assert (color[40:52, 50:110, 0] > color[40:52, 50:110, 1] + 80).all()
    assert (color[68:80, 50:110, 1] > color[68:80, 50:110, 0] + 80).all()


def test_both_sides_of_a_face_are_lit_alike(renderer):
    view = look_at(azimuth=20, elevation=10, distance=4)
    there = renderer.render(Scene(Mesh(QUAD, FACES)), CAMERA, view).color
    turned = renderer.render(Scene(Mesh(QUAD, [[2, 1, 0], [3, 2, 0]])), CAMERA, view).color
    assert np.abs(there.astype(int) - turned).max() <= 1
    assert there[60, 80, :3].min() > 100


def test_coincident_faces_show_the_one_wound_towards_the_camera(renderer):
    faces = [*FACES, [2, 1, 0], [3, 2, 0]]
    materials = (Material(color=(1, 0, 0, 1)), Material(color=(0, 0, 1, 1)))
    mesh = Mesh(QUAD, faces, materials=materials, face_material=np.array([0, 0, 1, 1]))
    for azimuth, channel in ((0, 0), (180, 2)):
        view = look_at(azimuth=azimuth, elevation=0, distance=4)
        color = renderer.render(Scene(mesh), CAMERA, view).color
        assert color[60, 80, :3].argmax() == channel


def test_out_of_view_and_too_large_are_the_same_everywhere(renderer):
    scene = Scene(_knot())
    frame = renderer.render(scene, CAMERA, Alignment(np.eye(3), [0, 0, -9], [1, 1, 1]))
    assert not frame.mask.any()
    assert not frame.color.any()
    with pytest.raises(RenderError, match="the limits are"):
        renderer.render(scene, Camera.from_fov(20000, 20000, fov_x=60), _view(scene, CAMERA))
    with pytest.raises(InputError, match="samples"):
        renderer.render(scene, CAMERA, _view(scene, CAMERA), samples=0)


@pytest.mark.slow
def test_lens_that_cannot_be_inverted_everywhere_leaves_those_pixels_empty(renderer):
    camera = replace(BENT, fx=60.0, fy=60.0, distortion=(-0.4, 0.05, 0.0, 0.0))
    corners = [[0, 0], [159, 0], [0, 119], [159, 119]]
    assert not camera.normalize_where_valid(corners)[1].any()
    wall = Mesh([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], [[0, 1, 2], [0, 2, 3]])
    frame = renderer.render(Scene(wall), camera, Alignment(np.eye(3), [0, 0, 3], [1, 1, 1]))
    assert not frame.mask[0, 0]
    assert frame.color[0, 0, 3] == 0
    assert frame.mask[63, 66]
    assert frame.color[63, 66, 3] == 255


def test_changing_between_scenes_draws_each_of_them(renderer):
    vertices = [[-1, -1, 0], [1, -1, 0], [0, 1, 0]]
    red = Scene(Mesh(vertices, [[0, 1, 2]], materials=(Material(color=(1, 0, 0, 1)),)))
    blue = Scene(Mesh(vertices, [[0, 1, 2]], materials=(Material(color=(0, 0, 1, 1)),)))
    view = look_at(azimuth=0, elevation=0, distance=4)
    for scene, channel in ((red, 0), (blue, 2), (red, 0)):
        assert renderer.render(scene, CAMERA, view).color[60, 80, :3].argmax() == channel


def test_a_mesh_is_prepared_once(renderer, monkeypatch):
    scene = Scene(_knot())
    renderer.render(scene, CAMERA, _view(scene, CAMERA))
    before = {name: id(value) for name, value in vars(scene).items()}
    renderer.render(scene, CAMERA, look_at(azimuth=80, elevation=5, distance=5))
    assert {name: id(vars(scene)[name]) for name in before} == before


def test_renderers_survive_pickling(renderer):
    again = pickle.loads(pickle.dumps(renderer))
    assert again.name == renderer.name
    scene = Scene(_knot())
    view = _view(scene, CAMERA)
    np.testing.assert_array_equal(
        again.render(scene, CAMERA, view).color, renderer.render(scene, CAMERA, view).color
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


# Choice of the renderer, and broken graphics libraries


def test_a_renderer_that_does_not_work_is_refused(monkeypatch):
    monkeypatch.setattr(
        "cadalign.render.probe.probe_renderer", lambda name: Probe(name, False, "no EGL")
    )
    for name in ("pyrender", "open3d"):
        with pytest.raises(RenderError, match=f"{name}: the renderer does not work here: no EGL"):
            make_renderer(name)
    assert make_renderer("raycast").name == "raycast"


def test_unknown_renderers_are_refused():
    with pytest.raises(InputError, match=r"unknown renderer 'blender'; known are pyrender"):
        make_renderer("blender")


@pytest.mark.long
@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "killed by signal 11"),
        ("raise ImportError('Unable to load EGL library')", "Unable to load EGL library"),
        ("import sys; sys.exit(3)", "SystemExit|no message"),
    ],
)
def test_a_broken_graphics_library_does_not_take_the_caller_down(
    tmp_path, monkeypatch, body, reason
):
    (tmp_path / "pyrender").mkdir()
    (tmp_path / "pyrender" / "__init__.py").write_text(body)
    monkeypatch.syspath_prepend(str(tmp_path))
    found = probing.probe_renderer.__wrapped__("pyrender")
    assert not found.works
    assert re.search(reason, found.detail), found.detail


@pytest.mark.long
def test_a_missing_egl_device_is_reported(monkeypatch):
    renderer_or_skip("pyrender")
    monkeypatch.setenv("EGL_DEVICE_ID", "77")
    found = probing.probe_renderer.__wrapped__("pyrender")
    assert not found.works
    assert "ValueError: " in found.detail


def test_importing_the_package_loads_no_graphics():
    code = (
        "import sys, json, cadalign.render; "
        "print(json.dumps([m for m in ('pyrender', 'open3d', 'OpenGL') if m in sys.modules]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == []
