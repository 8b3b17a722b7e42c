"""Smooth motions of an object: what is assumed of one, what is found, and its poses at all times.

Barfoot, Tong, Sarkka, "Batch continuous-time trajectory estimation as exactly sparse Gaussian
process regression", 2014: given the states at both ends of an interval, the mean of an integrated
random walk between them is Hermite's cubic, and its covariance that of a Brownian bridge.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, as_positive, is_number
from cadalign.errors import InputError, quote
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.solvers.joint.motion import twist_between

_RELATIVE_TIME = 1e-9  # of the track's length: such a time is that of a frame
_STEP = 1e-6  # of finite differences, in radians and in units of the translation's size

_Known = tuple[float, FloatArray, FloatArray]  # time, pose (12,) and velocity (6,) of the body


@dataclass(frozen=True)
class Motion:
    """Smoothness of a motion: its acceleration is white noise.

    The body's velocity, in its own axes, is a random walk: after t seconds without evidence its
    standard deviation is sigma times the root of t, that of the pose sigma times the root of
    t^3 / 3. A car that drives along a circle at constant speed has no acceleration in these axes.

    Parameters
    ----------
    angular_sigma : float, optional
        Strength of the angular acceleration, the root of its power spectral density
        [degrees / s^1.5]; None estimates it from the track, by its marginal likelihood.
    linear_sigma : float, optional
        Strength of the linear acceleration of the model's origin [model units / s^1.5]; likewise.

    Raises
    ------
    InputError
        If a value is not positive.

    Examples
    --------
    >>> Motion(angular_sigma=30.0)
    Motion(angular_sigma=30.0, linear_sigma=None)
    """

    angular_sigma: float | None = None
    linear_sigma: float | None = None

    def __post_init__(self) -> None:
        for name in ("angular_sigma", "linear_sigma"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, as_positive(value, name=name))

    @classmethod
    def of(cls, given: object) -> Motion:
        """The motion that an argument means: "smooth", or options."""
        if isinstance(given, cls):
            return given
        if given == "smooth":
            return cls()
        fix = 'give "smooth", or a cadalign.Motion with the strength of its accelerations'
        raise InputError(f"{quote(given)} is no motion", where="motion", fix=fix)

    def strength(self, unknown: FloatArray) -> FloatArray:
        """Strengths (2,) in the solver's units; those that are not given are ``unknown``."""
        angular = None if self.angular_sigma is None else np.radians(self.angular_sigma)
        given = (angular, self.linear_sigma)
        return np.array([u if g is None else g for g, u in zip(given, unknown, strict=True)])


class PoseAt(NamedTuple):
    """An object's pose at one time, in the frame that all views share.

    The ``covariance`` (6, 6) is that of the rotation vector [rad] and the translation; the
    ``velocity`` (6,) is that of the body in its own axes [rad / s, model units / s].
    """

    time: float
    alignment: Alignment
    covariance: FloatArray
    velocity: FloatArray

    @property
    def rotation_std_deg(self) -> float:
        """Standard deviation of the rotation, over all three axes [degrees]."""
        return float(np.degrees(np.sqrt(np.trace(self.covariance[:3, :3]))))

    @property
    def translation_std(self) -> FloatArray:
        """Standard deviations (3,) of the translation [model units]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[3:]))


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses and velocities of an object over time, in the frame that all views share.

    That is the frame of ``cam_from_rig`` where the views have it, otherwise the camera's.

    Parameters
    ----------
    times : (P,) float
        Times of the frames [s], increasing.
    poses : (P, 12) float
        Rotations row by row, and translations.
    velocities : (P, 6) float
        Angular and linear velocity of the body in its own axes [rad / s, model units / s].
    frames, links : (P, 12, 12) float
        Covariance of pose and velocity of each frame, and with those of the next.
    scale : (3,) float
        The stretch.
    motion : Motion
        Strengths of the acceleration, given or estimated.
    correlation : float
        Correlation of the keypoints' errors in successive frames, estimated from residuals. Poses
        and their uncertainties take it into account.

    Examples
    --------
    A body that turns by 0.2 rad/s about its y axis:

    >>> still, turned = np.eye(3), [[0.98007, 0, 0.19867], [0, 1, 0], [-0.19867, 0, 0.98007]]
    >>> poses = np.array([[*np.ravel(each), 0.0, 0.0, 2.0] for each in (still, turned)])
    >>> velocities = np.tile([0.0, 0.2, 0.0, 0.0, 0.0, 0.0], (2, 1))
    >>> known = np.tile(1e-6 * np.eye(12), (2, 1, 1))
    >>> motion = Motion(angular_sigma=10.0, linear_sigma=0.1)
    >>> times = np.array([0.0, 1.0])
    >>> path = Trajectory(times, poses, velocities, known, 0 * known, np.ones(3), motion)
    >>> [round(path.at(time).rotation_std_deg, 1) for time in (0.0, 0.5, 2.0)]
    [0.1, 1.3, 10.0]
    """

    times: FloatArray
    poses: FloatArray
    velocities: FloatArray
    frames: FloatArray
    links: FloatArray
    scale: FloatArray
    motion: Motion
    correlation: float = 0.0

    def __len__(self) -> int:
        return len(self.times)

    @property
    def rotations(self) -> FloatArray:
        """Rotations (P, 3, 3) of all frames."""
        return self.poses[:, :9].reshape(-1, 3, 3)

    @property
    def translations(self) -> FloatArray:
        """Translations (P, 3) of all frames."""
        return self.poses[:, 9:]

    def at(self, time: float) -> PoseAt:
        """The pose at a time, between frames, in a gap, or beyond the ends.

        Between frames it is the mean of the motion given both (Gaussian process regression);
        beyond the ends the velocity stays, and the uncertainty grows.

        Raises
        ------
        InputError
            If the time is not a finite number.
        """
        if not is_number(time) or not np.isfinite(time):
            raise InputError(f"{quote(time)} is not a finite number", where="time")
        length = max(float(np.ptp(self.times)), 1e-300)
        nearest = int(np.argmin(np.abs(self.times - time)))
        if abs(self.times[nearest] - time) <= _RELATIVE_TIME * length:
            return self._point(
                time, self.poses[nearest], self.velocities[nearest], self.frames[nearest][:6, :6]
            )
        after = int(np.searchsorted(self.times, time))
        ends = [k for k in (after - 1, after) if 0 <= k < len(self)]
        known = [(self.times[k], self.poses[k], self.velocities[k]) for k in ends]
        covariance = self.frames[ends[0]]
        if len(ends) == 2:
            cross = self.links[ends[0]]
            covariance = np.block([[covariance, cross], [cross.T, self.frames[ends[1]]]])
        strength = self.motion.strength(np.full(2, np.nan))
        return self._point(time, *_state_at(float(time), known, covariance, strength))

    def turned(self, rotation: FloatArray) -> Trajectory:
        """The same in a frame to which ``rotation`` (3, 3) leads from that of the poses."""
        turn = np.eye(12)
        turn[:3, :3] = turn[3:6, 3:6] = rotation
        rotations = (rotation @ self.rotations).reshape(-1, 9)
        return replace(
            self,
            poses=np.concatenate([rotations, self.translations @ rotation.T], axis=1),
            frames=turn @ self.frames @ turn.T,
            links=turn @ self.links @ turn.T,
        )

    def _point(
        self, time: float, pose: FloatArray, velocity: FloatArray, covariance: FloatArray
    ) -> PoseAt:
        alignment = Alignment(pose[:9].reshape(3, 3), pose[9:], self.scale)
        return PoseAt(float(time), alignment, covariance, velocity)


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


def _state_at(
    time: float, known: list[_Known], covariance: FloatArray, strength: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pose (12,), velocity (6,) and the pose's covariance (6, 6) between or beyond known states.

    ``covariance`` (12 or 24, squared) is that of one, or of two successive ones; ``strength`` (2,)
    that of the motion.
    """
    pose, velocity = _mean(time, known)
    size = len(covariance)
    slopes = np.empty((6, size))
    scale = max(float(np.linalg.norm(pose[9:])), 1e-12)
    for k in range(size):
        change = np.zeros(size)
        change[k] = _STEP * (scale if k % 6 >= 3 else 1.0)
        ends = [_mean(time, _stepped(known, sign * change))[0] for sign in (1, -1)]
        slopes[:, k] = _step_between(ends[1], ends[0]) / (2 * change[k])
    # Variance of an integrated random walk of unit strength, given the ends.
    around = abs(time - known[0][0])
    if len(known) == 2:
        after = known[1][0] - time
        around = around * after / (around + after)
    variances = np.repeat(np.square(strength), 3) * (around**3 / 3)
    turned = np.zeros((6, 6))
    turned[:3, :3] = turned[3:, 3:] = pose[:9].reshape(3, 3)
    return pose, velocity, slopes @ covariance @ slopes.T + turned * variances @ turned.T


def _mean(time: float, known: list[_Known]) -> tuple[FloatArray, FloatArray]:
    """Pose and velocity at a time: Hermite's cubic of the twist, or constant velocity."""
    begin, pose, first = known[0]
    if len(known) == 1:
        return moved_by(pose, (time - begin) * first), first
    end, last_pose, last = known[1]
    length = end - begin
    s = (time - begin) / length
    twist = twist_between(pose, last_pose)
    along = (3 * s**2 - 2 * s**3) * twist + length * (
        (s - 2 * s**2 + s**3) * first + (s**3 - s**2) * last
    )
    velocity = 6 * (s - s**2) / length * twist
    velocity += (1 - 4 * s + 3 * s**2) * first + (3 * s**2 - 2 * s) * last
    return moved_by(pose, along), velocity


def _stepped(known: list[_Known], change: FloatArray) -> list[_Known]:
    """The states after steps of pose, in the rig's axes, and velocity."""
    moved = []
    for (time, pose, velocity), own in zip(known, change.reshape(-1, 12), strict=True):
        turned = rotation_from_vector(own[:3]) @ pose[:9].reshape(3, 3)
        moved.append((time, np.append(turned.ravel(), pose[9:] + own[3:6]), velocity + own[6:]))
    return moved


def _step_between(first: FloatArray, second: FloatArray) -> FloatArray:
    """The small step (6,) in the rig's axes from one pose to another."""
    turn = second[:9].reshape(3, 3) @ first[:9].reshape(3, 3).T
    vector = 0.5 * np.array(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    return np.concatenate([vector, second[9:] - first[9:]])
