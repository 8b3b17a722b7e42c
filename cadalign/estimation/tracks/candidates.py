"""Poses of single frames, and the path through them that neighbours agree with.

Every frame has several candidates, the minima of its own keypoints for a known shape. The most
likely path pays for residuals and for turns between frames, by dynamic programming (Viterbi, 1967);
where outliers are expected it may skip frames, whose keypoints then all count as outliers.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.estimation.joint_robust import whitened_lengths
from cadalign.estimation.starts import in_rig
from cadalign.estimation.tracks.between import moved_by
from cadalign.solvers.joint.evidence import Evidence, Shape, State, kept_rows
from cadalign.solvers.joint.search import view_starts
from cadalign.solvers.tracks.motion import twist_between

_OUTLIER = 4.0  # whitened residual at which one counts no more
_MOST = 4  # candidates of a frame
_WINDOW = 40  # earlier candidates that a frame may follow
_LEAST_TURN = math.radians(3.0)  # between frames, that costs one
_NEVER = 1e9  # price of skipping a frame
_USUAL_RATES = 2.0


class PoseCandidates(NamedTuple):
    """Poses (C, 12) of frames (C,), in the order of frames, and the costs of their keypoints."""

    poses: FloatArray
    frame: IntArray
    costs: FloatArray


def candidates_of(evidence: Evidence, shape: FloatArray) -> PoseCandidates:
    """PoseCandidates of every frame for a shape (m, 3); frames of few keypoints have none."""
    still = evidence._replace(
        shape=Shape(shape, evidence.shape.modes[:0], np.zeros(len(shape))),
        scales=evidence.scales._replace(free=np.zeros(3), precision=np.zeros((3, 3))),
    )
    poses, frames, costs = [], [], []
    order = np.argsort(evidence.rig.pose, kind="stable")
    for view in order.tolist():
        frame = int(evidence.rig.pose[view])
        rows = np.flatnonzero(still.rig.pose[still.sightings.image] == frame)
        own = still._replace(sightings=kept_rows(still.sightings, rows))
        for pose in view_starts(still, view)[0][:_MOST]:
            poses.append(in_rig(pose, evidence.rig.cam_from_rig[view]))
            frames.append(frame)
            costs.append(_cost(own, frame, poses[-1]))
    return PoseCandidates(
        np.array(poses).reshape(-1, 12), np.array(frames, dtype=np.int64), np.array(costs)
    )


def _cost(own: Evidence, frame: int, pose: FloatArray) -> float:
    """Truncated squares of a frame's own residuals under a pose."""
    state = State(
        np.broadcast_to(pose, (frame + 1, 12)),
        np.zeros(len(own.focals.low)),
        np.zeros(3),
        np.zeros(0),
        np.zeros_like(own.shape.mean),
    )
    lengths = np.minimum(whitened_lengths(own, state), _OUTLIER)
    return float((lengths * lengths).sum())


def best_path(
    candidates: PoseCandidates, times: FloatArray, keypoints: IntArray, *, may_skip: bool
) -> IntArray:
    """Rows of the candidates on the best path, at most one of each frame.

    ``keypoints`` (P,) counts those of every frame. Frames that have candidates are skipped only
    where they ``may_skip``.
    """
    frame, rotations = candidates.frame, candidates.poses[:, :9]
    rate = _usual_rate(candidates, times)
    price = np.where(np.bincount(frame, minlength=len(times)) > 0, _NEVER, 0.0)
    if may_skip:
        price = _OUTLIER**2 * keypoints
    skipped = np.concatenate([[0.0], np.cumsum(price)])  # before each frame
    total, before = np.empty(len(frame)), np.full(len(frame), -1)
    for row, k in enumerate(frame.tolist()):
        total[row] = skipped[k]
        earlier = np.arange(max(0, row - _WINDOW), row)
        earlier = earlier[frame[earlier] < k]
        if len(earlier):
            turns = _angles(rotations[earlier] @ rotations[row])
            usual = rate * (times[k] - times[frame[earlier]]) + _LEAST_TURN
            between = skipped[k] - skipped[frame[earlier] + 1]
            sums = total[earlier] + between + (turns / usual) ** 2
            best = int(np.argmin(sums))
            if sums[best] < total[row]:
                total[row], before[row] = sums[best], earlier[best]
        total[row] += candidates.costs[row]
    row = int(np.argmin(total + skipped[-1] - skipped[frame + 1]))
    path = []
    while row >= 0:
        path.append(row)
        row = int(before[row])
    return np.array(path[::-1])


def _angles(products: FloatArray) -> FloatArray:
    """Angles between rotations, from the sums of the products of their entries."""
    return np.asarray(np.arccos(np.clip((products - 1) / 2, -1, 1)))


def _usual_rate(candidates: PoseCandidates, times: FloatArray) -> float:
    """Usual angular speed [rad/s] of the frames' best candidates."""
    order = np.lexsort([candidates.costs, candidates.frame])
    first = order[np.r_[True, np.diff(candidates.frame[order]) > 0]]
    rotations, spans = candidates.poses[first, :9], np.diff(times[candidates.frame[first]])
    if not len(spans):
        return 0.0
    turns = _angles((rotations[1:] * rotations[:-1]).sum(axis=1))
    return _USUAL_RATES * float(np.median(turns / spans))


def filled(poses: FloatArray, frames: IntArray, times: FloatArray) -> FloatArray:
    """Poses (P, 12) at all times from those of some frames: between them along a screw."""
    whole = np.empty((len(times), 12))
    whole[: frames[0]] = poses[0]
    whole[frames[-1] :] = poses[-1]
    for k in range(len(frames) - 1):
        start, end = frames[k], frames[k + 1]
        twist = twist_between(poses[k], poses[k + 1])
        for frame in range(start, end):
            share = (times[frame] - times[start]) / (times[end] - times[start])
            whole[frame] = moved_by(poses[k], share * twist) if share > 0 else poses[k]
    return whole


def velocities_of(poses: FloatArray, times: FloatArray) -> FloatArray:
    """Velocities (P, 6) from differences of successive poses."""
    spans = np.diff(times)
    rates = np.array([twist_between(*pair) for pair in pairwise(poses)])
    rates /= spans[:, None]
    inner = (rates[1:] + rates[:-1]) / 2
    return np.concatenate([rates[:1], inner, rates[-1:]])
