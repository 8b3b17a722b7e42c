"""`cadalign.Motion` and `cadalign.Trajectory`: what is assumed and what is found of a motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, as_positive, is_number
from cadalign.errors import InputError, quote
from cadalign.estimation.tracks.between import FrameState, KnownStates, state_at
from cadalign.geometry.alignment import Alignment

_RELATIVE_TIME = 1e-9  # of the track's length: such a time is that of a frame


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

    @classmethod
    def of_strength(cls, strength: FloatArray) -> Motion:
        """The motion of a solver's strengths (2,)."""
        return cls(float(np.degrees(strength[0])), float(strength[1]))

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
        known = [FrameState(self.times[k], self.poses[k], self.velocities[k]) for k in ends]
        steps = KnownStates(known, self._covariance_of(ends))
        found = state_at(float(time), steps, self.motion.strength(np.full(2, np.nan)))
        return self._point(time, found.pose, found.velocity, found.covariance)

    def _covariance_of(self, ends: list[int]) -> FloatArray:
        """Covariance of one frame, or of two successive ones."""
        if len(ends) == 1:
            return np.asarray(self.frames[ends[0]])
        cross = self.links[ends[0]]
        return np.asarray(
            np.block([[self.frames[ends[0]], cross], [cross.T, self.frames[ends[1]]]])
        )

    def _point(
        self, time: float, pose: FloatArray, velocity: FloatArray, covariance: FloatArray
    ) -> PoseAt:
        alignment = Alignment(pose[:9].reshape(3, 3), pose[9:], self.scale)
        return PoseAt(float(time), alignment, covariance, velocity)
