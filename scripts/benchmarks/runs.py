"""Whole runs: evaluations, fits of many observations, and searches in real correspondences."""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import poselib
from common import COMMAND
from scipy.spatial.transform import Rotation

import cadalign
from benchmarks.section import (
    BenchmarkData,
    NotGivenError,
    RatioTable,
    Row,
    Used,
    clocked,
    dask_over_processes,
    figure,
    processor_seconds,
    rate_and_memory,
    reference_seconds,
    seconds,
    used_by_command,
)
from cadalign import Alignment, Box, Camera, Observation, RansacOptions, Result
from cadalign.arrays import FloatArray
from cadalign.batch.experiment import LARGEST_CHUNK
from cadalign.datasets import Bundler, Colmap, Correspondences, KeypointNet, write_sample_dataset
from cadalign.datasets import open as open_data
from cadalign.datasets.photos.kitti_keypoints import car_bounds, car_shape, yaw_of_car
from cadalign.evaluation.experiments.keypointnet import KeypointNetOptions
from cadalign.evaluation.instances.correspondences import errors_of, spoil
from cadalign.evaluation.instances.views import KeypointTasks, keypointnet_benchmark
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.simulation.problems import Problem

_POINTS = 8
_LEAST_CAR_KEYPOINTS = 6
_CAMERA = Camera(640, 480, 700.0, 700.0, 319.5, 239.5)
_CHUNK = 100
_SEARCH = {"max_reproj_error": 4.0, "success_prob": 0.9999}
_OPENCV_DRAWS = 2  # it takes the better part of a second


# Evaluation ---------------------------------------------------------------------------------------


@dataclass
class Evaluation:
    """Instances a second by one core, and of whole runs on two.

    Whole runs are commands with two worker processes, or with two workers of a Dask cluster, with
    rates and ratios as of `rate_and_memory`: neither start nor figures are in them. Other ratios
    are processor time over `reference_seconds`; Dask's is its time over that of processes.
    """

    count: int = 2000
    """Instances on annotations alone."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure annotations, runs and Dask."""
        root = given.needed("keypointnet")
        rows = [_on_annotations(root, self.count, method) for method in ("aepnp", "optimal")]
        yield RatioTable("Evaluation in one process", rows)
        with tempfile.TemporaryDirectory() as folder:
            samples = write_sample_dataset(Path(folder) / "samples", per_category=12)
            on_hulls = ("--visibility=hull", "--methods=aepnp")
            overlays = ("--methods=optimal", "--render=overlay")
            rows = [
                *_whole_runs("run on annotations", root, *on_hulls, views=(4, 16)),
                *_whole_runs("run with overlays", samples, *overlays, views=(1, 4)),
                dask_over_processes(
                    "run by Dask over one by processes",
                    partial(_used_by_run, root, "--visibility=hull", views=3),
                ),
            ]
        yield RatioTable("Whole runs", rows)


def _on_annotations(root: Path, count: int, method: str) -> Row:
    """Rate of instances whose meshes are not looked at."""
    options = KeypointNetOptions(root, visibility="hull", methods=(method,))
    tasks = KeypointTasks(KeypointNet(root), options)
    experiment = keypointnet_benchmark(options)
    experiment.warm_up()
    count = min(count, len(tasks))

    def evaluate_all() -> None:
        for start in range(0, count, _CHUNK):
            experiment.evaluate(tasks[start : min(start + _CHUNK, count)])

    reference = reference_seconds()
    busy = processor_seconds(evaluate_all)
    reference = min(reference, reference_seconds())
    name = f"evaluation on annotations, {method}"
    return figure(name, count / busy, "1/s", 1e3 * busy / count / reference)


def _used_by_run(root: Path, *options: str, views: int) -> Used:
    """Run the command in a folder of its own, and measure it with its workers."""
    with tempfile.TemporaryDirectory() as folder:
        call = ["evaluate", "keypointnet", str(root), f"--views-per-model={views}", *options]
        return used_by_command([*call, f"--out={folder}/run", "--json"])


def _whole_runs(name: str, root: Path, *options: str, views: tuple[int, int]) -> Iterator[Row]:
    few, many = views
    return rate_and_memory(
        f"{name}, two processes",
        f"{name}, memory of {many} over {few} views",
        (many - few) * len(KeypointNet(root)),
        lambda k: _used_by_run(root, *options, "--workers=2", views=views[k]),
    )


# Observations ------------------------------------------------------------------------------------


@dataclass
class Fits:
    """Observations a second of whole runs by two processes, and memory.

    Rates and ratios are those of `rate_and_memory`; Dask's is its time over that of processes. A
    run that is killed again and again, and one that loses a Dask worker, must give the bytes of one
    that nothing happens to.
    """

    sizes: tuple[int, int] = (25_000, 100_000)
    """Observations of the shorter and of the longer run."""
    methods: tuple[str, ...] = ("aepnp", "optimal")
    """Methods of the fits."""
    dask: bool = True
    """Compare two Dask workers with two processes on the shorter run."""
    kills: int = 5
    """Times that the longer run is killed."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure rates, memory and Dask."""
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            files = [write_observations(folder, count, given.seed) for count in self.sizes]
            for method in self.methods:
                rows = rate_and_memory(
                    f"fits by {method}, two processes",
                    f"fits by {method}, memory",
                    self.sizes[1] - self.sizes[0],
                    lambda k, how=f"--method={method}": _used(files[k], how, "--workers=2"),
                )
                yield RatioTable(f"Fits of {_POINTS} keypoints", list(rows))
            if self.dask:
                name = "fits by Dask over those by processes"
                row = dask_over_processes(name, partial(_used, files[0], "--method=aepnp"))
                yield RatioTable("Fits on a cluster", [row])
            if self.kills:
                yield RatioTable("Interrupted", list(self._interrupted(files[1])))

    def _interrupted(self, file: Path) -> Iterator[Row]:
        """Compare the tables of interrupted runs with those of one that was left alone."""
        folders = {name: RunFolder(file.with_name(name)) for name in ("calm", "killed", "lost")}
        calls = {
            name: [*COMMAND, "fit", str(file), f"--out={each.path}", "--no-picture"]
            for name, each in folders.items()
        }
        method = "--method=aepnp"
        subprocess.run([*calls["calm"], method, "--workers=2"], check=True)
        chunks = self.sizes[1] // LARGEST_CHUNK
        for kill in range(self.kills + 1):
            process = subprocess.Popen([*calls["killed"], method, "--workers=2"])
            if kill < self.kills:
                _wait_for(folders["killed"], chunks * (kill + 1) // (self.kills + 1), process)
                process.kill()
            process.wait()
        yield _same_bytes(f"killed {self.kills} times", folders["calm"], folders["killed"])
        if not self.dask:
            return
        from distributed import LocalCluster

        with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
            process = subprocess.Popen(
                [*calls["lost"], method, f"--dask={cluster.scheduler_address}"]
            )
            _wait_for(folders["lost"], chunks // 2, process)
            os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL)
            process.wait()
        yield _same_bytes("a Dask worker killed", folders["calm"], folders["lost"])


def _wait_for(folder: RunFolder, chunks: int, process: subprocess.Popen[bytes]) -> None:
    """Wait until a run has done so many chunks."""
    while len(list(folder.parts.glob("???????.parquet"))) < chunks:
        if process.poll() is not None:
            raise SystemExit(f"{folder.path.name}: the run ended before it was interrupted")
        time.sleep(0.05)


def _same_bytes(name: str, calm: RunFolder, other: RunFolder) -> Row:
    """A row that says so; SystemExit where a table differs."""
    for path in (calm.results, calm.records, calm.path / "results.csv"):
        if (other.path / path.name).read_bytes() != path.read_bytes():
            raise SystemExit(f"{name}: {path.name} differs from that of the run left alone")
    return {"run": name, "bytes": "the same"}


def write_observations(folder: Path, count: int, seed: int) -> Path:
    """Write observations of one model in random poses, stretched, with 1 px of noise."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (_POINTS, 3))
    turns = Rotation.random(count, random_state=rng).as_matrix()
    scales = np.exp(rng.uniform(-0.5, 0.5, (count, 3)))
    scales[:, 0] = 1
    path = folder / f"{count}.jsonl"
    camera = _CAMERA.to_dict()
    with path.open("wb") as file:
        for turn, scale in zip(turns, scales, strict=True):
            pixels = _CAMERA.project(points * scale @ turn.T + [0.0, 0.0, 6.0])
            pixels += rng.normal(0, 1, pixels.shape)
            pairs = zip(points.tolist(), pixels.round(2).tolist(), strict=True)
            keypoints = [{"xyz": xyz, "uv": uv} for xyz, uv in pairs]
            file.write(msgspec.json.encode({"camera": camera, "keypoints": keypoints}) + b"\n")
    return path


def _used(file: Path, *options: str) -> Used:
    with tempfile.TemporaryDirectory() as folder:
        return used_by_command(["fit", str(file), f"--out={folder}/run", "--no-picture", *options])


@dataclass
class RealDetections:
    """Runs over real keypoints of networks: share aligned, errors of yaw and depth.

    Cars are all frames of KITTI with at least 6 keypoints that score 0.1, aligned with a mean car
    or with a learned shape; web photos are those of PASCAL3D+, whose poses and focal lengths are
    not known. Errors are medians, of yaw with the 90th percentile in parentheses.
    """

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure all ways to align."""
        if given.keypointnet is None:
            raise NotGivenError("set CADALIGN_DATA to the folder of the data")
        real = given.keypointnet.parent / "real"
        cars = list(_cars(real / "kitti_cars"))
        with tempfile.TemporaryDirectory() as folder:
            shape = Path(folder, "car.shape")
            learned = car_shape(real / "kitti_cars")
            assert learned is not None
            learned.save(shape)
            rows = [
                self._row(name, cars, real / "pascal3d" / "observations", options)
                for name, options in _ways(shape).items()
            ]
        yield RatioTable(f"{len(cars)} cars, and web photos", rows)

    def _row(
        self,
        name: str,
        cars: list[tuple[Observation, Box, FloatArray]],
        web: Path,
        options: dict[str, Any],
    ) -> Row:
        found = cadalign.fit_many((seen for seen, _, _ in cars), **options)
        errors = [
            _car_errors(each, box, middle)
            for each, (_, box, middle) in zip(found, cars, strict=True)
            if isinstance(each, Result)
        ]
        yaw, depth = np.array(errors).T
        row = {"cars aligned": f"{len(yaw)} of {len(cars)}"}
        row |= {"yaw, deg": (float(np.median(yaw)), float(np.percentile(yaw, 90)))}
        row |= {"depth, %": 100 * float(np.median(depth))}
        if "shape" not in options:  # that of cars is not theirs
            photos = cadalign.fit_many(web, **options)
            row |= {"web photos aligned": f"{int(photos.solved.sum())} of {len(photos)}"}
        return {"cadalign fit": name} | row


def _ways(shape: Path) -> dict[str, dict[str, Any]]:
    """Options of `cadalign.fit_many` by those of the command."""
    learned = {"shape": shape, "sigma": 3.0}
    return {
        "plain": {},
        "--robust": {"robust": True},
        "--loss cauchy": {"loss": "cauchy"},
        "--similar": {"similar": True},
        "--similar --robust": {"similar": True, "robust": True},
        "--similar --loss cauchy": {"similar": True, "loss": "cauchy"},
        "--shape --sigma 3": learned,
        "--shape --sigma 3 --robust": learned | {"robust": True},
        "--shape --sigma 3 --loss cauchy": learned | {"loss": "cauchy"},
    }


def _cars(folder: Path) -> Iterator[tuple[Observation, Box, FloatArray]]:
    """Observations of a mean car's keypoints, the car's true box, and the mean car's middle."""
    for photo in open_data(folder):
        for each in photo.objects:
            seen, truth = each.keypoints, each.truth
            if seen is None or truth is None or truth.box is None or photo.camera is None:
                continue
            kept = np.flatnonzero(seen.visible)
            if len(kept) < _LEAST_CAR_KEYPOINTS or each.model is None:
                continue
            known = each.model.source.keypoints
            names = tuple(seen.names[k] for k in kept)
            points = known.xyz[[known.names.index(name) for name in names]]
            observed = Observation(points, seen.points_2d[kept], photo.camera, names=names)
            yield observed, truth.box, car_bounds(known.xyz).mean(axis=0)


def _car_errors(found: Result, box: Box, middle: FloatArray) -> tuple[float, float]:
    """Errors of yaw [deg], and of the centre's depth relative to it."""
    turn = yaw_of_car(found.alignment.rotation) - yaw_of_car(box.rotation)
    yaw = abs((turn + np.pi) % (2 * np.pi) - np.pi)
    center = found.bounds.mean(axis=0) if found.method == "align" else middle
    depth = found.alignment.apply(center[None])[0, 2]
    return float(np.degrees(yaw)), float(abs(depth / box.center[2] - 1))


# Robust search ------------------------------------------------------------------------------------


@dataclass
class Ransac:
    """The robust search on real correspondences: success, and time over PoseLib's and OpenCV's.

    Images are those of `cadalign evaluate correspondences`: scales are drawn anew for every image
    and draw, and a share of the points is moved to anywhere. PoseLib and OpenCV get the true
    scales: they solve the easier problem without stretch.
    """

    draws: int = 20
    """Draws of scales and outliers for each image."""
    outliers: tuple[float, ...] = (0.0, 0.2, 0.5, 0.8, 0.9)
    """Shares of outliers among the image points."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure both models and all shares of outliers."""
        colmap, bundler = given.needed("colmap"), given.needed("bundler")
        models = {"COLMAP": list(Colmap(colmap)), "Bundler": list(Bundler(bundler))}
        rows = [
            self._row(name, images, share)
            for name, images in models.items()
            for share in self.outliers
        ]
        yield RatioTable("Robust search", rows)

    def _row(self, name: str, images: list[Correspondences], share: float) -> Row:
        rng = np.random.default_rng(1)
        max_iterations = 200_000 if share > 0.85 else 10_000
        succeeded, ours, poselibs, opencvs = [], [], [], []
        for draw in range(self.draws):
            options = RansacOptions(**_SEARCH, max_iterations=max_iterations, seed=draw)
            for image in images:
                truth = spoil(image, share, rng=rng)
                wall, _, est = clocked(partial(_search, truth, options))
                ours.append(wall)
                succeeded.append(est is not None and errors_of(est, truth)["success"])
                poselibs.append(seconds(partial(_poselib, image, truth.points_2d, max_iterations)))
                if draw < _OPENCV_DRAWS:
                    opencvs.append(seconds(partial(_opencv, image, truth.points_2d)))
        own = float(np.median(ours))
        row = figure(
            f"robust, {name}, {share:.0%} outliers",
            1e3 * own,
            "ms",
            own / float(np.median(poselibs)),
            "PoseLib",
        )
        over_opencv = own / float(np.median(opencvs))
        return row | {"success": f"{np.mean(succeeded):.1%}", "over cv2 RANSAC EPNP": over_opencv}


def _search(truth: Problem, options: RansacOptions) -> Alignment | None:
    try:
        given = truth.points_3d, truth.points_2d, truth.camera
        return cadalign.fit(*given, ransac=options).alignment
    except cadalign.CadalignError:
        return None


def _undistorted(image: Correspondences, points_2d: np.ndarray) -> np.ndarray:
    camera = image.camera
    return camera.normalize(points_2d) * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def _poselib(image: Correspondences, points_2d: np.ndarray, iterations: int) -> object:
    camera = image.camera
    intrinsics = {
        "model": "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "params": [camera.fx, camera.fy, camera.cx, camera.cy],
    }
    pixels, options = _undistorted(image, points_2d), _SEARCH | {"max_iterations": iterations}
    return poselib.estimate_absolute_pose(pixels, image.points_3d, intrinsics, options, {})


def _opencv(image: Correspondences, points_2d: np.ndarray) -> object:
    return cv2.solvePnPRansac(
        image.points_3d,
        _undistorted(image, points_2d),
        image.camera.matrix,
        None,
        flags=cv2.SOLVEPNP_EPNP,
        iterationsCount=10_000,
        reprojectionError=_SEARCH["max_reproj_error"],
        confidence=_SEARCH["success_prob"],
    )
