"""Smooth motion: a body's velocity is a random walk, its acceleration white noise.

Poses T (rig from model) and velocities w of the body, a twist in the model's axes (rotation, then
translation), obey dT/dt = T w^ and dw/dt = white noise of the power ``strength`` squared (Anderson
and Barfoot, "Full STEAM ahead: exactly sparse Gaussian process regression for batch continuous-time
trajectory estimation on SE(3)", 2015). Over an interval dt, the first term of Magnus' expansion
makes ``xi = log(T_k^-1 T_k+1)`` the integral of w. Given both ends, that has the mean
``dt (w_k + w_k+1) / 2`` and the variance ``strength^2 dt^3 / 12``, independent of the change of
the velocity, of variance ``strength^2 dt``: two residuals of six equations each.

A turn between successive frames must be less than half a turn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import fast_sums, inlined, kernel
from cadalign.solvers.joint.arrow import Arrow

STATE = 12
"""Unknowns of a frame: rotation, translation, angular and linear velocity."""
_SERIES = (1.0 / 12.0, -1.0 / 720.0, 1.0 / 30240.0, -1.0 / 1209600.0)  # Bernoulli's, even powers
_NEAR_ZERO = 1e-8


class MotionPrior(NamedTuple):
    """Intervals ``seconds`` (P - 1,) between frames, and the ``strength`` (2,) of acceleration.

    Angular [rad / s^1.5] and linear [model units / s^1.5], roots of power spectral densities.

    The same image from nearer, of a smaller object, moves less, so that the most likely path is too
    near: it lacks the volume of all paths, which shrinks as well. ``told`` is the number of numbers
    of translation and velocity that the evidence tells of each frame, with the log determinant of
    their information, ``-2 told log(depth)`` up to a constant, 0 to leave it out; ``farthest`` is a
    depth that no frame exceeds.
    """

    seconds: FloatArray
    strength: FloatArray
    told: float = 0.0
    farthest: float = 1.0


@kernel
def log_rotation(rotation: FloatArray) -> FloatArray:
    """The rotation vector (3,) of a rotation (3, 3), by the largest entry of its quaternion."""
    quaternion, largest = np.empty(4), np.empty(4)
    trace = rotation[0, 0] + rotation[1, 1] + rotation[2, 2]
    largest[0] = trace
    for a in range(3):
        largest[1 + a] = 2.0 * rotation[a, a] - trace
    first = int(np.argmax(largest))
    root = np.sqrt(max(1.0 + largest[first], 0.0))
    quaternion[first] = 0.5 * root
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        if first == 0:
            quaternion[1 + a] = 0.5 * (rotation[c, b] - rotation[b, c]) / root
        elif first == 1 + a:
            quaternion[0] = 0.5 * (rotation[c, b] - rotation[b, c]) / root
            quaternion[1 + b] = 0.5 * (rotation[b, a] + rotation[a, b]) / root
            quaternion[1 + c] = 0.5 * (rotation[c, a] + rotation[a, c]) / root
    if quaternion[0] < 0.0:
        quaternion *= -1.0
    sine = np.sqrt((quaternion[1:] ** 2).sum())
    if sine < _NEAR_ZERO:
        return 2.0 * quaternion[1:]
    return np.asarray(2.0 * np.arctan2(sine, quaternion[0]) / sine * quaternion[1:])


@inlined
def _write_cross(vector: FloatArray, matrix: FloatArray) -> None:
    """Write the matrix (3, 3) of the cross product with a vector."""
    matrix[0, 1], matrix[1, 0] = -vector[2], vector[2]
    matrix[0, 2], matrix[2, 0] = vector[1], -vector[1]
    matrix[1, 2], matrix[2, 1] = -vector[0], vector[0]


@kernel
def twist_between(first: FloatArray, second: FloatArray) -> FloatArray:
    """The twist (6,) that leads from one pose (12,) to another in the body's axes."""
    start, end = first[:9].reshape((3, 3)), second[:9].reshape((3, 3))
    relative, moved = np.zeros((3, 3)), np.zeros(3)
    for r in range(3):
        for k in range(3):
            moved[r] += start[k, r] * (second[9 + k] - first[9 + k])
            for c in range(3):
                relative[r, c] += start[k, r] * end[k, c]
    twist = np.empty(6)
    twist[:3] = log_rotation(relative)
    angle2 = (twist[:3] ** 2).sum()
    factor = 1.0 / 12.0 + angle2 / 720.0
    if angle2 > 1e-4:
        angle = np.sqrt(angle2)
        factor = 1.0 / angle2 - 0.5 / (angle * np.tan(0.5 * angle))
    across = np.zeros((3, 3))
    _write_cross(twist[:3], across)
    once = across @ moved
    twist[3:] = moved - 0.5 * once + factor * (across @ once)
    return twist


@kernel
def by_ends(twist: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Derivatives (2, 6, 6) of a twist between poses by the steps of both.

    A step turns a pose by a rotation vector in the rig's axes, and shifts it; see
    `cadalign.solvers.unknowns`. Inverse Jacobians of SE(3) are Bernoulli's series in the adjoint.
    """
    adjoint = np.zeros((6, 6))
    _write_cross(twist[:3], adjoint[:3, :3])
    _write_cross(twist[:3], adjoint[3:, 3:])
    _write_cross(twist[3:], adjoint[3:, :3])
    square = adjoint @ adjoint
    even, power = np.eye(6), np.eye(6)
    for coefficient in _SERIES:
        power = power @ square
        even += coefficient * power
    found = np.empty((2, 6, 6))
    for end in range(2):
        pose = second if end == 1 else first
        half = 0.5 if end == 1 else -0.5
        turned = np.zeros((6, 6))
        for r in range(3):
            for c in range(3):
                turned[r, c] = turned[3 + r, 3 + c] = pose[3 * c + r]
        sign = 1.0 if end == 1 else -1.0
        found[end] = sign * ((even + half * adjoint) @ turned)
    return found


@kernel
def write_interval(
    motion: MotionPrior, k: int, poses: FloatArray, velocities: FloatArray, rows: FloatArray
) -> None:
    """Write the whitened equations of interval k into ``rows`` (12, 25), the residuals last."""
    seconds = motion.seconds[k]
    twist = twist_between(poses[k], poses[k + 1])
    ends = by_ends(twist, poses[k], poses[k + 1])
    rows[:] = 0.0
    for a in range(6):
        strength = motion.strength[a // 3]
        of_place = np.sqrt(12.0 / seconds**3) / strength
        of_velocity = 1.0 / (np.sqrt(seconds) * strength)
        for m in range(6):
            rows[a, m] = of_place * ends[0, a, m]
            rows[a, STATE + m] = of_place * ends[1, a, m]
        first, second = velocities[k, a], velocities[k + 1, a]
        rows[a, 6 + a] = rows[a, STATE + 6 + a] = -0.5 * seconds * of_place
        rows[a, 2 * STATE] = of_place * (twist[a] - 0.5 * seconds * (first + second))
        rows[6 + a, 6 + a], rows[6 + a, STATE + 6 + a] = -of_velocity, of_velocity
        rows[6 + a, 2 * STATE] = of_velocity * (second - first)


@fast_sums
def add_motion(
    motion: MotionPrior, poses: FloatArray, velocities: FloatArray, arrow: Arrow
) -> float:
    """Add the equations of all intervals; returns their cost."""
    rows = np.empty((STATE, 2 * STATE + 1))
    products = np.empty((2 * STATE, 2 * STATE + 1))
    cost = 0.0
    for k in range(motion.seconds.shape[0]):
        write_interval(motion, k, poses, velocities, rows)
        products[:] = 0.0
        for row in rows:
            cost += row[2 * STATE] ** 2
            for a in range(2 * STATE):
                if row[a] != 0.0:
                    for b in range(2 * STATE + 1):
                        products[a, b] += row[a] * row[b]
        for a in range(STATE):
            arrow.gradient[STATE * k + a] += products[a, 2 * STATE]
            arrow.gradient[STATE * (k + 1) + a] += products[STATE + a, 2 * STATE]
            for b in range(STATE):
                arrow.blocks[k, a, b] += products[a, b]
                arrow.blocks[k + 1, a, b] += products[STATE + a, STATE + b]
                arrow.coupling[k, a, b] += products[a, STATE + b]
    return cost


@kernel
def moments(
    motion: MotionPrior, poses: FloatArray, velocities: FloatArray, inverse: Arrow
) -> tuple[FloatArray, FloatArray]:
    """Squared whitened residuals (2,) of rotation and translation, and their variances' sums (2,).

    The variances are those that the covariance of both frames, in ``inverse``, gives the residuals.
    """
    squares, variances = np.zeros(2), np.zeros(2)
    rows = np.empty((STATE, 2 * STATE + 1))
    both = np.empty((2 * STATE, 2 * STATE))
    for k in range(motion.seconds.shape[0]):
        write_interval(motion, k, poses, velocities, rows)
        both[:STATE, :STATE] = inverse.blocks[k]
        both[STATE:, STATE:] = inverse.blocks[k + 1]
        both[:STATE, STATE:] = inverse.coupling[k, :, :STATE]
        both[STATE:, :STATE] = inverse.coupling[k, :, :STATE].T
        spread = rows[:, : 2 * STATE].copy() @ both
        for a in range(STATE):
            group = (a % 6) // 3
            squares[group] += rows[a, 2 * STATE] ** 2
            for m in range(2 * STATE):
                variances[group] += spread[a, m] * rows[a, m]
    return squares, variances
