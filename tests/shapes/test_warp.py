"""Warping: exact keypoints, identity, stretches and degenerate keypoints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.refusals import refusal_text

from cadalign.arrays import FloatArray
from cadalign.datasets import KeypointNet
from cadalign.geometry.mesh import Mesh
from cadalign.shapes.warp import warp_mesh

CORNERS = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)], dtype=float)
CUBE = Mesh(CORNERS, np.array([[i, (i + 1) % 8, (i + 3) % 8] for i in range(8)]))


STILL = {"bounds": [[0, 0, 0], [1, 1, 1]]}


def keypoints(seed: int, count: int) -> FloatArray:
    return np.random.default_rng(seed).uniform(0, 1, (count, 3))


def add_vertices(points: FloatArray) -> Mesh:
    """Add vertices at points to the cube."""
    rows = 8 + np.arange(len(points))
    faces = np.vstack([CUBE.faces, np.column_stack([rows, rows, rows])])
    return Mesh(np.vstack([CORNERS, points]), faces)


@given(st.integers(0, 2**32 - 1), st.integers(1, 20), st.floats(0.001, 0.5))
def test_keypoints_move_to_their_targets(seed: int, count: int, moved: float) -> None:
    source = keypoints(seed, count)
    target = source + np.random.default_rng(seed + 1).normal(0, moved, source.shape)
    warped = warp_mesh(add_vertices(source), source, target, **STILL)
    assert warped.vertices[8:] == pytest.approx(target, abs=1e-6)


@given(st.integers(0, 2**32 - 1), st.integers(1, 12))
def test_fixed_keypoints_give_the_identity(seed: int, count: int) -> None:
    source = keypoints(seed, count)
    assert warp_mesh(CUBE, source, source, **STILL).vertices == pytest.approx(CORNERS, abs=1e-9)


def test_a_stretch_of_many_keypoints_stretches_the_mesh() -> None:
    stretch = np.array([1, 2, 0.5])
    warped = warp_mesh(CUBE, CORNERS, CORNERS * stretch, bounds=[[0, 0, 0], stretch])
    assert warped.vertices == pytest.approx(CORNERS * stretch, abs=1e-9)


def test_the_mesh_about_fills_the_bounds() -> None:
    centre = np.array([[0.5, 0.5, 0.5]])
    warped = warp_mesh(CUBE, centre, [[1, 1, 1]], bounds=[[0, 0, 0], [2, 2, 2]])
    assert warped.bounds == pytest.approx(np.array([[0, 0, 0], [2, 2, 2]]), abs=1e-9)


@pytest.mark.parametrize("axes", [[1, 1, 0], [1, 0, 0], [0, 0, 0]])
def test_keypoints_in_a_plane_a_line_or_a_point(axes: list[int]) -> None:
    source = keypoints(0, 6) * axes
    target = source + keypoints(1, 6) * axes * 0.1 + 0.1
    warped = warp_mesh(add_vertices(source), source, target, **STILL)
    expected = target if any(axes) else np.full_like(target, 0.1)
    assert warped.vertices[8:] == pytest.approx(expected, abs=1e-6)
    assert np.abs(warped.vertices[:8] - CORNERS).max() < 0.5


def test_coincident_keypoints_move_to_the_mean_of_their_targets() -> None:
    source = np.vstack([keypoints(0, 4), keypoints(0, 1)])
    target = source.copy()
    target[0, 0] += 0.1
    warped = warp_mesh(add_vertices(source), source, target, **STILL)
    assert warped.vertices[8] == pytest.approx(source[0] + [0.05, 0, 0], abs=1e-6)


def test_near_keypoints_that_move_apart_do_not_overshoot() -> None:
    source = np.array([[0.5, 0.5, 0.5], [0.51, 0.5, 0.5], [0, 0, 0], [1, 1, 1]])
    target = source + [[-0.05, 0, 0], [0.05, 0, 0], [0, 0, 0], [0, 0, 0]]
    moved = warp_mesh(CUBE, source, target, **STILL).vertices - CORNERS
    assert np.abs(moved).max() < 0.05


def test_colours_and_faces_are_kept() -> None:
    colored = Mesh(CORNERS, CUBE.faces, vertex_colors=np.full((8, 4), 0.5))
    warped = warp_mesh(colored, CORNERS[:4], CORNERS[:4] * 2, **STILL)
    assert warped.vertex_colors is colored.vertex_colors
    assert (warped.faces == colored.faces).all()


def test_refusals() -> None:
    def refused(source: FloatArray, target: FloatArray, **bounds: Any) -> str:
        return refusal_text(lambda: warp_mesh(CUBE, source, target, **(STILL | bounds)))

    assert refused(np.zeros((0, 3)), np.zeros((0, 3))) == "source: no keypoints"
    assert refused(CORNERS, CORNERS[:3]) == "target: shape (3, 3), expected (8, 3)"
    assert "target: NaN" in refused(CORNERS, CORNERS * np.nan)
    assert refused(CORNERS, CORNERS, bounds=[[1, 0, 0], [0, 1, 1]]).startswith("bounds: the least")


@pytest.mark.slow
def test_a_real_chair_is_warped_to_another_without_folds(real_data: Path) -> None:
    chairs = KeypointNet(real_data / "keypointnet")["chair"]
    model = next(each for each in chairs if each.mesh_path is not None)
    mesh = model.load_mesh()
    low, high = mesh.bounds
    grid = np.stack(np.meshgrid(*np.linspace(low, high, 8).T, indexing="ij"), axis=-1)
    cloud = add_vertices(grid.reshape(-1, 3))
    for other in chairs[:40:8]:
        ids, mine, theirs = np.intersect1d(
            model.keypoints.ids, other.keypoints.ids, return_indices=True
        )
        assert len(ids) >= 6
        source, target = model.keypoints.xyz[mine], other.keypoints.xyz[theirs]
        bounds = [target.min(axis=0), target.max(axis=0)]
        moved = warp_mesh(cloud, source, target, bounds=bounds).vertices[8:].reshape(grid.shape)
        sides = [np.diff(moved, axis=axis)[:7, :7, :7] for axis in range(3)]
        volumes = np.linalg.det(np.stack(sides, axis=-1))
        assert (volumes > 0).mean() > 0.99
        assert np.isfinite(warp_mesh(mesh, source, target, bounds=bounds).vertices).all()
