"""Videos with a known answer, simulated ones of a data set's objects and KITTI's, and methods."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray, instance_rng
from cadalign.datasets import KeypointNet
from cadalign.datasets.photos.kitti_keypoints import (
    HIDDEN,
    TRACKS,
    KeypointFrame,
    car_shape,
    list_tracks,
    yaw_of_car,
)
from cadalign.errors import CadalignError, DataError, InputError
from cadalign.estimation.align import align
from cadalign.estimation.options import RansacOptions
from cadalign.estimation.result import Result
from cadalign.estimation.tracks.motion import Motion
from cadalign.estimation.tracks.tracker import Tracker
from cadalign.estimation.view import View
from cadalign.evaluation.benchmark import VIEW_NAMES, Benchmark, Case, Setting
from cadalign.evaluation.experiments.tracks import COLUMNS, METHODS, TracksOptions
from cadalign.evaluation.methods.method import Method, MethodInput
from cadalign.evaluation.metrics.cramer_rao import probability_level
from cadalign.evaluation.metrics.errors import (
    PoseErrors,
    absolute_pose_error,
    count_flips,
    relative_pose_error,
    rotation_jitter_deg,
)
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.work import Row, fingerprint
from cadalign.evaluation.shape_files import learn
from cadalign.evaluation.simulated_tracks import (
    simulate_track,
    with_correlated_errors,
    with_mistakes,
)
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import angles_between, vector_from_rotation
from cadalign.io.files import read_bytes
from cadalign.shapes.model import ShapeModel

_RATE, _KITTI_RATE = 30.0, 10.0  # frames in a second
_NOMINAL = 0.95


@dataclass(frozen=True, eq=False)
class TrackTask:
    """A video by name; small, so that workers make it."""

    category: str
    model_id: str
    made: Callable[[TracksOptions], tuple[Sequence[View], FloatArray]]
    """Makes the views, and the true poses (P, 12) of the object's axes and its box's centre."""

    @property
    def names(self) -> Row:
        """The cells that name a row."""
        return {"category": self.category, "model_id": self.model_id, "view": 0}


def simulated_video(
    options: TracksOptions, *, names: tuple[str, str], xyz: FloatArray, ids: IntArray
) -> tuple[Sequence[View], FloatArray]:
    """A video of an object of a data set; see `TrackTask`."""
    rng = instance_rng(options.seed, *names, "video")
    track = simulate_track(
        rng,
        xyz,
        ids.tolist(),
        frames=options.frames,
        noise_px=options.noise_px,
        visible=options.visible,
        rate=options.rate or _RATE,
    )
    if options.correlation:
        how = {"noise_px": options.noise_px, "correlation": options.correlation}
        track = with_correlated_errors(track, rng, **how)
    if options.flipped or options.outliers:
        how = {"flipped": options.flipped, "outliers": options.outliers}
        track = with_mistakes(track, rng, **how)
    views = [replace(view, sigma=options.sigma) for view in track.views]
    middle = (xyz.min(axis=0) + xyz.max(axis=0)) / 2
    return views, np.array([pose_of(each, middle) for each in track.poses])


def recorded_video(
    options: TracksOptions, *, frames: Sequence[KeypointFrame]
) -> tuple[Sequence[View], FloatArray]:
    """A track of a car; see `TrackTask`."""
    views, truth = [], []
    rate = options.rate or _KITTI_RATE
    for each in frames:
        photo = each.photo()
        (car,) = photo.objects
        assert car.keypoints is not None
        assert car.truth.box is not None
        assert photo.camera is not None
        known = car.keypoints.scores
        rows = np.flatnonzero(car.keypoints.visible if known is None else known >= HIDDEN)
        ids = [car.keypoints.names[row] for row in rows]
        pixels, time = car.keypoints.points_2d[rows], each.entry["frame"] / rate
        views.append(View(photo.camera, pixels, ids=ids, sigma=options.sigma, time=time))
        box = car.truth.box
        truth.append(np.concatenate([box.rotation.ravel(), box.center]))
    return views, np.array(truth)


def pose_of(alignment: Alignment, middle: FloatArray) -> FloatArray:
    """Pose (12,) of an object's axes and of a point (3,) of its model."""
    return np.concatenate([alignment.rotation.ravel(), alignment.apply([middle])[0]])


@lru_cache(maxsize=1)
def car_shape_of(root: Path, category: str) -> ShapeModel:
    """The shape of the cars of a folder, whatever their category is called."""
    shape = car_shape(root)
    if shape is None:
        fix = "give a folder with the mean car and its modes"
        raise DataError("there is no shape of the cars", where=str(root), fix=fix)
    return shape


# Methods ------------------------------------------------------------------------------------------


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


def _of_result(result: Result) -> TrackEstimate:
    middle = result.bounds.mean(axis=0)
    return _estimate(result.views, middle, result.degrees_of_freedom)


def _estimate(
    frames: Sequence[Any], middle: FloatArray, freedom: float | None = None
) -> TrackEstimate:
    """The estimate of frames, each with an alignment and its covariance, None without a pose."""
    poses, covariances = np.full((len(frames), 12), np.nan), np.full((len(frames), 3, 3), np.nan)
    for k, frame in enumerate(frames):
        if frame is not None:
            poses[k] = pose_of(frame.alignment, middle)
            if frame.covariance is not None:
                covariances[k] = frame.covariance[:3, :3]
    return TrackEstimate(poses, covariances, freedom)


def _frame_by_frame(video: TrackVideo) -> TrackEstimate:
    found, freedom = [], None
    for view in video.views:
        try:
            result = align(video.shape, view, ransac=video.ransac)
        except CadalignError:  # too few keypoints, or no consensus
            found.append(_estimate([None], np.zeros(3)))
        else:
            found.append(_of_result(result))
            freedom = result.degrees_of_freedom
    poses, covariances = ([getattr(e, name)[0] for e in found] for name in ("poses", "covariances"))
    return TrackEstimate(np.array(poses), np.array(covariances), freedom)


def _aligned(video: TrackVideo, *, motion: Motion | None) -> TrackEstimate:
    return _of_result(align(video.shape, video.views, motion=motion, ransac=video.ransac))


def _online(video: TrackVideo) -> TrackEstimate:
    tracker = Tracker(video.shape, ransac=video.ransac)
    found = [tracker.update(view).pose for view in video.views]
    # The box is not known before the end: that of the category's mean stands for it.
    return _estimate(found, video.shape.mean[-2:].mean(axis=0))


_SOLVERS: dict[str, Callable[[TrackVideo], TrackEstimate]] = {
    "frames": _frame_by_frame,
    "shared": partial(_aligned, motion=None),
    "smooth": partial(_aligned, motion=Motion()),
    "online": _online,
}
_METHODS = {name: Method(name, _SOLVERS[name]) for name in METHODS}


# Errors -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TrackVideos(Setting):
    """Videos of objects with what is known of their category's shape."""

    names = VIEW_NAMES
    columns = COLUMNS

    shape_of: Callable[[str], ShapeModel]  # the shape of a category
    options: TracksOptions
    has_yaw: bool  # they are KITTI's cars

    def case(self, task: TrackTask) -> Case:
        views, truth = task.made(self.options)
        count = float(np.mean([len(view.keypoint_ids) for view in views]))
        facts = {"frames": len(views), "keypoints": count}
        ransac = RansacOptions() if self.options.is_robust else None
        video = TrackVideo(self.shape_of(task.category), tuple(views), truth, ransac)
        return Case(task.names, facts, video)

    def given(self, video: TrackVideo) -> MethodInput:
        shape, first = video.shape, video.views[0]
        row_of: dict[Hashable, int] = {name: row for row, name in enumerate(shape.ids)}
        return MethodInput(
            shape.mean[[row_of[name] for name in first.keypoint_ids]],
            np.asarray(first.points_2d),
            first.camera,
            self.options.sigma,
            bounds=shape.mean[-2:],
            ransac=video.ransac,
            make_views=lambda: (shape, video.views),
        )

    def answered(
        self, method: Method, video: TrackVideo, answer: Alignment | Result
    ) -> TrackEstimate:
        if not isinstance(answer, Result) or len(answer.views) != len(video.views):
            what = f"{method.name} does not return the result of all views"
            raise InputError(what, where="methods", fix="take model and views, as align does")
        return _of_result(answer)

    def row(self, method: Method, video: TrackVideo, estimate: TrackEstimate) -> Row:
        return track_errors(estimate, video.truth, has_yaw=self.has_yaw)


def track_errors(estimate: TrackEstimate, gt: FloatArray, *, has_yaw: bool = False) -> Row:
    """Errors of an estimated track over the frames that it has, by column.

    ``gt`` (P, 12) are the true poses, ``has_yaw`` says that they are those of KITTI's cars. Motions
    and jitter are those of successive frames, NaN where none have a pose. Raises InputError if
    fewer than three frames have one.
    """
    has: BoolArray = np.asarray(np.isfinite(estimate.poses).all(axis=1))
    if has.sum() < 3:
        raise InputError(f"only {has.sum()} frames have a pose", where="frames")
    est, true = estimate.poses[has], gt[has]
    turns, true_turns = est[:, :9].reshape(-1, 3, 3), true[:, :9].reshape(-1, 3, 3)
    angles = angles_between(turns, true_turns)
    absolute = absolute_pose_error(est=est, gt=true)
    relative, jitter = PoseErrors(np.nan, np.nan), np.nan
    path = np.where(has[:, None], estimate.poses, np.nan)
    follows = has[1:] & has[:-1]
    if follows.any():
        relative = relative_pose_error(est=path, gt=gt)
    if (follows[1:] & follows[:-1]).any():
        jitter = rotation_jitter_deg(path)
    yaws = [yaw_of_car(a) - yaw_of_car(b) for a, b in zip(turns, true_turns, strict=True)]
    yaw = np.median(np.abs(np.angle(np.exp(1j * np.array(yaws))))) if has_yaw else np.nan
    levels = [
        probability_level(vector_from_rotation(a @ b.T), covariance, estimate.degrees_of_freedom)
        for a, b, covariance in zip(turns, true_turns, estimate.covariances[has], strict=True)
    ]
    stated = np.array([level for level in levels if level is not None])
    return {
        "found": float(has.mean()),
        "rotation_error_deg": float(np.median(angles)),
        "rotation_error_deg_90": float(np.percentile(angles, 90)),
        "yaw_error_deg": float(np.degrees(yaw)),
        "depth_error_relative": float(np.median(np.abs(est[:, 11] / true[:, 11] - 1))),
        "absolute_rotation_deg": absolute.rotation_deg,
        "absolute_translation": absolute.translation,
        "relative_rotation_deg": relative.rotation_deg,
        "relative_translation": relative.translation,
        "jitter_deg": jitter,
        "flips": count_flips(est=est, gt=true),
        "rotation_in_95": float((stated <= _NOMINAL).mean()) if len(stated) else np.nan,
    }


# Data sets ----------------------------------------------------------------------------------------

Videos = tuple[Sequence[TrackTask], Benchmark, str]
"""The tasks of a run, their benchmark, and the hash of all data."""


def simulated_videos(root: Path, options: TracksOptions, folder: RunFolder) -> Videos:
    """Videos of the objects of a split; the folder gets the shapes of the other one."""
    dataset = KeypointNet(root)
    objects = dataset.subset(categories=options.categories, split=options.split)
    if not objects.ids():
        raise DataError(f"no objects in the split {options.split}", where=str(root))
    learned = learn(dataset, objects.categories, split=options.train, folder=folder)
    tasks, parts = [], list[Any]()
    for category in objects.categories:
        shape = learned.shape(category)
        for model in list(objects[category])[: options.max_models]:
            known, names = model.keypoints, (category, model.model_id)
            has = np.isin(known.ids, shape.ids)
            own: dict[str, Any] = {"xyz": known.xyz[has], "ids": known.ids[has]}
            tasks.append(TrackTask(*names, partial(simulated_video, names=names, **own)))
            parts += [model.model_id, *own.values()]
    setting = TrackVideos(learned.shape, options, has_yaw=False)
    return tasks, _benchmark(setting), fingerprint(learned.fingerprint(), *parts)


def recorded_videos(root: Path, options: TracksOptions) -> Videos:
    """The tracks of a folder of KITTI's cars."""
    tracks: dict[tuple[int, int], list[KeypointFrame]] = defaultdict(list)
    for each in list_tracks(root / TRACKS):
        assert each.track is not None
        tracks[each.track.sequence, each.track.track].append(each)
    tasks = [
        TrackTask("Car", f"{sequence:04d}/{track}", partial(recorded_video, frames=frames))
        for (sequence, track), frames in list(tracks.items())[: options.max_models]
    ]
    car_shape_of(root, "Car")  # or it is said here that there is none
    setting = TrackVideos(partial(car_shape_of, root), options, has_yaw=True)
    return tasks, _benchmark(setting), fingerprint(read_bytes(root / TRACKS))


def _benchmark(setting: TrackVideos) -> Benchmark:
    options = setting.options
    return Benchmark.chosen(setting, options.methods, _METHODS, metrics=options.metrics)
