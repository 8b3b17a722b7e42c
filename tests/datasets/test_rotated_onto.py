"""Rotations that map points onto one another: not those that leave them where they are."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cadalign.datasets.models.rotated_onto import rotations_onto_themselves

SQUARE = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_quarter_turns_of_a_square_alone(axis: str) -> None:
    angles = [[0], [45], [90], [100], [180]]
    turns = Rotation.from_euler(axis, angles, degrees=True).as_matrix()
    square = 3.0 * np.roll(SQUARE, "zxy".index(axis), axis=1)
    alike = np.ones((4, 4), dtype=bool)
    found = rotations_onto_themselves(square, alike, np.ascontiguousarray(turns), 1e-6, 0.1)
    assert found.tolist() == [False, False, True, False, True]


def test_points_of_another_kind_take_no_place() -> None:
    turn = Rotation.from_euler("z", [[90]], degrees=True).as_matrix()
    kinds = np.array([0, 1, 0, 1])
    alike = kinds[:, None] == kinds
    found = rotations_onto_themselves(SQUARE, alike, np.ascontiguousarray(turn), 1e-6, 0.1)
    assert not found.any()
