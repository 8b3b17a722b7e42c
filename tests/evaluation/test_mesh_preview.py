"""Mesh previews: simplified models with recognisable shapes."""

from __future__ import annotations

import base64
import json
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cadalign import Mesh
from cadalign.evaluation.instances.pictures import preview_of

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


def cube() -> Mesh:
    faces = [(q[0], q[a], q[a + 1]) for q in QUADS for a in (1, 2)]
    return Mesh(CUBE, np.array(faces))


def sphere(rings: int, *, squash: float = 1.0) -> Mesh:
    latitude, longitude = np.mgrid[0 : rings + 1, 0 : 2 * rings]
    theta, phi = np.pi * latitude / rings, np.pi * longitude / rings
    points = np.stack(
        [np.sin(theta) * np.cos(phi), squash * np.cos(theta), np.sin(theta) * np.sin(phi)], axis=-1
    ).reshape(-1, 3)
    number = np.arange(len(points)).reshape(rings + 1, 2 * rings)
    a, b = number[:-1], np.roll(number[:-1], -1, axis=1)
    c, d = number[1:], np.roll(number[1:], -1, axis=1)
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)]).reshape(-1, 3)
    return Mesh(points, faces)


def preview_of_mesh(mesh: Mesh, **most: int) -> SimpleNamespace:
    """Vertices, faces and edges of a mesh's preview, decoded from JSON."""
    data = json.loads(json.dumps(preview_of(mesh, **most)))
    index = "<u4" if data["wide"] else "<u2"
    counts = np.frombuffer(base64.b64decode(data["vertices"]), "<u2").reshape(-1, 3)
    return SimpleNamespace(
        vertices=np.array(data["lo"]) + counts * data["step"],
        faces=np.frombuffer(base64.b64decode(data["faces"]), index).reshape(-1, 3),
        edges=np.frombuffer(base64.b64decode(data["edges"]), index).reshape(-1, 2),
    )


def test_a_small_mesh_is_unchanged_and_its_creases_are_edges() -> None:
    preview = preview_of_mesh(cube())
    assert len(preview.faces) == 12
    assert len(preview.vertices) == 8
    assert len(preview.edges) == 12
    lengths = np.linalg.norm(np.diff(preview.vertices[preview.edges], axis=1), axis=2)
    np.testing.assert_allclose(lengths, 1, atol=1e-4)  # no diagonals


@pytest.mark.long
@given(rings=st.integers(5, 60), squash=st.floats(0.01, 3.0), most=st.integers(8, 2000))
def test_there_are_never_more_triangles_or_lines_than_asked_for(
    rings: int, squash: float, most: int
) -> None:
    mesh = sphere(rings, squash=squash)
    preview = preview_of_mesh(mesh, max_faces=most, max_edges=most)
    assert len(preview.faces) <= most
    assert len(preview.edges) <= most
    assert np.isfinite(preview.vertices).all()
    for corners in (preview.faces, preview.edges):
        assert corners.min(initial=0) >= 0
        assert corners.max(initial=0) < len(preview.vertices)
    if most > 300:  # means of cells stay within a cell of the surface
        size = np.linalg.norm(np.ptp(mesh.bounds, axis=0))
        found = np.array([preview.vertices.min(axis=0), preview.vertices.max(axis=0)])
        assert np.abs(found - mesh.bounds).max() < 0.1 * size


def test_a_mast_thinner_than_a_cell_becomes_a_line() -> None:
    hull = sphere(60)
    mast = (CUBE - 0.5) * [1e-3, 3.0, 1e-3] + [0, 2.4, 0]
    faces = np.concatenate([hull.faces, cube().faces + len(hull.vertices)])
    mesh = Mesh(np.concatenate([hull.vertices, mast]), faces)
    preview = preview_of_mesh(mesh)
    assert preview.vertices[:, 1].max() > 3.8
    top = int(preview.vertices[:, 1].argmax())
    assert (preview.edges == top).any()


def test_degenerate_faces_are_harmless() -> None:
    point = Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    preview = preview_of_mesh(point)
    assert len(preview.faces) == len(preview.edges) == 0


@pytest.mark.long
@pytest.mark.parametrize("rings", [20, 200])
def test_json_holds_the_same_to_16_bits(rings: int) -> None:
    mesh = sphere(rings)
    preview = preview_of_mesh(mesh, max_faces=200_000)
    assert (len(preview.vertices) > 65536) == (rings == 200)
    found = preview.vertices[preview.faces].mean(axis=(0, 1))
    np.testing.assert_allclose(np.linalg.norm(preview.vertices, axis=1), 1, atol=2e-4)
    np.testing.assert_allclose(found, 0, atol=2e-2)
