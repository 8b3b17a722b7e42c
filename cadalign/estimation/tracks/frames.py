"""Frames of a track: their order, poses by the keypoints of each alone, and errors in common.

Every frame has several candidates, the minima of its own keypoints for a known shape. The most
likely path pays for residuals and for turns between frames, by dynamic programming (Viterbi, 1967);
where outliers are expected it may skip frames, whose keypoints then all count as outliers.

Errors that are correlated by r from frame to frame, an autoregression of first order, have at slow
changes a spectral density that is (1 + r) / (1 - r) times that of independent errors (Priestley,
"Spectral Analysis and Time Series", 1981). Shape and smooth path rest on slow changes alone, so
that such errors count as independent ones of that variance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.estimation.estimates import mean_state
from cadalign.estimation.joint_robust import whitened_lengths, whitened_residuals
from cadalign.estimation.prepared_views import lie_on_a_line
from cadalign.estimation.prior import ShapePrior, with_known_shape
from cadalign.estimation.starts import in_rig
from cadalign.estimation.tracks.motion import moved_by
from cadalign.estimation.view import View
from cadalign.solvers.joint.evidence import Evidence, State, kept_rows
from cadalign.solvers.joint.motion import twist_between
from cadalign.solvers.joint.search import view_starts

_MOST_FIRST = 40  # frames that the shape is first estimated from
_OUTLIER = 4.0  # whitened residual at which one counts no more
_MOST = 4  # candidates of a frame
_WINDOW = 40  # earlier candidates that a frame may follow
_LEAST_TURN = math.radians(3.0)  # between frames, that costs one
_NEVER = 1e9  # price of skipping a frame
_USUAL_RATES = 2.0
_SURE = 2.0  # standard errors by which a correlation must differ from zero to be taken for one
_LARGEST = 0.9


class Frames(NamedTuple):
    """Increasing ``times`` (P,) [s], and the number of each view's frame (V,)."""

    times: FloatArray
    of_view: IntArray

    @classmethod
    def of(cls, views: Sequence[View]) -> Frames:
        """The frames of views; successive views are a second apart where none has a time.

        Raises InputError if only some views have a time, all have the same one, or a view has
        evidence that a motion cannot be estimated with.
        """
        lacking = [view.time is None for view in views]
        if any(lacking) != all(lacking):
            fix = "give it for all views, or for none"
            where = f"views[{lacking.index(True)}].time"
            raise InputError("only some views have a time", where=where, fix=fix)
        given = [float(n if view.time is None else view.time) for n, view in enumerate(views)]
        times, of_view = np.unique(given, return_inverse=True)
        if len(times) < 2:
            fix = "give views of two times or more, or no motion"
            raise InputError("all views have the same time", where="views", fix=fix)
        return cls(times, of_view.astype(np.int64))

    def chosen(self, prior: ShapePrior, views: Sequence[View]) -> list[int]:
        """Views of the frames that determine the shape best, spread over the track."""
        mean = prior.components[0].mean
        counts = np.zeros(len(self.times), dtype=int)
        for number, view in enumerate(views):
            points = mean[prior.rows_of(view.keypoint_ids, f"views[{number}].ids")]
            if not lie_on_a_line(points):
                counts[self.of_view[number]] += len(points)
        parts = np.array_split(np.arange(len(counts)), min(_MOST_FIRST, len(counts)))
        best = [int(part[np.argmax(counts[part])]) for part in parts]
        kept = [frame for frame in best if counts[frame] > 0]
        return np.flatnonzero(np.isin(self.of_view, kept)).tolist()

    def among(self, numbers: Sequence[int]) -> tuple[int, ...]:
        """Frames of some views, numbered from 0 without those that are not among them."""
        _, renumbered = np.unique(self.of_view[list(numbers)], return_inverse=True)
        return tuple(cast("list[int]", renumbered.tolist()))


class PoseCandidates(NamedTuple):
    """Poses (C, 12) of frames (C,), in the order of frames, and the costs of their keypoints."""

    poses: FloatArray
    frame: IntArray
    costs: FloatArray


def candidates_of(evidence: Evidence, shape: FloatArray) -> PoseCandidates:
    """PoseCandidates of every frame for a shape (m, 3); frames of few keypoints have none.

    The costs are truncated squares of a frame's own residuals.
    """
    still = with_known_shape(evidence, shape)
    poses, frames, costs = [], [], []
    order = np.argsort(evidence.rig.pose, kind="stable")
    for view in order.tolist():
        frame = int(evidence.rig.pose[view])
        rows = np.flatnonzero(still.rig.pose[still.sightings.image] == frame)
        own = still._replace(sightings=kept_rows(still.sightings, rows))
        for pose in view_starts(still, view)[0][:_MOST]:
            poses.append(in_rig(pose, evidence.rig.cam_from_rig[view]))
            frames.append(frame)
            state = mean_state(own, np.broadcast_to(poses[-1], (frame + 1, 12)), np.zeros(3))
            lengths = np.minimum(whitened_lengths(own, state), _OUTLIER)
            costs.append(float((lengths * lengths).sum()))
    return PoseCandidates(
        np.array(poses).reshape(-1, 12), np.array(frames, dtype=np.int64), np.array(costs)
    )


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


class SuccessiveErrors(NamedTuple):
    """Sums over pairs of a keypoint's whitened residuals in a frame and in the next one.

    ``products`` are of both, ``squares`` of the later one, over ``number`` coordinates.
    """

    products: float = 0.0
    squares: float = 0.0
    number: float = 0.0

    @classmethod
    def of(cls, evidence: Evidence, state: State, *, first: int = 0) -> SuccessiveErrors:
        """The sums at a state, of pairs whose earlier frame is the ``first`` one or later."""
        sightings, residuals = evidence.sightings, whitened_residuals(evidence, state)
        order = np.lexsort((evidence.rig.pose[sightings.image], sightings.point))
        points, frames = sightings.point[order], evidence.rig.pose[sightings.image[order]]
        follows = (np.diff(points) == 0) & (np.diff(frames) == 1) & (frames[:-1] >= first)
        before, after = residuals[order[:-1]][follows], residuals[order[1:]][follows]
        if not np.isfinite(before).all() or not np.isfinite(after).all():
            return cls()
        return cls(float((before * after).sum()), float((after**2).sum()), before.size)

    @property
    def correlation(self) -> float:
        """Correlation of successive errors, 0 where it is not sure that there is one."""
        if not self.squares > 0:
            return 0.0
        found = self.products / self.squares
        return min(found, _LARGEST) if found > _SURE / np.sqrt(self.number) else 0.0


def weakened(evidence: Evidence, correlation: float) -> Evidence:
    """The evidence of keypoints whose errors are correlated in time, as if independent."""
    factor = np.sqrt((1 - correlation) / (1 + correlation))
    old = evidence.sightings
    return evidence._replace(sightings=old._replace(whitening=factor * old.whitening))
