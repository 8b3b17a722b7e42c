"""A window over the last frames of a track, and what the earlier ones say of it.

A frame that leaves the window is marginalised: what it says of the next frame and of the shape
stays as a quadratic (fixed-lag smoothing; Sibley, Matthies, Sukhatme, "Sliding window filter with
application to planetary landing", 2010).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.pack import TABLES, told_by
from cadalign.estimation.tracks.motion import Motion
from cadalign.solvers.joint.arrow import Arrow, dense_matrix, factorize_arrow, invert_arrow
from cadalign.solvers.joint.evidence import Evidence, Rig
from cadalign.solvers.joint.motion import STATE, MotionPrior, moments
from cadalign.solvers.joint.tracks import (
    NOTHING_KNOWN,
    Anchor,
    Moving,
    Path,
    equations_of,
    refine_path,
)

_CHANGES = 6.0  # residuals of rotation, and of translation, between two frames
_LONG = 100.0  # seconds of the motion after which a velocity is unknown


@dataclass(frozen=True, eq=False)
class Window:
    """Evidence of successive frames at ``times`` (P,), their path, and what is known from earlier.

    ``prior`` is that of the motion, but for the times. The evidence's modes are all used, as
    `cadalign.solvers.joint.search.reduce_modes` leaves them.
    """

    evidence: Evidence
    times: FloatArray
    path: Path
    prior: MotionPrior
    anchor: Anchor = NOTHING_KNOWN

    @property
    def system(self) -> Moving:
        """The system of equations."""
        motion = self.prior._replace(seconds=np.diff(self.times))
        return Moving(self.evidence, False, motion, self.anchor)

    def refined(self, max_iterations: int) -> tuple[float, Window]:
        """The cost, and the window with its most likely path."""
        cost, path, _ = refine_path(self.system, self.path, max_iterations)
        return cost, replace(self, path=path)

    @cached_property
    def _covariance(self) -> Arrow | None:
        """Covariances of frames, of successive ones, and of the border; None if undetermined."""
        _, arrow = equations_of(self.system, self.path)
        for diagonal in range(STATE):
            arrow.blocks[:, diagonal, diagonal] *= 1 + 1e-12
        return invert_arrow(arrow) if factorize_arrow(arrow) else None

    def newest(self) -> FloatArray:
        """Covariance (12, 12) of pose and velocity of the last frame."""
        if self._covariance is None:
            return np.full((STATE, STATE), np.inf)
        return np.asarray(self._covariance.blocks[-1])

    def first_change(self) -> tuple[FloatArray, FloatArray]:
        """Squares of the motion's residuals between the first frames, and what is known of them.

        Both (2,) are those of rotation and translation, the first in squared strengths.
        """
        if self._covariance is None:
            return np.zeros(2), np.zeros(2)
        motion, path = self.system.motion, self.path
        first = motion._replace(seconds=motion.seconds[:1])
        squares, variances = moments(first, path.state.poses, path.velocities, self._covariance)
        return squares * motion.strength**2, np.maximum(_CHANGES - variances, 0.0)

    def without_first(self) -> Window:
        """The window without its first frame, which is marginalised."""
        anchor = _told_by_first(self)
        state = self.path.state
        later = Path(state._replace(poses=state.poses[1:]), self.path.velocities[1:])
        kept = self.evidence.rig.pose > 0
        some = _of_views(self.evidence, kept, kept)
        evidence = some._replace(rig=some.rig._replace(pose=some.rig.pose - 1))
        return replace(self, evidence=evidence, times=self.times[1:], path=later, anchor=anchor)


class SeenMotion(NamedTuple):
    """Strength of the motion by the frames that have left a window.

    ``squares`` (2,) are those of residuals of rotation and translation, in squared strengths, and
    ``told`` (2,) how many numbers the evidence tells of them, in ``frames`` frames.
    """

    squares: FloatArray
    told: FloatArray
    frames: float

    def after(self, window: Window) -> SeenMotion:
        """The motion with what the first frame of a window adds, which leaves it."""
        squares, told = window.first_change()
        return SeenMotion(self.squares + squares, self.told + told, self.frames + 1.0)

    def prior(self, before: MotionPrior, motion: Motion) -> MotionPrior:
        """The prior of further frames, with the likeliest strengths where these are not given.

        A strength that is too large for the track would let the volume of its paths
        (`MotionPrior`) drive it away from the camera, and one that is too small towards it.
        """
        strength = motion.strength(np.sqrt(self.squares / self.told))
        return before._replace(strength=strength, told=float(self.told[1] / self.frames))


def begun_again(window: Window, pose: FloatArray, evidence: Evidence) -> Window:
    """A window of one frame at a pose, of ``evidence``, that keeps what is known of the shape."""
    while len(window.times) > 2:
        window = window.without_first()
    known = _told_by_first(window)
    gone, kept = slice(0, STATE), slice(STATE, None)
    open_pose = known.information[gone, gone] + 1e-12 * np.eye(STATE)
    gain = np.linalg.solve(open_pose, known.information[gone, kept]).T
    information = np.zeros_like(known.information)
    information[kept, kept] = known.information[kept, kept] - gain @ known.information[gone, kept]
    gradient = np.zeros_like(known.gradient)
    gradient[kept] = known.gradient[kept] - gain @ known.gradient[gone]
    speeds = np.repeat(window.prior.strength, 3) * _LONG**0.5
    information[np.arange(6, STATE), np.arange(6, STATE)] = speeds**-2.0
    state = window.path.state._replace(poses=pose[None])
    still = np.zeros((1, 6))
    anchor = Anchor(pose, still[0], known.border, gradient, information)
    return replace(
        window, evidence=evidence, times=window.times[-1:], path=Path(state, still), anchor=anchor
    )


def _told_by_first(window: Window) -> Anchor:
    """Information of the first frame, and what is known of it, on the second one and the border."""
    evidence, path = window.evidence, window.path
    first, two = evidence.rig.pose == 0, evidence.rig.pose < 2
    own = _of_views(evidence, first, two)
    state = path.state._replace(poses=path.state.poses[:2])
    pair = Path(state, path.velocities[:2])
    motion = window.prior._replace(seconds=np.diff(window.times[:2]))
    _, arrow = equations_of(Moving(own, False, motion, window.anchor), pair)
    nothing = _of_views(evidence, np.zeros_like(first), two)
    _, prior = equations_of(Moving(nothing, False, motion, NOTHING_KNOWN), pair)
    information, gradient = dense_matrix(arrow), arrow.gradient.copy()
    size = len(arrow.border)
    information[2 * STATE :, 2 * STATE :] -= prior.border  # it stays in the evidence
    gradient[2 * STATE :] -= prior.gradient[2 * STATE :]
    gone, kept = slice(0, STATE), slice(STATE, 2 * STATE + size)
    gain = np.linalg.solve(information[gone, gone], information[gone, kept]).T
    left = information[kept, kept] - gain @ information[gone, kept]
    shared = [path.state.log_focals, path.state.log_scales, path.state.coefficients]
    return Anchor(
        path.state.poses[1].copy(),
        path.velocities[1].copy(),
        np.concatenate(shared),
        gradient[kept] - gain @ gradient[gone],
        (left + left.T) / 2,
    )


def _of_views(evidence: Evidence, told: BoolArray, views: BoolArray) -> Evidence:
    """The evidence that some views (V,) have, and what is none's, in a rig of some ``views`` (V,).

    The first are among the second, which are numbered anew.
    """
    rig, focals, number = evidence.rig, evidence.focals, np.append(np.cumsum(views) - 1, -1)
    some = told_by(evidence, told)
    tables = {name: getattr(some, name) for name in TABLES}
    return some._replace(
        **{name: rows._replace(image=number[rows.image]) for name, rows in tables.items()},
        rig=Rig(rig.cam_from_rig[views], rig.pose[views]),
        focals=focals._replace(group=focals.group[views]),
    )
