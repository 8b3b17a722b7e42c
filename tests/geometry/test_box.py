"""Oriented boxes: corners, edges, and the box of a stretched model."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cadalign import Alignment, Box
from cadalign.errors import InputError
from cadalign.evaluation.simulation import random_rotation
from cadalign.geometry.alignment import BOX_EDGES

SEEDS = st.integers(0, 2**32 - 1)


def random_alignment(rng: np.random.Generator) -> Alignment:
    return Alignment(random_rotation(rng), rng.uniform(-3, 3, 3), rng.uniform(0.2, 4, 3))


def random_bounds(rng: np.random.Generator) -> np.ndarray:
    low = rng.uniform(-2, 2, 3)
    return np.array([low, low + rng.uniform(0.1, 3, 3)])


def test_corners_of_a_box_along_the_axes() -> None:
    box = Box([1, 2, 3], np.eye(3), [2, 4, 6])
    expected = [[x, y, z] for z in (0, 6) for y in (0, 4) for x in (0, 2)]
    assert box.corners.tolist() == expected
    assert box.volume == 48


@given(seed=SEEDS)
def test_corners_are_the_aligned_corners_of_the_model(seed: int) -> None:
    rng = np.random.default_rng(seed)
    alignment, bounds = random_alignment(rng), random_bounds(rng)
    corners = np.array([[bounds[i >> k & 1, k] for k in range(3)] for i in range(8)])
    box = Box.from_model(bounds, alignment)
    np.testing.assert_allclose(box.corners, alignment.apply(corners), rtol=0, atol=1e-12)
    assert box.volume == pytest.approx(np.prod(alignment.scale) * np.prod(bounds[1] - bounds[0]))


@given(seed=SEEDS)
def test_edges_are_twelve_four_along_each_axis(seed: int) -> None:
    rng = np.random.default_rng(seed)
    box = Box.from_model(random_bounds(rng), random_alignment(rng))
    assert len(set(BOX_EDGES)) == 12
    for number, (start, end) in enumerate(BOX_EDGES):
        axis = number // 4
        edge = box.corners[end] - box.corners[start]
        expected = box.extents[axis] * box.rotation[:, axis]
        np.testing.assert_allclose(edge, expected, rtol=0, atol=1e-12)


def test_arrays_are_read_only_copies() -> None:
    center = np.zeros(3)
    box = Box(center, np.eye(3), np.ones(3))
    center[0] = 9.0
    assert box.center[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        box.extents[0] = 2.0


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (([0, 0], np.eye(3), [1, 1, 1]), "center: shape (2,), expected (3)"),
        (
            ([0, 0, 0], np.ones((3, 3)), [1, 1, 1]),
            "rotation: not a rotation matrix; its rows must be orthonormal and its determinant +1",
        ),
        (([0, 0, 0], np.eye(3), [1, -1, 1]), "extents: [1.0, -1.0, 1.0] is negative"),
    ],
)
def test_box_refuses_wrong_values(arguments: tuple[Any, ...], text: str) -> None:
    with pytest.raises(InputError) as caught:
        Box(*arguments)
    assert str(caught.value) == text


@pytest.mark.parametrize(
    ("bounds", "text"),
    [
        ([[0, 0, 0]], "bounds: shape (1, 3), expected (2, 3)"),
        ([[0, 0, 0], [1, -1, 1]], "extents: [1.0, -1.0, 1.0] is negative"),
    ],
)
def test_from_model_refuses_wrong_bounds(bounds: Any, text: str) -> None:
    with pytest.raises(InputError) as caught:
        Box.from_model(bounds, Alignment.identity())
    assert str(caught.value) == text
