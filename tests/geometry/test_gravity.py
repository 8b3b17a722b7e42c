"""The up direction in a camera's frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cadalign.errors import InputError
from cadalign.geometry.conventions import up_from_gravity, up_from_pose


@given(seed=st.integers(0, 1000))
def test_a_pose_and_the_gravity_seen_from_it_agree(seed: int) -> None:
    world_from_cam = Rotation.random(random_state=seed).as_matrix()
    up = up_from_pose(world_from_cam, world_up=[0, 0, 1])
    gravity = world_from_cam.T @ [0, 0, -9.81]
    assert np.allclose(up, up_from_gravity(gravity))
    flip = np.diag([1.0, -1.0, -1.0])
    in_opengl = up_from_pose(world_from_cam @ flip, world_up=[0, 0, 1], axes="opengl")
    assert np.allclose(up, in_opengl)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: up_from_gravity([0, 0, 0]), "gravity: a direction must not be zero"),
        (lambda: up_from_gravity([0, 1, 0], axes="x"), "axes: unknown axes 'x'"),
        (lambda: up_from_pose(2 * np.eye(4)), "world_from_cam: not a rotation"),
    ],
)
def test_bad_input_is_named(call: Any, message: str) -> None:
    with pytest.raises(InputError) as caught:
        call()
    assert str(caught.value).startswith(message)
