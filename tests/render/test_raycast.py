"""Ray-cast frames: geometry against formulas, pixels against `Camera.project`, colours."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from cadalign import Alignment, Camera, Mesh
from cadalign.errors import InputError
from cadalign.geometry import Material
from cadalign.render import RaycastRenderer, Scene, cast_geometry, look_at
from cadalign.render.canvas import bytes_from_linear, linear_from_bytes
from cadalign.render.surface import coincident_faces, corner_normals

CAMERA = Camera(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)
SKEWED = Camera(width=160, height=120, fx=170.0, fy=140.0, cx=60.25, cy=71.75)
BENT = Camera(160, 120, 170.0, 140.0, 66.0, 63.0, (-0.25, 0.06, 0.004, -0.003))
QUAD_FACES = [[0, 1, 2], [0, 2, 3]]


def _mesh(shape, **options):
    return Mesh(np.array(shape.vertices), np.array(shape.faces), **options)


def _quad_at(camera, left, top, right, bottom, *, depth=3.0):
    """A quad parallel to the image, with edges at given pixels."""
    corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]], dtype=float)
    rays = camera.normalize(corners)
    return Mesh(np.column_stack([rays, np.ones(4)]) * depth, QUAD_FACES)


def _facing_quad(**options):
    """A quad in the model's xy plane, seen from +z; counterclockwise from bottom left."""
    return Mesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], QUAD_FACES, **options)


def _front_view(distance=4.0):
    return look_at(azimuth=0, elevation=0, distance=distance)


@pytest.mark.parametrize("camera", [CAMERA, SKEWED, BENT])
@pytest.mark.parametrize("side", range(4))
@pytest.mark.parametrize("offset", [-0.01, 0.01])
def test_edge_crosses_a_pixel_centre_to_a_hundredth_of_a_pixel(camera, side, offset):
    edges = [40.0, 30.0, 110.0, 90.0]
    edges[side] += offset
    vertical = side % 2 == 0
    if camera.distortion:
        # A straight edge is curved in the image: test it at the middle of the other edges.
        middle = [75.0, 60.0]
        middle[0 if vertical else 1] = edges[side]
        ray = camera.normalize([middle])[0][0 if vertical else 1]
        low, high = [-0.3, -0.2], [0.3, 0.2]
        (low if side < 2 else high)[side % 2] = ray
        corners = [low, [high[0], low[1]], high, [low[0], high[1]]]
        mesh = Mesh(np.column_stack([corners, np.ones(4)]) * 3, QUAD_FACES)
    else:
        mesh = _quad_at(camera, *edges)
    mask = cast_geometry(Scene(mesh), camera, Alignment.identity()).mask
    pixel = (60, round(edges[side])) if vertical else (round(edges[side]), 75)
    grows_inwards = offset < 0 if side < 2 else offset > 0
    assert mask[pixel] == grows_inwards


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("distance", [3.0, 1e4])
def test_depth_is_exact_in_any_units(size, distance):
    plane = np.array([[-3, -2, -1], [3, -2, 0.5], [3, 2, 1.5], [-3, 2, 0.0]])
    camera = replace(CAMERA, fx=50.0 * distance, fy=50.0 * distance)
    frame = cast_geometry(
        Scene(Mesh(plane * size, QUAD_FACES)),
        camera,
        Alignment(np.eye(3), [0, 0, distance * size], [1, 1, 1]),
    )
    assert frame.mask.mean() > 0.9
    rows, columns = np.nonzero(frame.mask)
    rays = np.column_stack([camera.normalize(np.column_stack([columns, rows])), np.ones(len(rows))])
    corners = (plane + np.array([0, 0, distance])) * size
    for face, (a, b, c) in enumerate(QUAD_FACES):
        normal = np.cross(corners[b] - corners[a], corners[c] - corners[a])
        chosen = frame.face_id[rows, columns] == face
        expected = normal @ corners[a] / (rays[chosen] @ normal)
        np.testing.assert_allclose(frame.depth[rows, columns][chosen], expected, rtol=1e-9)


def test_stretching_by_the_pose_equals_stretching_the_mesh():
    mesh = _mesh(trimesh.creation.icosphere(subdivisions=2))
    scale = np.array([1.0, 0.6, 1.7])
    view = look_at(azimuth=30, elevation=20, distance=6, scale=scale)
    by_pose = cast_geometry(Scene(mesh), CAMERA, view)
    by_mesh = cast_geometry(
        Scene(mesh.stretch(scale)),
        CAMERA,
        Alignment(view.rotation, view.translation, [1, 1, 1]),
    )
    same = by_pose.face_id == by_mesh.face_id
    assert same.mean() > 0.9999
    np.testing.assert_allclose(by_pose.depth[same], by_mesh.depth[same], rtol=1e-9)
    np.testing.assert_allclose(by_pose.normal[same], by_mesh.normal[same], atol=1e-6)


def test_normals_face_the_camera_for_any_winding():
    sphere = trimesh.creation.icosphere(subdivisions=3)
    faces = np.array(sphere.faces)
    faces[::2] = faces[::2, ::-1]
    frame = cast_geometry(Scene(Mesh(sphere.vertices, faces)), CAMERA, _front_view())
    rows, columns = np.nonzero(frame.mask)
    rays = np.column_stack([CAMERA.normalize(np.column_stack([columns, rows])), np.ones(len(rows))])
    points = rays * frame.depth[frame.mask][:, None]
    outward = points - [0, 0, 4]
    normal = frame.normal[frame.mask]
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-6)
    assert (np.einsum("nk,nk->n", normal, rays) < 0).all()
    cosine = np.einsum("nk,nk->n", normal, outward) / np.linalg.norm(outward, axis=1)
    assert cosine.min() > np.cos(np.radians(6))


def test_no_ray_from_inside_a_sphere_escapes_through_edges_or_vertices():
    sphere = trimesh.creation.icosphere(subdivisions=5)
    vertices, edges = np.array(sphere.vertices), np.array(sphere.edges_unique)
    share = np.random.default_rng(0).random((len(edges), 1))
    targets = np.concatenate(
        [
            vertices,
            vertices[edges].mean(axis=1),
            vertices[edges[:, 0]] * share + vertices[edges[:, 1]] * (1 - share),
        ]
    )
    caster = Scene(_mesh(sphere)).caster
    for origin in (np.zeros(3), np.array([0.1, 0.2, 0.3])):
        face, distance = caster.first_hits(origin, targets - origin)
        assert (face >= 0).all()
        np.testing.assert_allclose(distance, 1, atol=1e-4)


def test_edges_stay_sharp_from_very_far_away():
    distance = 1e4
    camera = replace(CAMERA, fx=60 * distance, fy=60 * distance)
    view = look_at(azimuth=37, elevation=21, distance=distance)
    mask = cast_geometry(Scene(_facing_quad()), camera, view).mask
    rows, columns = np.indices(mask.shape)
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    rays = np.column_stack([camera.normalize(pixels), np.ones(len(pixels))])
    directions = rays @ view.rotation
    origin = view.inverse([[0, 0, 0]])[0]
    points = origin - directions * (origin[2] / directions[:, 2:])
    beyond = np.abs(points[:, :2]).max(axis=1) - 1
    clear = np.abs(beyond) > 3e-5
    np.testing.assert_array_equal(mask.ravel()[clear], (beyond < 0)[clear])


def test_empty_pixels_have_the_documented_values():
    frame = RaycastRenderer().render(Scene(_facing_quad()), CAMERA, _front_view())
    assert frame.depth[0, 0] == 0
    assert frame.face_id[0, 0] == -1
    assert not frame.mask[0, 0]
    assert not frame.normal[0, 0].any()
    assert not frame.color[0, 0].any()
    assert (frame.mask == (frame.depth > 0)).all()


def test_camera_inside_the_object_sees_its_inside():
    scene = Scene(_mesh(trimesh.creation.box()))
    frame = cast_geometry(scene, CAMERA, Alignment(np.eye(3), [0.1, 0, 0.2], [1, 1, 1]))
    assert frame.mask.all()
    assert frame.depth[60, 80] == pytest.approx(0.7, rel=1e-9)


def test_silhouettes_are_antialiased_and_keep_the_objects_colour():
    mesh = _facing_quad(materials=(Material(color=(0.9, 0.1, 0.1, 1.0)),))
    view = look_at(azimuth=0, elevation=0, distance=4, roll=17)
    frame = RaycastRenderer().render(Scene(mesh), CAMERA, view, samples=32)
    partial = (frame.color[:, :, 3] > 0) & (frame.color[:, :, 3] < 255)
    assert partial.sum() > 100
    assert np.abs(frame.color[partial][:, :3].astype(int) - frame.color[60, 80, :3]).max() < 12
    # The area of the quad, in pixels.
    area = (2 * 150 / 4) ** 2
    assert frame.color[:, :, 3].sum() / 255 == pytest.approx(area, rel=2e-3)


def test_texture_starts_at_the_bottom_left():
    texture = np.zeros((2, 2, 3), dtype=np.uint8)
    texture[0, 0], texture[0, 1] = (255, 0, 0), (0, 255, 0)  # the upper row
    texture[1, 0], texture[1, 1] = (0, 0, 255), (255, 255, 255)
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])[QUAD_FACES]
    mesh = _facing_quad(corner_uv=uv, materials=(Material("m", (1, 1, 1, 1), texture),))
    color = RaycastRenderer().render(Scene(mesh), CAMERA, _front_view()).color
    upper_left, upper_right, lower_left, lower_right = (
        color[row, column, :3].astype(int) for row in (41, 79) for column in (61, 99)
    )
    assert upper_left.argmax() == 0
    assert upper_right.argmax() == 1
    assert lower_left.argmax() == 2
    assert np.ptp(lower_right) < 10


def test_texture_repeats():
    texture = np.full((4, 4, 3), 255, dtype=np.uint8)
    texture[:, 2:] = (255, 0, 0)
    uv = np.array([[-1.0, 5.0], [1.0, 5.0], [1.0, 7.0], [-1.0, 7.0]])[QUAD_FACES]
    mesh = _facing_quad(corner_uv=uv, materials=(Material("m", (1, 1, 1, 1), texture),))
    color = RaycastRenderer().render(Scene(mesh), CAMERA, _front_view()).color
    stripes = color[60, [52, 70, 89, 107], 1] > 128
    assert stripes.tolist() == [True, False, True, False]


def test_vertex_colors_blend_within_a_triangle():
    colors = np.array([[1, 0, 0, 1], [0, 0, 1, 1], [0, 0, 1, 1], [1, 0, 0, 1]], dtype=float)
    color = (
        RaycastRenderer()
        .render(Scene(_facing_quad(vertex_colors=colors)), CAMERA, _front_view())
        .color.astype(int)
    )
    left, middle, right = (color[60, column] for column in (45, 79, 114))
    assert left[0] > 2 * left[2]
    assert right[2] > 2 * right[0]
    assert abs(middle[0] - middle[2]) < 12


def test_materials_belong_to_faces():
    materials = (Material(color=(1, 0, 0, 1)), Material(color=(0, 1, 0, 1)))
    mesh = _facing_quad(materials=materials, face_material=np.array([0, 1]))
    frame = RaycastRenderer().render(Scene(mesh), CAMERA, _front_view())
    for face, channel in ((0, 0), (1, 1)):
        inside = (frame.face_id == face) & (frame.color[:, :, 3] == 255)
        median = np.median(frame.color[inside][:, :3], axis=0)
        assert median.argmax() == channel


def test_objects_behind_a_transparent_sheet_are_visible():
    front = _facing_quad().vertices + np.array([0, 0, 0.5])
    vertices = np.concatenate([_facing_quad().vertices, front])
    faces = np.concatenate([QUAD_FACES, np.array(QUAD_FACES) + 4])
    materials = (Material(color=(1, 0, 0, 1)), Material(color=(0, 0, 1, 0.5)))
    mesh = Mesh(vertices, faces, materials=materials, face_material=np.array([0, 0, 1, 1]))
    frame = RaycastRenderer().render(Scene(mesh), CAMERA, _front_view())
    red, green, blue, opacity = frame.color[60, 80].astype(int)
    assert opacity == 255
    assert min(red, blue) > 100
    assert green < 80
    assert frame.depth[60, 80] == pytest.approx(3.5)
    alone = Mesh(front, QUAD_FACES, materials=(materials[1],))
    assert RaycastRenderer().render(Scene(alone), CAMERA, _front_view()).color[
        60, 80, 3
    ] == pytest.approx(128, abs=1)


def test_coincident_faces_are_found_by_position():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.0, 0, -0.0], [1, 0, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [4, 5, 3], [3, 5, 4]])
    alike, opposite = coincident_faces(vertices, faces)
    assert alike.tolist() == [0, 0, 2]
    assert opposite.tolist() == [2, 2, 0]


def test_smooth_normals_round_a_sphere_and_leave_a_cube_sharp():
    sphere = trimesh.creation.icosphere(subdivisions=3)
    faces = np.array(sphere.faces)
    faces[::3] = faces[::3, ::-1]
    scene = Scene(Mesh(sphere.vertices, faces))
    radial = np.array(sphere.vertices)[faces]
    cosine = np.abs(np.einsum("mck,mck->mc", scene.corner_normals, radial))
    assert cosine.min() > 0.9999
    assert (np.einsum("mck,mk->mc", scene.corner_normals, scene.face_normals) > 0).all()
    cube = Scene(_mesh(trimesh.creation.box()))
    np.testing.assert_allclose(cube.corner_normals, cube.face_normals[:, None].repeat(3, axis=1))


def test_a_fan_of_very_many_triangles_stays_faceted():
    count = 1500
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    rim = np.column_stack([np.cos(angle), np.zeros(count), np.sin(angle)])
    vertices = np.concatenate([[[0, 1, 0]], rim])
    following = np.roll(np.arange(1, count + 1), -1)
    faces = np.column_stack([np.zeros(count, int), np.arange(1, count + 1), following])
    scene = Scene(Mesh(vertices, faces))
    normals = corner_normals(vertices, faces, scene.face_normals)
    np.testing.assert_array_equal(normals[:, 0], scene.face_normals)


def test_triangles_without_area_are_harmless():
    vertices = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 1], [0, 0, 2]]
    faces = [*QUAD_FACES, [4, 4, 4], [4, 5, 4], [0, 2, 1]]
    with np.errstate(all="raise", under="ignore"):
        frame = RaycastRenderer().render(Scene(Mesh(vertices, faces)), CAMERA, _front_view())
    assert np.isfinite(frame.depth).all()
    assert frame.mask.sum() > 1000


def test_composite_keeps_the_background_and_blends_in_linear_light():
    view = look_at(azimuth=0, elevation=0, distance=4, roll=17)
    frame = RaycastRenderer().render(Scene(_facing_quad()), CAMERA, view)
    photo = np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    result = frame.composite(photo)
    clear, full = frame.color[:, :, 3] == 0, frame.color[:, :, 3] == 255
    np.testing.assert_array_equal(result[clear], photo[clear])
    np.testing.assert_array_equal(result[full], frame.color[full][:, :3])
    turned = replace(frame, color=frame.color[::-1, ::-1]).composite(photo[::-1, ::-1])
    np.testing.assert_array_equal(turned[::-1, ::-1], result)
    half = replace(frame, color=np.full((1, 1, 4), (255, 255, 255, 128), dtype=np.uint8))
    # Half of the light of white is 188 in sRGB.
    assert half.composite((0, 0, 0))[0, 0].tolist() == [188] * 3
    for bad in (np.zeros((3, 3, 3), np.uint8), (0.5, 0.5, 0.5), (300, 0, 0)):
        with pytest.raises(InputError, match="background"):
            frame.composite(bad)


def test_srgb_bytes_round_trip_through_linear_light():
    every = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(bytes_from_linear(linear_from_bytes(every)), every)


def test_scene_survives_pickling_and_prepares_once():
    scene = Scene(_facing_quad())
    before = cast_geometry(scene, CAMERA, _front_view())
    assert scene.caster is scene.caster
    again = pickle.loads(pickle.dumps(scene))
    after = cast_geometry(again, CAMERA, _front_view())
    np.testing.assert_array_equal(before.depth, after.depth)
