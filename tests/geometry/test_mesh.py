"""Mesh: bounds, surface points and validation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cadalign import Mesh
from cadalign.errors import DataError, InputError

# A square cut into two triangles (face 0 of the file), and a triangle (face 1).
VERTICES = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 2], [9, 9, 9.0]])
FACES = np.array([[0, 1, 2], [0, 2, 3], [0, 1, 4]])
POLYGON = np.array([0, 0, 1])
MESH = Mesh(VERTICES, FACES, POLYGON, source="house.obj")


def test_bounds_ignore_unused_vertices() -> None:
    assert MESH.bounds.tolist() == [[0, 0, 0], [1, 1, 2]]


def test_triangles_are_the_corners_in_file_order() -> None:
    assert MESH.triangles.shape == (3, 3, 3)
    assert MESH.triangles[2].tolist() == [[0, 0, 0], [1, 0, 0], [0, 0, 2]]


def test_faces_are_numbered_by_default() -> None:
    mesh = Mesh(VERTICES, FACES)
    assert mesh.polygon.tolist() == [0, 1, 2]
    assert mesh.face_material.tolist() == [0, 0, 0]


def test_surface_points_use_face_numbers_of_the_file() -> None:
    corners = np.eye(3)
    assert MESH.surface_points([1, 1, 1], corners).tolist() == MESH.triangles[2].tolist()
    assert MESH.surface_points([0, 0, 0], corners).tolist() == MESH.triangles[0].tolist()


@given(seed=st.integers(0, 2**32 - 1), total=st.floats(0.5, 2.0))
def test_surface_points_do_not_depend_on_the_sum_of_weights(seed: int, total: float) -> None:
    weights = np.random.default_rng(seed).dirichlet(np.ones(3), 4)
    face = [0, 1, 1, 0]
    expected = MESH.surface_points(face, weights)
    np.testing.assert_allclose(MESH.surface_points(face, total * weights), expected, atol=1e-12)


@given(seed=st.integers(0, 2**32 - 1))
def test_surface_points_move_with_the_stretch(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scale, weights = rng.uniform(0.2, 3, 3), rng.dirichlet(np.ones(3), 5)
    face = rng.integers(0, 2, 5)
    stretched = MESH.stretch(scale)
    np.testing.assert_allclose(
        stretched.surface_points(face, weights), MESH.surface_points(face, weights) * scale
    )
    np.testing.assert_allclose(stretched.bounds, MESH.bounds * scale)
    assert (stretched.faces == MESH.faces).all()
    assert stretched.source == MESH.source


@pytest.mark.parametrize("number", [2, 7, -1])
def test_surface_points_refuse_missing_faces(number: int) -> None:
    with pytest.raises(InputError) as caught:
        MESH.surface_points([0, number], np.full((2, 3), 1 / 3))
    assert str(caught.value) == (
        f"face_index: face {number} is not in house.obj, which has faces 0 to 1"
    )


def test_closest_points_are_nearer_than_other_surface_points() -> None:
    rng = np.random.default_rng(0)
    samples = rng.dirichlet((1, 1, 1), size=(3, 700))
    for _ in range(40):
        mesh = Mesh(rng.normal(size=(9, 3)), np.arange(9).reshape(3, 3))
        points = 2 * rng.normal(size=(2, 3))
        face, weights = mesh.closest(points)
        assert weights.min() >= 0
        np.testing.assert_allclose(weights.sum(axis=1), 1.0)
        found = np.linalg.norm(mesh.surface_points(face, weights) - points, axis=1)
        others = (samples @ mesh.triangles).reshape(-1, 1, 3) - points
        best = np.linalg.norm(others, axis=2).min(axis=0)
        assert (found <= best + 1e-12).all()
        assert (found >= best - 0.3).all()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (
            {"vertices": VERTICES, "faces": np.empty((0, 3), int)},
            "house.obj: the mesh has no faces",
        ),
        (
            {"vertices": VERTICES[:, :2], "faces": FACES},
            "house.obj: vertices (6, 2) and faces (3, 3) are not a triangle mesh",
        ),
        (
            {"vertices": VERTICES, "faces": [[0, 1, 2, 3]]},
            "house.obj: vertices (6, 3) and faces (1, 4) are not a triangle mesh",
        ),
        (
            {"vertices": VERTICES * [1, np.nan, 1], "faces": FACES},
            "house.obj: the mesh has NaN or infinite vertices",
        ),
        (
            {"vertices": VERTICES, "faces": [[0, 1, 6]]},
            "house.obj: a face names vertex 6, but there are 6; the file is cut short or damaged",
        ),
        (
            {"vertices": VERTICES, "faces": FACES, "polygon": np.array([0, 1])},
            "house.obj: polygon has shape (2,), not (3,)",
        ),
        (
            {"vertices": VERTICES, "faces": FACES, "vertex_colors": np.ones((6, 3))},
            "house.obj: vertex_colors has shape (6, 3), not (6, 4)",
        ),
        (
            {"vertices": VERTICES, "faces": FACES, "corner_uv": np.ones((3, 2))},
            "house.obj: corner_uv has shape (3, 2), not (3, 3, 2)",
        ),
    ],
)
def test_mesh_refuses_wrong_arrays(arguments: dict[str, Any], text: str) -> None:
    with pytest.raises(DataError) as caught:
        Mesh(**arguments, source="house.obj")
    assert str(caught.value) == text


def test_mesh_names_a_negative_vertex() -> None:
    with pytest.raises(DataError, match="a face names vertex -1, but there are 6"):
        Mesh(VERTICES, [[0, 1, -1]], source="house.obj")
