"""Methods on videos: each frame alone, one shape, smooth motion, and online."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError
from cadalign.estimation.align import align
from cadalign.estimation.options import RansacOptions
from cadalign.estimation.result import Result
from cadalign.estimation.tracks.motion import Motion
from cadalign.estimation.tracks.tracker import Tracker
from cadalign.estimation.view import View
from cadalign.evaluation.methods.method import Method
from cadalign.geometry.alignment import Alignment
from cadalign.shapes.model import ShapeModel


@dataclass(frozen=True, eq=False)
class TrackVideo:
    """A video as methods are given it, and the true poses (P, 12), which they do not use."""

    shape: ShapeModel
    views: tuple[View, ...]
    truth: FloatArray
    ransac: RansacOptions | None


@dataclass(frozen=True, eq=False)
class TrackEstimate:
    """Poses (P, 12) of an object's axes and its box's centre, NaN where there is none.

    ``covariances`` (P, 3, 3) are those of the rotation vectors [rad].
    """

    poses: FloatArray
    covariances: FloatArray
    degrees_of_freedom: float | None = None


def of_result(result: Result) -> TrackEstimate:
    """The estimate of a result, whose views are the frames."""
    middle = result.bounds.mean(axis=0)
    frames = [(view.alignment, view.covariance) for view in result.views]
    return _estimate(frames, middle, result.degrees_of_freedom)


_Frame = tuple[Alignment, FloatArray | None]


def _estimate(
    frames: Sequence[_Frame | None], middle: FloatArray, freedom: float | None = None
) -> TrackEstimate:
    """The estimate of the poses of all frames, with covariances whose first part is rotation."""
    poses, covariances = np.full((len(frames), 12), np.nan), np.full((len(frames), 3, 3), np.nan)
    for k, frame in enumerate(frames):
        if frame is None:
            continue
        alignment, covariance = frame
        poses[k] = [*alignment.rotation.ravel(), *alignment.apply([middle])[0]]
        if covariance is not None:
            covariances[k] = covariance[:3, :3]
    return TrackEstimate(poses, covariances, freedom)


def _frame_by_frame(video: TrackVideo) -> TrackEstimate:
    poses, covariances = [], []
    freedom = None
    for view in video.views:
        try:
            result = align(video.shape, view, ransac=video.ransac)
        except CadalignError:  # too few keypoints, or no consensus
            found = _estimate([None], np.zeros(3))
        else:
            found, freedom = of_result(result), result.degrees_of_freedom
        poses.append(found.poses[0])
        covariances.append(found.covariances[0])
    return TrackEstimate(np.array(poses), np.array(covariances), freedom)


def _aligned(video: TrackVideo, *, motion: Motion | None) -> TrackEstimate:
    return of_result(align(video.shape, video.views, motion=motion, ransac=video.ransac))


def _online(video: TrackVideo) -> TrackEstimate:
    tracker = Tracker(video.shape, ransac=video.ransac)
    found = [tracker.update(view).pose for view in video.views]
    # The box is not known before the end: that of the category's mean stands for it.
    middle = video.shape.mean[-2:].mean(axis=0)
    return _estimate(
        [None if each is None else (each.alignment, each.covariance) for each in found], middle
    )


_SOLVERS: dict[str, Callable[[TrackVideo], TrackEstimate]] = {
    "frames": _frame_by_frame,
    "shared": partial(_aligned, motion=None),
    "smooth": partial(_aligned, motion=Motion()),
    "online": _online,
}
OWN_METHODS = {name: Method(name, solve) for name, solve in _SOLVERS.items()}
"""The experiment's methods by name."""
