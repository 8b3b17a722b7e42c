"""Meshes as trimesh's: geometry, colours and textures."""

from __future__ import annotations

import numpy as np

from cadalign import Material, Mesh

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])
UV = SQUARE[FACES][..., :2]
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


def test_texture_is_kept_with_its_coordinates() -> None:
    texture = np.random.default_rng(0).integers(0, 255, (8, 8, 3), dtype=np.uint8)
    white = (1.0, 1.0, 1.0, 1.0)
    mesh = Mesh(SQUARE, FACES, corner_uv=UV, materials=(Material("a", white, texture),))
    found = mesh.to_trimesh()
    np.testing.assert_array_equal(found.triangles, mesh.triangles)
    np.testing.assert_array_equal(found.visual.uv, UV.reshape(-1, 2))
    image = np.asarray(found.visual.material.baseColorTexture)
    np.testing.assert_array_equal(image[..., :3], texture)


def test_textures_and_colours_share_one_image() -> None:
    texture = np.full((8, 8, 3), 200, dtype=np.uint8)
    white = (1.0, 1.0, 1.0, 1.0)
    mesh = Mesh(
        SQUARE,
        FACES,
        corner_uv=UV,
        materials=(Material("a", white, texture), Material("b", RED)),
        face_material=np.array([0, 1]),
    )
    found = mesh.to_trimesh()
    colors = found.visual.to_color().vertex_colors.reshape(2, 3, 4)
    assert colors[0, :, :3].tolist() == [[200] * 3] * 3
    assert colors[1, :, :3].tolist() == [[255, 0, 0]] * 3
