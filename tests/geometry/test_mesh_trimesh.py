"""Meshes as trimesh's: geometry and colours."""

from __future__ import annotations

import numpy as np

from cadalign import Material, Mesh

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])
RED, BLUE = (1.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 1.0)


def test_materials_colour_their_faces() -> None:
    mesh = Mesh(
        SQUARE,
        FACES,
        materials=(Material("a", RED), Material("b", BLUE)),
        face_material=np.array([1, 0]),
    )
    found = mesh.to_trimesh()
    assert found.visual.face_colors.tolist() == [[0, 0, 255, 255], [255, 0, 0, 255]]
    np.testing.assert_array_equal(found.faces, FACES)


def test_vertex_colours_are_kept() -> None:
    mesh = Mesh(SQUARE, FACES, vertex_colors=np.array([RED, BLUE, RED, BLUE]))
    assert mesh.to_trimesh().visual.vertex_colors[1].tolist() == [0, 0, 255, 255]
