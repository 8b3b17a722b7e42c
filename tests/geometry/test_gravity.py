"""The up direction in a camera's frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cadalign import Camera
from cadalign.errors import InputError
from cadalign.geometry.conventions import (
    up_from_gravity,
    up_from_pitch_roll,
    up_from_pose,
    up_from_vertical_edges,
)

CAMERA = Camera(640, 480, 700, 720, 319.5, 239.5)
ANGLES = st.floats(-80, 80)


def edge_of(up: np.ndarray, base: np.ndarray) -> np.ndarray:
    return CAMERA.project(np.stack([base, base + 0.8 * up]))


@given(pitch=ANGLES, roll=st.floats(-180, 180))
def test_the_viewing_direction_rises_by_the_pitch(pitch: float, roll: float) -> None:
    up = up_from_pitch_roll(pitch, roll)
    assert np.isclose(np.linalg.norm(up), 1)
    assert np.isclose(up[2], np.sin(np.radians(pitch)))
    turn = Rotation.from_euler("z", -roll, degrees=True)
    assert np.allclose(turn.apply(up_from_pitch_roll(pitch)), up)


@given(seed=st.integers(0, 1000))
def test_a_pose_and_the_gravity_seen_from_it_agree(seed: int) -> None:
    world_from_cam = Rotation.random(random_state=seed).as_matrix()
    up = up_from_pose(world_from_cam, world_up=[0, 0, 1])
    gravity = world_from_cam.T @ [0, 0, -9.81]
    assert np.allclose(up, up_from_gravity(gravity))
    flip = np.diag([1.0, -1.0, -1.0])
    in_opengl = up_from_pose(world_from_cam @ flip, world_up=[0, 0, 1], axes="opengl")
    assert np.allclose(up, in_opengl)


@settings(max_examples=50)
@given(pitch=st.floats(-40, 40), roll=st.floats(-40, 40), seed=st.integers(0, 1000))
def test_vertical_edges_meet_in_the_up_direction(pitch: float, roll: float, seed: int) -> None:
    up = up_from_pitch_roll(pitch, roll)
    rng = np.random.default_rng(seed)
    bases = [np.array([x, 0.3, 4.0]) + 0.1 * rng.normal(size=3) for x in (-1.2, 1.2)]
    edges = [edge_of(up, base)[:: rng.choice([-1, 1])] for base in bases]
    found, covariance = up_from_vertical_edges(CAMERA, edges, pitch_sigma_deg=1e6)
    assert np.allclose(found, up, atol=1e-5)
    assert np.allclose(covariance @ found, 0, atol=1e-6 * covariance.max())


@settings(max_examples=50)
@given(pitch=st.floats(-40, 40), roll=st.floats(-40, 40))
def test_one_edge_tells_the_direction_across_its_plane(pitch: float, roll: float) -> None:
    up = up_from_pitch_roll(pitch, roll)
    found, covariance = up_from_vertical_edges(CAMERA, edge_of(up, np.array([0.2, 0.5, 3.0])))
    error = np.degrees(up - found * (up @ found))
    assert error @ np.linalg.pinv(covariance, rcond=1e-9) @ error < 6


@pytest.mark.long
def test_the_deviation_of_two_edges_is_that_of_their_errors() -> None:
    up, rng = up_from_pitch_roll(-15, 5), np.random.default_rng(0)
    exact = np.array([edge_of(up, np.array([x, 0.3, 4.0])) for x in (-1.2, 1.3)])
    squares = []
    for _ in range(300):
        clicks = exact + rng.normal(0, 1, exact.shape)
        found, covariance = up_from_vertical_edges(CAMERA, clicks, pitch_sigma_deg=1e4)
        error = np.degrees(up - found)
        squares.append(error @ np.linalg.pinv(covariance, rcond=1e-9) @ error)
    assert 1.7 < np.mean(squares) < 2.3  # a chi-square of two


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: up_from_gravity([0, 0, 0]), "gravity: a direction must not be zero"),
        (lambda: up_from_gravity([0, 1, 0], axes="x"), "axes: unknown axes 'x'"),
        (lambda: up_from_pose(2 * np.eye(4)), "world_from_cam: not a rotation"),
        (lambda: up_from_pitch_roll(float("nan")), "pitch_deg: nan is not an angle"),
        (
            lambda: up_from_vertical_edges(CAMERA, [[1, 2], [1, 2]]),
            "edges[0]: its two pixels coincide",
        ),
    ],
)
def test_bad_input_is_named(call: Any, message: str) -> None:
    with pytest.raises(InputError) as caught:
        call()
    assert str(caught.value).startswith(message)
