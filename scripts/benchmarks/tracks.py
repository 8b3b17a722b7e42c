"""Tracks: accuracy over the bound, coverage, mistakes of detectors, real cars, times."""

from __future__ import annotations

import tempfile
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks import section
from benchmarks.cars import car_tracks
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign import Motion, RansacOptions, Result, ShapeModel, Tracker, align
from cadalign.arrays import FloatArray
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.evaluation.metrics.errors import rotation_jitter_deg
from cadalign.evaluation.simulated_tracks import SimulatedTrack, simulate_track, with_mistakes
from cadalign.metrics import rotation_error

_RADIUS_95 = 7.815  # squared, of three degrees of freedom
_KEYPOINTS = 10
_SAMPLE_MODELS = 60


def tracks(
    given: BenchmarkData,
    *,
    categories: tuple[str, ...] = ("chair", "car", "mug"),
    objects: int = 60,
    frames: int = 40,
    lengths: tuple[int, ...] = (100, 300, 1000, 3000),
) -> Tables:
    """Accuracy and times of tracks of learned shapes, simulated and real.

    Errors are over the bound, the inverse information of all evidence and priors, of which errors
    are drawn: the joint bound for views of unknown motion, that with the motion for smooth tracks.

    Parameters
    ----------
    categories : tuple[str, ...]
        Categories of KeypointNet, or of the sample data where it has none.
    objects : int
        Objects of each category.
    frames : int
        Frames of a simulated video.
    lengths : tuple[int, ...]
        Frames of the timed videos.
    """
    dataset, rows = KeypointNet(given.needed()), []
    for name in categories:
        shape = _learned(dataset, name)
        # Objects are drawn from it: nothing calibrates it for those that it did not learn.
        plain = {"inflation": 1.0, "degrees_of_freedom": None, "few_keypoints": None}
        rows += _accuracy(name, replace(shape, **plain), given.seed, objects, frames)
    yield "objects drawn from the learned shape, unknown motion, then smooth", rows
    yield "10 % of frames flipped, 20 % of keypoints anywhere", [_mistakes(objects)]
    yield "KITTI's tracks, every frame", car_tracks(given.real("kitti_cars"))
    yield "times of smooth tracks, 10 keypoints", _times(lengths)
    yield "online", [_online()]


def _learned(dataset: KeypointNet, name: str) -> ShapeModel:
    if name in dataset.categories:
        return ShapeModel.from_dataset(dataset, name, meshes=False)
    with tempfile.TemporaryDirectory() as folder:
        written = write_sample_dataset(folder, per_category=_SAMPLE_MODELS, categories=[name])
        return ShapeModel.from_dataset(KeypointNet(written), name, meshes=False)


def _accuracy(name: str, shape: ShapeModel, seed: int, objects: int, frames: int) -> Iterator[Row]:
    ways: dict[str, Motion | None] = {"joint": None, "smooth": Motion()}
    found: dict[str, list[FloatArray]] = {way: [] for way in ways}
    for number in range(objects):
        rng = np.random.default_rng([seed, number])
        video = _video(rng, shape, frames=frames)
        for way, motion in ways.items():
            result = align(shape, video.views, motion=motion)
            found[way].append(_compared(result, video, rng))
    for way, tables in found.items():
        errors, limits, covered, points = np.concatenate(tables).T
        yield {
            "category": name,
            "way": way,
            "R, deg": section.spread(errors),
            "over bound": float(np.median(errors) / np.median(limits)),
            "rms over bound": float(np.sqrt((errors**2).mean() / (limits**2).mean())),
            "95 % holds R, %": section.percent(covered),
            "points, %": section.percent(points),
        }


def _mistakes(objects: int) -> Row:
    shape, rows = _synthetic_category(), []
    for number in range(objects):
        rng = np.random.default_rng(number)
        video = _video(rng, shape, frames=60)
        wrong = with_mistakes(video, rng, flipped=0.1, outliers=0.2)
        clean = align(shape, video.views, motion="smooth")
        robust = align(shape, wrong.views, motion="smooth", ransac=RansacOptions())
        rows.append([np.median(_errors(each, video)) for each in (clean, robust)])
    clean_deg, robust_deg = np.median(rows, axis=0).tolist()
    names = ("clean, deg", "with mistakes, deg", "over clean")
    return dict(zip(names, (clean_deg, robust_deg, robust_deg / clean_deg), strict=True))


def _times(lengths: tuple[int, ...]) -> Iterator[Row]:
    shape, rng = _synthetic_category(), np.random.default_rng(0)
    points = _drawn(shape, rng)
    align(shape, simulate_track(rng, points, shape.ids, frames=5).views, motion="smooth")
    for frames in lengths:
        views = simulate_track(rng, points, shape.ids, frames=frames, visible=1.0).views
        _, joint, _ = section.clocked(lambda v=views: align(shape, v))
        reference = section.reference_seconds()
        wall, busy, result = section.clocked(lambda v=views: align(shape, v, motion="smooth"))
        tracemalloc.start()
        align(shape, views, motion="smooth")
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        yield section.figure(f"track of {frames} frames", wall, "s", busy / reference) | {
            "processor, s": busy,
            "without motion, processor s": joint,
            "jitter, deg": rotation_jitter_deg(result.trajectory.poses),
            "memory, MB": peak / 1e6,
        }


def _synthetic_category() -> ShapeModel:
    rng = np.random.default_rng(0)
    mean = rng.uniform(-0.4, 0.4, (_KEYPOINTS, 3))
    modes = 0.05 * rng.normal(size=(5, _KEYPOINTS, 3))
    return ShapeModel.from_basis(mean, modes, np.ones(5), ids=range(_KEYPOINTS))


def _drawn(shape: ShapeModel, rng: np.random.Generator) -> FloatArray:
    """Keypoints (m, 3) of an object of a learned shape."""
    weights = [component.weight for component in shape.components]
    component = shape.components[int(rng.choice(len(weights), p=np.array(weights) / sum(weights)))]
    modes = np.asarray(component.modes)
    points = component.mean + np.tensordot(rng.normal(size=len(modes)), modes, 1)
    rest = np.broadcast_to(component.residual_sigma, len(points))
    return np.asarray(points + rest[:, None] * rng.normal(size=points.shape))[: len(shape.ids)]


def _video(rng: np.random.Generator, shape: ShapeModel, *, frames: int) -> SimulatedTrack:
    return simulate_track(rng, _drawn(shape, rng), shape.ids, frames=frames)


def _errors(result: Result, video: SimulatedTrack) -> list[float]:
    """Rotation errors of all frames [deg]."""
    pairs = zip(result.views, video.poses, strict=True)
    return [rotation_error(est=view.alignment, gt=pose) for view, pose in pairs]


def _compared(result: Result, video: SimulatedTrack, rng: np.random.Generator) -> FloatArray:
    """Error and bound [deg], and whether regions hold rotation and points (P, 4)."""
    rows = []
    gaps = result.points_3d * result.alignment.scale - video.points_3d
    inverse = np.linalg.pinv(result.points_covariance)
    held = np.einsum("ni,nij,nj->n", gaps, inverse, gaps) < _RADIUS_95
    for view, pose in zip(result.views, video.poses, strict=True):
        turn = section.deviation(est=view.alignment, gt=pose)[:3]
        own = view.covariance[:3, :3]
        draws = rng.multivariate_normal(np.zeros(3), own, section.LIMIT_DRAWS)
        limit = np.sqrt((draws**2).sum(axis=1).mean())
        inside = turn @ np.linalg.solve(own, turn) < _RADIUS_95
        rows.append([*np.degrees([np.linalg.norm(turn), limit]), inside, held.mean()])
    return np.array(rows)


def _online() -> Row:
    """Time of updates, and errors of the newest frame over those of the whole smooth track."""
    shape, rng = _synthetic_category(), np.random.default_rng(0)
    video = _video(rng, shape, frames=300)
    walls, busy, errors = [], [], []
    tracker = Tracker(shape)
    for view, pose in zip(video.views, video.poses, strict=True):
        wall, own, update = section.clocked(lambda v=view: tracker.update(v))
        busy.append(1e3 * own)
        walls.append(1e3 * wall)
        if update.pose is not None:
            errors.append(rotation_error(est=update.pose.alignment, gt=pose))
    return {
        "processor, median, ms": float(np.median(busy[20:])),
        "median, ms": float(np.median(walls[20:])),
        "99 %, ms": float(np.percentile(walls[20:], 99)),
        "R, deg": float(np.median(errors)),
        "R of the whole track, deg": float(np.median(_errors(tracker.smooth(), video))),
    }
