"""Picked points lie on the exact model, not on the simplified display."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cadalign import Alignment, Camera, Mesh
from cadalign.annotate.model import ClickableModel, box_lines
from cadalign.errors import InputError

SQUARE = [[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]


def sphere(rings: int, *, dent: float = 0.0) -> Mesh:
    """A unit sphere of 2 * rings^2 triangles, moved off the origin."""
    theta, phi = np.meshgrid(
        np.linspace(0.01, np.pi - 0.01, rings + 1), np.linspace(0, 2 * np.pi, rings + 1)
    )
    radius = 1 + dent * np.sin(5 * theta) * np.cos(4 * phi)
    points = radius[..., None] * np.stack(
        [np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], axis=-1
    )
    a = np.arange(rings)[:, None] * (rings + 1) + np.arange(rings)
    quads = np.stack([a, a + 1, a + rings + 2, a + rings + 1], axis=-1).reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return Mesh(points.reshape(-1, 3) + [3.0, -1.0, 2.0], faces)


def box_mesh() -> Mesh:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 2) for z in (0, 3)], dtype=float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    return Mesh(corners, faces)


# --- picking ---------------------------------------------------------------------------------


def test_pick_gives_a_point_of_the_surface() -> None:
    model = ClickableModel(Mesh(SQUARE, [[0, 1, 2], [0, 2, 3]]))
    point = model.pick([1.5, 0.5, 4.0], [0, 0, -2])
    assert point is not None
    np.testing.assert_allclose(point.xyz, [1.5, 0.5, 0], atol=1e-5)
    assert model.pick([5, 5, 4], [0, 0, -1]) is None


@pytest.mark.long
@given(st.integers(0, 2**31))
def test_picked_points_lie_on_the_ray(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mesh = sphere(12, dent=0.2)
    model = ClickableModel(mesh)
    origin = model.center + 6 * (lambda v: v / np.linalg.norm(v))(rng.normal(size=3))
    target = model.center + rng.uniform(-0.5, 0.5, 3)
    point = model.pick(origin, target - origin)
    assert point is not None
    off_ray = np.cross(np.array(point.xyz) - origin, target - origin)
    assert np.linalg.norm(off_ray) / np.linalg.norm(target - origin) < 1e-4


def test_rays_are_checked() -> None:
    model = ClickableModel(Mesh(SQUARE, [[0, 1, 2]]))
    with pytest.raises(InputError, match=r"^direction: the vector is zero$"):
        model.pick([0, 0, 1], [0, 0, 0])
    with pytest.raises(InputError, match=r"^origin: NaN or infinite"):
        model.pick([0, 0, np.nan], [0, 0, 1])


def test_a_model_without_extent_is_refused() -> None:
    with pytest.raises(InputError, match=r"^dot: all vertices of the mesh coincide$"):
        ClickableModel(Mesh([[1, 1, 1]] * 3, [[0, 1, 2]], source="dot"))


def test_display_coordinates_are_centred_with_diagonal_1() -> None:
    model = ClickableModel(box_mesh())
    shown = model.to_display(model.scene.bounds)
    np.testing.assert_allclose(shown.sum(axis=0), 0, atol=1e-12)
    assert np.linalg.norm(shown[1] - shown[0]) == pytest.approx(1)
    np.testing.assert_allclose(model.from_display(shown), model.scene.bounds)


# --- what is shown ---------------------------------------------------------------------------


def test_display_bytes_hold_triangles_normals_and_colours() -> None:
    model = ClickableModel(box_mesh())
    faces, lines = np.frombuffer(model.display_bytes[:8], "<u4").tolist()
    assert (faces, lines) == (12, 12)
    numbers = np.frombuffer(model.display_bytes[8:], "<f4")
    shown, normals, colors = numbers[: 27 * faces].reshape(3, faces, 3, 3)
    np.testing.assert_allclose(model.from_display(shown), model.scene.triangles, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-6)
    assert len(np.unique(colors)) == 1
    edges = numbers[27 * faces :].reshape(lines, 2, 3)
    np.testing.assert_allclose(model.from_display(edges), model.wireframe.creases, atol=1e-6)


@pytest.mark.long
def test_half_a_million_faces_are_shown_decimated_and_picked_exactly() -> None:
    mesh = sphere(500, dent=0.1)
    assert len(mesh.faces) == 500_000
    model = ClickableModel(mesh)
    shown = np.frombuffer(model.display_bytes[:4], "<u4")[0]
    assert 75_000 < shown <= 150_000
    rng = np.random.default_rng(1)
    for face in rng.integers(0, 500_000, 50).tolist():
        target = mesh.vertices[mesh.faces[face]].mean(axis=0)
        outwards = target - model.center
        point = model.pick(model.center + 4 * outwards, -outwards)
        assert point is not None
        assert np.linalg.norm(point.xyz - target) < 1e-4 * model.diagonal


# --- the lines over the photo ----------------------------------------------------------------

CAMERA = Camera.from_fov(640, 480, fov_x=50.0)


def test_wireframe_shows_the_edges_that_are_seen() -> None:
    model = ClickableModel(box_mesh())
    turn = np.array([[0.8, 0, 0.6], [0.36, 0.8, -0.48], [-0.48, 0.6, 0.64]])
    alignment = Alignment(turn, [0, -0.5, 9], [1, 1.2, 0.7])
    lines = model.wireframe.project(CAMERA, alignment)
    assert lines.shape[1:] == (2, 2)
    corners = CAMERA.project(alignment.apply(model.scene.mesh.vertices))
    # One corner of a box and three edges are hidden.
    gaps = np.linalg.norm(corners[:, None] - lines.reshape(-1, 2), axis=2).min(axis=1)
    assert (gaps < 1e-6).sum() == 7
    edges = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum()
    whole = box_lines(model.scene.bounds, CAMERA, alignment)
    all_edges = np.linalg.norm(whole[:, 1] - whole[:, 0], axis=1).sum()
    assert 0.6 < edges / all_edges < 0.9


def test_wireframe_shows_the_outline_of_smooth_models() -> None:
    model = ClickableModel(sphere(40))
    alignment = Alignment(np.eye(3), [-3, 1, 4], [1, 1, 1])  # the sphere's centre at depth 6
    lines = model.wireframe.project(CAMERA, alignment)
    assert len(lines) > 40
    ends = CAMERA.normalize(lines.reshape(-1, 2))
    angle = np.arctan(np.linalg.norm(ends, axis=1))
    assert np.median(angle) == pytest.approx(np.arcsin(1 / 6), rel=0.03)


def test_lines_behind_the_camera_are_left_out() -> None:
    model = ClickableModel(box_mesh())
    behind = Alignment(np.eye(3), [0, 0, -9], [1, 1, 1])
    assert model.wireframe.project(CAMERA, behind).shape == (0, 2, 2)
    assert box_lines(model.scene.bounds, CAMERA, behind).shape == (0, 2, 2)
