"""Tracks: accuracy over the bound, coverage, mistakes of detectors, real cars, times."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from benchmarks.section import (
    LIMIT_DRAWS,
    BenchmarkData,
    RatioTable,
    Row,
    clocked,
    figure,
    reference_seconds,
)
from cadalign import (
    Camera,
    Motion,
    RansacOptions,
    Result,
    ShapeModel,
    Tracker,
    View,
    align,
)
from cadalign.arrays import FloatArray
from cadalign.datasets import KeypointNet
from cadalign.datasets.photos.kitti_keypoints import HIDDEN, car_box, car_shape, yaw_of_car
from cadalign.evaluation.metrics.trajectories import rotation_jitter_deg
from cadalign.evaluation.simulation.tracks import SimulatedTrack, simulate_track, with_mistakes
from cadalign.geometry.rotations import vector_from_rotation

_RADIUS_95 = 7.815  # squared, of three degrees of freedom
_CAR_SIGMA = 3.0  # [px] of the network's keypoints
_CAR_RATE = 10.0  # frames in a second
_KEYPOINTS = 10


@dataclass
class Tracks:
    """Accuracy and times of tracks of learned shapes, simulated and real.

    Errors are over the bound, the inverse information of all evidence and priors, of which errors
    are drawn: the joint bound for views of unknown motion, that with the motion for smooth tracks.
    """

    categories: tuple[str, ...] = ("chair", "car", "mug")
    """Categories; those without held-out models in the data are left out."""
    objects: int = 12
    """Objects of each category."""
    frames: int = 40
    """Frames of a simulated video."""
    lengths: tuple[int, ...] = (100, 300, 1000, 3000)
    """Frames of the timed videos."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure all tables."""
        dataset = KeypointNet(given.needed("keypointnet"))
        learned = {name: _learned(dataset, name) for name in self.categories}
        yield RatioTable(
            "objects drawn from the learned shape, unknown motion, then smooth",
            [
                row
                for name, shape in learned.items()
                if shape is not None
                for row in self._accuracy(name, shape, given.seed)
            ],
        )
        yield RatioTable("10 % of frames flipped, 20 % of keypoints anywhere", self._mistakes())
        yield RatioTable("KITTI's tracks, every frame", list(_cars(given)))
        yield RatioTable("times of smooth tracks, 10 keypoints", list(self._times()))
        yield RatioTable("online", [_online()])

    def _accuracy(self, name: str, shape: ShapeModel, seed: int) -> Iterator[Row]:
        ways: dict[str, Motion | None] = {"joint": None, "smooth": Motion()}
        found: dict[str, list[FloatArray]] = {way: [] for way in ways}
        for number in range(self.objects):
            rng = np.random.default_rng([seed, number])
            video = simulate_track(rng, drawn(shape, rng), shape.ids, frames=self.frames)
            for way, motion in ways.items():
                result = align(shape, video.views, motion=motion)
                found[way].append(_compared(result, video, rng))
        for way, tables in found.items():
            errors, limits, covered, points = np.concatenate(tables).T
            yield {
                "category": name,
                "way": way,
                "R, deg": (float(np.median(errors)), float(np.percentile(errors, 90))),
                "over bound": float(np.median(errors) / np.median(limits)),
                "rms over bound": float(np.sqrt((errors**2).mean() / (limits**2).mean())),
                "95 % holds R, %": 100 * float(covered.mean()),
                "points, %": 100 * float(points.mean()),
            }

    def _mistakes(self) -> list[Row]:
        shape, rows = synthetic_category(), []
        for number in range(self.objects):
            rng = np.random.default_rng(number)
            video = simulate_track(rng, drawn(shape, rng), shape.ids, frames=60)
            wrong = with_mistakes(video, rng, flipped=0.1, outliers=0.2)
            clean = align(shape, video.views, motion="smooth")
            robust = align(shape, wrong.views, motion="smooth", ransac=RansacOptions())
            rows.append([np.median(_errors(each, video)) for each in (clean, robust)])
        clean_deg, robust_deg = np.array(rows).T
        return [
            {
                "clean, deg": float(np.median(clean_deg)),
                "with mistakes, deg": float(np.median(robust_deg)),
                "over clean": float(np.median(robust_deg) / np.median(clean_deg)),
            }
        ]

    def _times(self) -> Iterator[Row]:
        shape = synthetic_category()
        rng = np.random.default_rng(0)
        points = drawn(shape, rng)
        align(shape, simulate_track(rng, points, shape.ids, frames=5).views, motion="smooth")
        for frames in self.lengths:
            views = simulate_track(rng, points, shape.ids, frames=frames, visible=1.0).views
            _, joint, _ = clocked(lambda v=views: align(shape, v))
            reference = reference_seconds()
            wall, busy, result = clocked(lambda v=views: align(shape, v, motion="smooth"))
            tracemalloc.start()
            align(shape, views, motion="smooth")
            _, peak = tracemalloc.get_traced_memory()
            tracemalloc.stop()
            yield figure(f"track of {frames} frames", wall, "s", busy / reference) | {
                "processor, s": busy,
                "without motion, processor s": joint,
                "jitter, deg": rotation_jitter_deg(result.trajectory.poses),
                "memory, MB": peak / 1e6,
            }


def synthetic_category(seed: int = 0) -> ShapeModel:
    """A category of ten keypoints and five modes."""
    rng = np.random.default_rng(seed)
    mean = rng.uniform(-0.4, 0.4, (_KEYPOINTS, 3))
    modes = 0.05 * rng.normal(size=(5, _KEYPOINTS, 3))
    return ShapeModel.from_basis(mean, modes, np.ones(5), ids=range(_KEYPOINTS))


def drawn(shape: ShapeModel, rng: np.random.Generator) -> FloatArray:
    """Keypoints (m, 3) of an object of a learned shape."""
    weights = [component.weight for component in shape.components]
    component = shape.components[int(rng.choice(len(weights), p=np.array(weights) / sum(weights)))]
    modes = np.asarray(component.modes)
    points = component.mean + np.tensordot(rng.normal(size=len(modes)), modes, 1)
    rest = np.broadcast_to(component.residual_sigma, len(points))
    return np.asarray(points + rest[:, None] * rng.normal(size=points.shape))[: len(shape.ids)]


def _learned(dataset: KeypointNet, category: str) -> ShapeModel | None:
    """The category's shape without what calibrates it for objects that it was not learned from."""
    if category not in dataset.categories:
        return None
    shape = ShapeModel.from_dataset(dataset, category, meshes=False)
    return replace(shape, inflation=1.0, degrees_of_freedom=None, few_keypoints=None)


def _errors(result: Result, video: SimulatedTrack) -> FloatArray:
    """Rotation vectors' lengths (P,) of all frames' errors [deg]."""
    return np.degrees(np.linalg.norm(_turns(result, video), axis=1))


def _turns(result: Result, video: SimulatedTrack) -> FloatArray:
    pairs = zip(result.views, video.poses, strict=True)
    return np.array([vector_from_rotation(v.alignment.rotation @ p.rotation.T) for v, p in pairs])


def _compared(result: Result, video: SimulatedTrack, rng: np.random.Generator) -> FloatArray:
    """Error and bound [deg], and whether regions hold rotation and points (P, 4)."""
    rows = []
    known = result.points_covariance
    assert known is not None
    gaps = result.points_3d * result.alignment.scale - video.points_3d
    held = np.einsum("ni,nij,nj->n", gaps, np.linalg.pinv(known), gaps) < _RADIUS_95
    for turn, view in zip(_turns(result, video), result.views, strict=True):
        assert view.covariance is not None
        own = view.covariance[:3, :3]
        draws = rng.multivariate_normal(np.zeros(3), own, LIMIT_DRAWS)
        limit = np.sqrt((draws**2).sum(axis=1).mean())
        inside = turn @ np.linalg.solve(own, turn) < _RADIUS_95
        rows.append([np.linalg.norm(turn), limit, inside, held.mean()])
    return np.array(rows) * [*np.degrees([1.0, 1.0]), 1.0, 1.0]


# Real cars ----------------------------------------------------------------------------------------


def _cars(given: BenchmarkData) -> Iterator[Row]:
    """Yaw, depth and jitter of KITTI's tracks by four ways."""
    folder = given.needed("keypointnet").parent / "real" / "kitti_cars"
    shape = car_shape(folder)
    assert shape is not None
    table = msgspec.json.decode(Path(folder, "car_tracks.json").read_bytes())
    for way in ("frame by frame", "shape shared", "smooth", "smooth, robust", "online"):
        errors: list[FloatArray] = []
        jitters = []
        for track in table["tracks"]:
            views = [_car_view(frame, table["names"], track["K"]) for frame in track["frames"]]
            boxes = [
                car_box(
                    np.array(track["dims_hwl"]),
                    np.array(frame["location_bottom_centre"]),
                    frame["rotation_y"],
                )
                for frame in track["frames"]
            ]
            poses = _car_poses(shape, views, way)
            yaws = np.unwrap([yaw_of_car(pose[0]) for pose in poses])
            truth = np.array([yaw_of_car(box.rotation) for box in boxes])[-len(poses) :]
            depths = [pose[1][2] for pose in poses]
            real = np.array([box.center[2] for box in boxes])[-len(poses) :]
            turn = np.degrees((yaws - truth + np.pi) % (2 * np.pi) - np.pi)
            errors.append(np.column_stack([np.abs(turn), 100 * np.abs(depths / real - 1)]))
            jitters.append(np.degrees(np.diff(yaws, 2)))
        yaw, depth = np.concatenate(errors).T
        yield {
            "way": way,
            "frames": len(yaw),
            "yaw, deg": (float(np.median(yaw)), float(np.percentile(yaw, 90))),
            "depth, %": float(np.median(depth)),
            "jitter, deg": float(np.concatenate(jitters).std()),
        }


def _car_view(frame: dict[str, object], names: list[str], matrix: list[list[float]]) -> View:
    (fx, _, cx), (_, fy, cy), _ = matrix
    shown = np.flatnonzero(np.array(frame["score"]) >= HIDDEN)
    camera = Camera(1242, 375, fx, fy, cx + 0.5, cy + 0.5)
    pixels, ids = np.array(frame["uv"])[shown], [names[row] for row in shown]
    time = float(str(frame["frame"])) / _CAR_RATE
    return View(camera, pixels, ids=ids, sigma=_CAR_SIGMA, time=time)


def _car_poses(
    shape: ShapeModel, views: list[View], way: str
) -> list[tuple[FloatArray, FloatArray]]:
    """Rotation and the box's centre in the camera of every frame."""
    if way == "frame by frame":
        results = [align(shape, view) for view in views]
        return [(r.alignment.rotation, r.alignment.apply(_middle(r))[0]) for r in results]
    if way == "online":
        tracker = Tracker(shape)
        found = [tracker.update(view).pose for view in views]
        middle = _middle(tracker.smooth())
        known = [each.alignment for each in found if each is not None]
        return [(each.rotation, each.apply(middle)[0]) for each in known]
    ransac = RansacOptions() if "robust" in way else None
    motion = None if way == "shape shared" else Motion()
    result = align(shape, views, motion=motion, ransac=ransac)
    middle = _middle(result)
    return [(v.alignment.rotation, v.alignment.apply(middle)[0]) for v in result.views]


def _middle(result: Result) -> FloatArray:
    return result.bounds.mean(axis=0)[None]


# Online -------------------------------------------------------------------------------------------


def _online() -> Row:
    """Time of updates, and errors of the newest frame over those of the whole smooth track."""
    shape, rng = synthetic_category(), np.random.default_rng(0)
    video = simulate_track(rng, drawn(shape, rng), shape.ids, frames=300)
    seconds, busy, errors = [], [], []
    tracker = Tracker(shape)
    for view, pose in zip(video.views, video.poses, strict=True):
        wall, own, update = clocked(lambda v=view: tracker.update(v))
        busy.append(own)
        seconds.append(wall)
        if update.pose is not None:
            turn = update.pose.alignment.rotation @ pose.rotation.T
            errors.append(np.degrees(np.linalg.norm(vector_from_rotation(turn))))
    whole = np.median(_errors(tracker.smooth(), video))
    warm = 1e3 * np.array(seconds[20:])
    return {
        "processor, median, ms": 1e3 * float(np.median(busy[20:])),
        "median, ms": float(np.median(warm)),
        "99 %, ms": float(np.percentile(warm, 99)),
        "R, deg": float(np.median(errors)),
        "R of the whole track, deg": float(whole),
    }
