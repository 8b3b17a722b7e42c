"""Grid clustering and mesh edges, also of triangle soups with any orientation."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from cadalign import Mesh
from cadalign.geometry.simplify import cluster, mesh_edges, number_rows, simplify


def soup(mesh: trimesh.Trimesh, *, seed: int = 0) -> Mesh:
    """Split a mesh into separate triangles with rounding errors, half of them reversed."""
    rng = np.random.default_rng(seed)
    corners = np.array(mesh.triangles)
    turned = rng.random(len(corners)) < 0.5
    corners[turned] = corners[turned][:, ::-1]
    vertices = corners.reshape(-1, 3) + rng.uniform(-1e-9, 1e-9, (3 * len(corners), 3))
    return Mesh(vertices, np.arange(len(vertices)).reshape(-1, 3))


def test_clustering_welds_a_triangle_soup() -> None:
    box = trimesh.creation.box((1, 2, 3))
    doubled = soup(trimesh.util.concatenate([box, box]))
    welded = cluster(doubled, cells=1e4)
    assert len(welded.vertices) == 8
    assert len(welded.faces) == 12
    assert not len(welded.wires)
    np.testing.assert_allclose(
        doubled.triangles[welded.source].mean(axis=1),
        welded.vertices[welded.faces].mean(axis=1),
        atol=1e-8,
    )


def test_creases_of_a_box_are_its_twelve_edges() -> None:
    welded = cluster(soup(trimesh.creation.box((1, 2, 3))), cells=1e4)
    edges = mesh_edges(welded.vertices, welded.faces, crease_angle=30)
    assert len(edges.ends) == 18  # and six diagonals
    lengths = np.linalg.norm(np.diff(welded.vertices[edges.ends[edges.creased]], axis=1), axis=2)
    assert sorted(np.round(lengths.ravel(), 6).tolist()) == [1.0] * 4 + [2.0] * 4 + [3.0] * 4


def test_borders_and_edges_of_three_triangles_are_creases() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0.5, -2, 0]])
    faces = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    edges = mesh_edges(vertices, faces, crease_angle=30)
    assert edges.creased.all()
    assert len(edges.ends) == 7


def test_opposite_vertices_are_those_of_both_triangles() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    edges = mesh_edges(np.array(ball.vertices), np.array(ball.faces), crease_angle=60)
    assert not edges.creased.any()
    known = {tuple(sorted(face)) for face in ball.faces.tolist()}
    for ends, opposite in zip(edges.ends.tolist(), edges.opposite.tolist(), strict=True):
        assert opposite[0] != opposite[1]
        assert all(tuple(sorted((*ends, third))) in known for third in opposite)


@pytest.mark.parametrize("most", [20, 300, 3000])
def test_simplification_is_near_the_maximum_and_the_surface(most: int) -> None:
    ball = trimesh.creation.icosphere(subdivisions=5)
    mesh = Mesh(np.array(ball.vertices), np.array(ball.faces))
    small = simplify(mesh, max_faces=most)
    assert 0.4 * most < len(small.faces) <= most
    assert len(np.unique(np.sort(small.faces, axis=1), axis=0)) == len(small.faces)
    radius = np.linalg.norm(small.vertices[small.faces], axis=2)
    assert 1 - 8 / most < radius.min()
    assert radius.max() < 1.001
    gaps = mesh.triangles[small.source].mean(axis=1) - small.vertices[small.faces].mean(axis=1)
    assert np.linalg.norm(gaps, axis=1).max() < 5 / np.sqrt(most)  # each lies where its source does


def test_a_fan_that_no_grid_simplifies_keeps_triangles() -> None:
    """All but one vertex share a cell of any grid, so no clustering leaves a triangle."""
    vertices = np.concatenate([[[1e9, 0, 0]], np.random.default_rng(0).uniform(0, 1, (30, 3))])
    faces = np.array([[1, k, k + 1] for k in range(2, 30)])
    vertices[1:, 1:] *= np.linspace(1, 2, 30)[:, None]
    faces = np.concatenate([faces, [[0, 1, 2]]])
    small = simplify(Mesh(vertices, faces), max_faces=3)
    assert 1 <= len(small.faces) <= 3


def test_equal_rows_have_one_number() -> None:
    rows = np.array([[0.0, 1, 2], [3, 4, 5], [-0.0, 1, 2], [3, 4, 6]])
    numbers = number_rows(rows)
    assert numbers[0] == numbers[2]
    assert len(set(numbers.tolist())) == 3
