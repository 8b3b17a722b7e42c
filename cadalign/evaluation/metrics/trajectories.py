"""Errors of trajectories: absolute and relative pose error, jitter, flips.

Sturm, Engelhard, Endres, Burgard, Cremers, "A benchmark for the evaluation of RGB-D SLAM systems",
2012: the absolute error compares poses frame by frame, the relative one the motion between frames
that are some frames apart. Poses are those of the object in one frame; none is aligned before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.geometry.rotations import angles_between, vector_from_rotation

_FLIPPED_DEG = 90.0


@dataclass(frozen=True)
class PoseErrors:
    """Root mean squares of rotation [degrees] and translation [model units]."""

    rotation_deg: float
    translation: float

    @classmethod
    def of(cls, est: FloatArray, gt: FloatArray) -> PoseErrors:
        """The errors of poses (P, 12), rotations by rows and translations."""
        angles = angles_between(_rotations(est), _rotations(gt))
        gaps = np.linalg.norm(est[:, 9:] - gt[:, 9:], axis=1)
        return cls(*(float(np.sqrt((each**2).mean())) for each in (angles, gaps)))


def absolute_pose_error(*, est: FloatArray, gt: FloatArray) -> PoseErrors:
    """Root mean square error of the poses (P, 12) of all frames.

    Raises InputError if there are other frames than true ones, or none.
    """
    _check(est, gt, least=1)
    return PoseErrors.of(est, gt)


def relative_pose_error(*, est: FloatArray, gt: FloatArray, step: int = 1) -> PoseErrors:
    """Root mean square error of the motions between frames that are ``step`` frames apart.

    A motion is that of the body in its own axes, ``inv(T_k) T_k+step``. Raises InputError if there
    are other frames than true ones, or fewer than that.
    """
    _check(est, gt, least=step + 1)
    return PoseErrors.of(_motions(est, step), _motions(gt, step))


def rotation_jitter_deg(poses: FloatArray) -> float:
    """Standard deviation of the second difference of the rotation [degrees], per axis.

    Zero for a turn at constant speed. Raises InputError for fewer than three frames.
    """
    _check(poses, poses, least=3)
    turns = np.array([vector_from_rotation(each) for each in _rotations(_motions(poses, 1))])
    return float(np.degrees(np.sqrt((np.diff(turns, axis=0) ** 2).mean())))


def count_flips(*, est: FloatArray, gt: FloatArray) -> int:
    """Number of frames whose rotation is more than 90 degrees off."""
    _check(est, gt, least=1)
    return int((angles_between(_rotations(est), _rotations(gt)) > _FLIPPED_DEG).sum())


def _rotations(poses: FloatArray) -> FloatArray:
    return poses[:, :9].reshape(-1, 3, 3)


def _motions(poses: FloatArray, step: int) -> FloatArray:
    """Motions (P - step, 12) of the body in its own axes."""
    first, second = poses[:-step], poses[step:]
    back = _rotations(first).swapaxes(1, 2)
    turns = (back @ _rotations(second)).reshape(-1, 9)
    moves = np.einsum("nij,nj->ni", back, second[:, 9:] - first[:, 9:])
    return np.concatenate([turns, moves], axis=1)


def _check(est: FloatArray, gt: FloatArray, *, least: int) -> None:
    if len(est) != len(gt):
        raise InputError(f"{len(est)} poses for {len(gt)} true ones", where="est")
    if len(est) < least:
        raise InputError(f"{len(est)} poses, but {least} are needed", where="est")
