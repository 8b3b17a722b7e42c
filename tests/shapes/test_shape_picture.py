"""The picture of a shape model: the skeleton holds the spanning tree, any model is drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from cadalign.errors import DataError
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.outputs import draw_shape, neighbour_pairs


@given(st.integers(0, 2**32 - 1), st.integers(2, 25))
def test_the_skeleton_holds_the_minimum_spanning_tree(seed: int, count: int) -> None:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    gaps = np.linalg.norm(points[:, None] - points, axis=2)
    tree = np.argwhere(minimum_spanning_tree(gaps).toarray() > 0)
    pairs = set(map(tuple, neighbour_pairs(points).tolist()))
    assert {(min(a, b), max(a, b)) for a, b in tree.tolist()} <= pairs
    graph = np.zeros((count, count))
    graph[tuple(np.transpose(sorted(pairs)))] = 1
    assert connected_components(graph)[0] == 1


def test_a_name_of_no_picture_is_refused(tmp_path: Path) -> None:
    model = ShapeModel.from_basis(np.eye(4, 3), np.ones((1, 4, 3)), [0.1])
    with pytest.raises(DataError, match="is no picture's name"):
        draw_shape(tmp_path / "picture.xyz", model)


@pytest.mark.long
@pytest.mark.parametrize(("up_axis", "modes"), [("x", 0), ("z", 1), (None, 6)])
def test_a_picture_is_drawn(tmp_path: Path, up_axis: str | None, modes: int) -> None:
    rng = np.random.default_rng(0)
    model = ShapeModel.from_basis(
        rng.normal(size=(5, 3)),
        rng.normal(size=(modes, 5, 3)),
        np.full(modes, 0.1),
        up_axis=up_axis,  # type: ignore[arg-type]
    )
    draw_shape(tmp_path / "picture.png", model)
    with Image.open(tmp_path / "picture.png") as picture:
        assert picture.width > 400
        assert np.ptp(np.asarray(picture.convert("L"))) > 100
