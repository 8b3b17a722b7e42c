"""Poses between the frames of a track, by the motion's conditional mean and covariance.

Barfoot, Tong, Sarkka, "Batch continuous-time trajectory estimation as exactly sparse Gaussian
process regression", 2014: given the states at both ends of an interval, the mean of an integrated
random walk between them is Hermite's cubic, and its covariance that of a Brownian bridge.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.solvers.tracks.motion import twist_between

_STEP = 1e-6  # of finite differences, in radians and in units of the translation's size


class FrameState(NamedTuple):
    """Pose (12,) and velocity (6,) of the body at a time [s]."""

    time: float
    pose: FloatArray
    velocity: FloatArray


class KnownStates(NamedTuple):
    """Known states, one or two successive ones, and their covariance (12 or 24, squared)."""

    states: list[FrameState]
    covariance: FloatArray


class Between(NamedTuple):
    """Pose (12,), velocity (6,) and covariance (6, 6) of the pose."""

    pose: FloatArray
    velocity: FloatArray
    covariance: FloatArray


def moved_by(pose: FloatArray, twist: FloatArray) -> FloatArray:
    """The pose (12,) that a twist (6,) in the body's axes leads to."""
    rotation, turn = pose[:9].reshape(3, 3), rotation_from_vector(twist[:3])
    angle = float(np.linalg.norm(twist[:3]))
    x, y, z = twist[:3]
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    first, second = 0.5, 1.0 / 6.0
    if angle > 1e-4:
        first = (1 - np.cos(angle)) / angle**2
        second = (angle - np.sin(angle)) / angle**3
    moved = (np.eye(3) + first * across + second * across @ across) @ twist[3:]
    return np.concatenate([(rotation @ turn).ravel(), pose[9:] + rotation @ moved])


def state_at(time: float, known: KnownStates, strength: FloatArray) -> Between:
    """The state at a time between or beyond known ones, where the motion has a strength (2,)."""
    pose, velocity = _mean(time, known.states)
    size = len(known.covariance)
    slopes = np.empty((6, size))
    scale = max(float(np.linalg.norm(pose[9:])), 1e-12)
    for k in range(size):
        change = np.zeros(size)
        change[k] = _STEP * (scale if k % 6 >= 3 else 1.0)
        ends = [_mean(time, _stepped(known.states, sign * change))[0] for sign in (1, -1)]
        slopes[:, k] = _step_between(ends[1], ends[0]) / (2 * change[k])
    own = _own_variance(time, known.states)
    variances = np.repeat(np.square(strength), 3) * own
    turned = np.zeros((6, 6))
    turned[:3, :3] = turned[3:, 3:] = pose[:9].reshape(3, 3)
    covariance = slopes @ known.covariance @ slopes.T + turned * variances @ turned.T
    return Between(pose, velocity, covariance)


def _mean(time: float, known: list[FrameState]) -> tuple[FloatArray, FloatArray]:
    """Pose and velocity at a time: Hermite's cubic of the twist, or constant velocity."""
    start = known[0]
    if len(known) == 1:
        return moved_by(start.pose, (time - start.time) * start.velocity), start.velocity
    end = known[1]
    length = end.time - start.time
    s = (time - start.time) / length
    twist = twist_between(start.pose, end.pose)
    along = (3 * s**2 - 2 * s**3) * twist + length * (
        (s - 2 * s**2 + s**3) * start.velocity + (s**3 - s**2) * end.velocity
    )
    velocity = 6 * (s - s**2) / length * twist
    velocity += (1 - 4 * s + 3 * s**2) * start.velocity + (3 * s**2 - 2 * s) * end.velocity
    return moved_by(start.pose, along), velocity


def _own_variance(time: float, known: list[FrameState]) -> float:
    """Variance of an integrated random walk of unit strength, given the ends."""
    before = abs(time - known[0].time)
    if len(known) == 1:
        return before**3 / 3
    after = known[1].time - time
    return (before * after / (before + after)) ** 3 / 3


def _stepped(known: list[FrameState], change: FloatArray) -> list[FrameState]:
    """The states after steps of pose, in the rig's axes, and velocity."""
    moved = []
    for state, own in zip(known, change.reshape(-1, 12), strict=True):
        turned = rotation_from_vector(own[:3]) @ state.pose[:9].reshape(3, 3)
        pose = np.concatenate([turned.ravel(), state.pose[9:] + own[3:6]])
        moved.append(FrameState(state.time, pose, state.velocity + own[6:]))
    return moved


def _step_between(first: FloatArray, second: FloatArray) -> FloatArray:
    """The small step (6,) in the rig's axes from one pose to another."""
    turn = second[:9].reshape(3, 3) @ first[:9].reshape(3, 3).T
    vector = 0.5 * np.array(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    return np.concatenate([vector, second[9:] - first[9:]])
