"""Rotations: conversions between representations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cadalign.errors import InputError
from cadalign.geometry.rotations import (
    quat_wxyz_from_rotation,
    rotation_from_quat_wxyz,
    rotation_from_vector,
    spread_rotations,
)

vectors = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


@given(vector=vectors, length=st.floats(1e-3, 1e3))
def test_quaternions_of_any_length_round_trip(vector, length) -> None:
    rotation = rotation_from_vector(vector)
    quaternion = quat_wxyz_from_rotation(rotation)
    assert quaternion[0] >= 0
    np.testing.assert_allclose(rotation_from_quat_wxyz(length * quaternion), rotation, atol=1e-12)


@given(vector=vectors)
def test_rotation_keeps_its_axis_and_is_orthonormal(vector) -> None:
    rotation = rotation_from_vector(vector)
    np.testing.assert_allclose(rotation @ vector, vector, atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)


@pytest.mark.parametrize("quaternion", [np.zeros(4), np.array([np.nan, 0, 0, 1])])
def test_quaternion_without_direction_is_refused(quaternion) -> None:
    with pytest.raises(InputError, match=r"quaternion: .* is not a rotation"):
        rotation_from_quat_wxyz(quaternion)


@pytest.mark.parametrize("count", [60, 500])
def test_spread_rotations_are_evenly_spaced(count: int) -> None:
    rotations = spread_rotations(count)
    traces = np.einsum("aij,bij->ab", rotations, rotations)
    angles = np.arccos(np.clip((traces - 1) / 2, -1, 1))
    nearest = np.sort(angles, axis=1)[:, 1]
    assert nearest.max() < 1.6 * nearest.min()
    # That many balls of this radius have about the volume of all rotations.
    assert count * (nearest.min() - np.sin(nearest.min())) / np.pi > 0.8
