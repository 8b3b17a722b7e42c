"""Videos with a known answer: simulated ones of a data set's objects, and KITTI's cars."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.datasets import KeypointNet
from cadalign.datasets.photos.kitti_keypoints import (
    HIDDEN,
    SIZE,
    TRACKS,
    KeypointFrame,
    car_shape,
    list_tracks,
    yaw_of_car,
)
from cadalign.errors import DataError, InputError
from cadalign.estimation.options import RansacOptions
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.evaluation.benchmark import VIEW_NAMES, Benchmark, Case, Setting
from cadalign.evaluation.experiments.tracks import COLUMNS, TracksOptions
from cadalign.evaluation.instances.unseen import probability_level
from cadalign.evaluation.methods.method import Method, MethodInput
from cadalign.evaluation.methods.tracks import OWN_METHODS, TrackEstimate, TrackVideo, of_result
from cadalign.evaluation.metrics.trajectories import (
    absolute_pose_error,
    count_flips,
    relative_pose_error,
    rotation_jitter_deg,
)
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Row
from cadalign.evaluation.runs.work import fingerprint
from cadalign.evaluation.shape_files import LearnedFiles, learn
from cadalign.evaluation.simulation.tracks import (
    simulate_track,
    with_correlated_errors,
    with_mistakes,
)
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import angles_between, vector_from_rotation
from cadalign.io.files import read_bytes
from cadalign.seeding import instance_rng
from cadalign.shapes.model import ShapeModel

_RATE, _KITTI_RATE = 30.0, 10.0  # frames in a second
_NOMINAL = 0.95


@dataclass(frozen=True, eq=False)
class TrackTask:
    """A video by name; small, so that workers make it."""

    category: str
    model_id: str

    @property
    def names(self) -> Row:
        """The cells that name a row."""
        return {"category": self.category, "model_id": self.model_id, "view": 0}

    def video(self, options: TracksOptions) -> tuple[Sequence[View], FloatArray]:
        """The views, and the true poses (P, 12) of the object's axes and its box's centre."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class SimulatedVideo(TrackTask):
    """A video of an object of a data set."""

    xyz: FloatArray
    ids: IntArray

    def video(self, options: TracksOptions) -> tuple[Sequence[View], FloatArray]:
        rng = instance_rng(options.seed, self.category, self.model_id, "video")
        track = simulate_track(
            rng,
            self.xyz,
            self.ids.tolist(),
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
        middle = (self.xyz.min(axis=0) + self.xyz.max(axis=0)) / 2
        return views, np.array([pose_of(each, middle) for each in track.poses])


@dataclass(frozen=True, eq=False)
class RecordedVideo(TrackTask):
    """A track of a car."""

    frames: tuple[KeypointFrame, ...]

    def video(self, options: TracksOptions) -> tuple[Sequence[View], FloatArray]:
        views, truth = [], []
        rate = options.rate or _KITTI_RATE
        for each in self.frames:
            photo = each.photo(SIZE)
            (car,) = photo.objects
            assert car.keypoints is not None
            assert car.truth.box is not None
            assert photo.camera is not None
            known = car.keypoints.scores
            shown = car.keypoints.visible if known is None else known >= HIDDEN
            rows = np.flatnonzero(shown)
            ids = [car.keypoints.names[row] for row in rows]
            pixels, time = car.keypoints.points_2d[rows], each.entry["frame"] / rate
            views.append(View(photo.camera, pixels, ids=ids, sigma=options.sigma, time=time))
            box = car.truth.box
            truth.append(np.concatenate([box.rotation.ravel(), box.center]))
        return views, np.array(truth)


def pose_of(alignment: Alignment, middle: FloatArray) -> FloatArray:
    """Pose (12,) of an object's axes and of a point (3,) of its model."""
    return np.concatenate([alignment.rotation.ravel(), alignment.apply([middle])[0]])


@dataclass(frozen=True)
class CarShape:
    """The shape of the cars of a folder; small, as `LearnedFiles` are."""

    root: Path

    def shape(self, category: str) -> ShapeModel:
        """The shape, whatever the category is called."""
        return _car_shape(self.root)


@lru_cache(maxsize=1)
def _car_shape(root: Path) -> ShapeModel:
    shape = car_shape(root)
    if shape is None:
        fix = "give a folder with the mean car and its modes"
        raise DataError("there is no shape of the cars", where=str(root), fix=fix)
    return shape


@dataclass(frozen=True)
class TrackVideos(Setting):
    """Videos of objects with what is known of their category's shape."""

    names = VIEW_NAMES
    columns = COLUMNS

    shapes: LearnedFiles | CarShape
    options: TracksOptions

    def case(self, task: TrackTask) -> Case:
        views, truth = task.video(self.options)
        count = float(np.mean([len(view.keypoint_ids) for view in views]))
        facts = {"frames": len(views), "keypoints": count}
        ransac = RansacOptions() if self.options.is_robust else None
        shape = self.shapes.shape(task.category)
        return Case(task.names, facts, TrackVideo(shape, tuple(views), truth, ransac))

    def given(self, instance: TrackVideo) -> MethodInput:
        shape, first = instance.shape, instance.views[0]
        row_of: dict[Hashable, int] = {name: row for row, name in enumerate(shape.ids)}
        rows = [row_of[name] for name in first.keypoint_ids]
        return MethodInput(
            shape.mean[rows],
            np.asarray(first.points_2d),
            first.camera,
            self.options.sigma,
            bounds=shape.mean[-2:],
            ransac=instance.ransac,
            make_views=lambda: (shape, instance.views),
        )

    def answered(
        self, method: Method, instance: TrackVideo, answer: Alignment | Result
    ) -> TrackEstimate:
        if not isinstance(answer, Result) or len(answer.views) != len(instance.views):
            what = f"{method.name} does not return the result of all views"
            raise InputError(what, where="methods", fix="take model and views, as align does")
        return of_result(answer)

    def row(self, method: Method, instance: TrackVideo, estimate: TrackEstimate) -> Row:
        return track_errors(estimate, instance.truth, has_yaw=isinstance(self.shapes, CarShape))


def track_errors(estimate: TrackEstimate, gt: FloatArray, *, has_yaw: bool = False) -> Row:
    """Errors of an estimated track over the frames that it has, by column.

    ``gt`` (P, 12) are the true poses, ``has_yaw`` says that they are those of KITTI's cars. Raises
    InputError if fewer than three frames have a pose.
    """
    has = np.isfinite(estimate.poses).all(axis=1)
    if has.sum() < 3:
        raise InputError(f"only {has.sum()} frames have a pose", where="frames")
    est, true = estimate.poses[has], gt[has]
    turns, true_turns = est[:, :9].reshape(-1, 3, 3), true[:, :9].reshape(-1, 3, 3)
    angles = angles_between(turns, true_turns)
    absolute, relative = (f(est=est, gt=true) for f in (absolute_pose_error, relative_pose_error))
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
        "jitter_deg": rotation_jitter_deg(est),
        "flips": count_flips(est=est, gt=true),
        "rotation_in_95": float((stated <= _NOMINAL).mean()) if len(stated) else np.nan,
    }


@dataclass(frozen=True, eq=False)
class PlannedVideos:
    """The tasks of a run, their benchmark, and the hash of all data."""

    tasks: Sequence[TrackTask]
    benchmark: Benchmark
    fingerprint: str


def simulated_videos(root: Path, options: TracksOptions, folder: RunFolder) -> PlannedVideos:
    """Videos of the objects of a split; the folder gets the shapes of the other one."""
    dataset = KeypointNet(root)
    objects = dataset.subset(categories=options.categories, split=options.split)
    if not objects.ids():
        raise DataError(f"no objects in the split {options.split}", where=str(root))
    learned = learn(dataset, objects.categories, split=options.train, folder=folder)
    tasks = []
    for category in objects.categories:
        shape = learned.shape(category)
        for model in list(objects[category])[: options.max_models]:
            known = model.keypoints
            has = np.isin(known.ids, shape.ids)
            tasks.append(SimulatedVideo(category, model.model_id, known.xyz[has], known.ids[has]))
    parts = [part for each in tasks for part in (each.model_id, each.xyz, each.ids)]
    benchmark = _benchmark(learned, options)
    return PlannedVideos(tasks, benchmark, fingerprint(learned.fingerprint(), *parts))


def recorded_videos(root: Path, options: TracksOptions, folder: RunFolder) -> PlannedVideos:
    """The tracks of a folder of KITTI's cars."""
    tracks: dict[tuple[int, int], list[KeypointFrame]] = defaultdict(list)
    for each in list_tracks(root / TRACKS):
        if isinstance(each, DataError):
            raise each
        assert each.track is not None
        tracks[each.track.sequence, each.track.track].append(each)
    tasks = [
        RecordedVideo("Car", f"{sequence:04d}/{track}", tuple(frames))
        for (sequence, track), frames in list(tracks.items())[: options.max_models]
    ]
    _car_shape(root)  # or it is said here that there is none
    benchmark = _benchmark(CarShape(root), options)
    return PlannedVideos(tasks, benchmark, fingerprint(read_bytes(root / TRACKS)))


def _benchmark(shapes: LearnedFiles | CarShape, options: TracksOptions) -> Benchmark:
    setting = TrackVideos(shapes, options)
    return Benchmark.chosen(setting, options.methods, OWN_METHODS, metrics=options.metrics)
