"""Poses of a trajectory at times between its frames and beyond them."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign import Camera, Model, Motion, Tracker, View
from cadalign.errors import InputError
from cadalign.estimation.tracks.motion import Trajectory
from cadalign.geometry.rotations import rotation_from_vector, vector_from_rotation


@pytest.mark.parametrize("time", [-3.0, -0.5, 0.5, 1.25, 2.5, 4.0])
def test_a_steady_turn_goes_on_between_frames_and_beyond_them(time: float) -> None:
    """So does a straight way: here along the axis of the turn."""
    times, speed, turn = np.array([0.0, 1.0, 2.0]), 0.3, 0.2
    rotations = [rotation_from_vector(np.array([0.0, turn * each, 0.0])) for each in times]
    poses = [
        [*rotation.ravel(), 0.0, speed * each, 5.0]
        for rotation, each in zip(rotations, times, strict=True)
    ]
    velocities = np.tile([0.0, turn, 0.0, 0.0, speed, 0.0], (3, 1))
    known = np.tile(1e-6 * np.eye(12), (3, 1, 1))
    motion = Motion(angular_sigma=10.0, linear_sigma=0.1)
    path = Trajectory(times, np.array(poses), velocities, known, 0 * known, np.ones(3), motion)
    found = path.at(time)
    angle = vector_from_rotation(found.alignment.rotation)
    assert angle == pytest.approx([0.0, turn * time, 0.0], abs=1e-9)
    assert found.alignment.translation == pytest.approx([0.0, speed * time, 5.0], abs=1e-9)
    assert found.velocity == pytest.approx(velocities[0], abs=1e-9)


def test_a_frame_of_the_time_of_the_last_is_refused() -> None:
    tracker = Tracker(Model(points_3d=np.random.default_rng(0).uniform(-1, 1, (8, 3))))
    camera = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
    tracker.update(View(camera, time=1.0))
    for time in (1.0, 0.5):
        with pytest.raises(InputError, match=f"view.time: {time} is not later than 1.0, that of"):
            tracker.update(View(camera, time=time))
