"""Whole runs: evaluations of many instances, and the robust search on real correspondences."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import poselib

import cadalign
from benchmarks.section import (
    BenchmarkData,
    RatioTable,
    Row,
    Used,
    clocked,
    figure,
    processor_seconds,
    reference_seconds,
    seconds,
    used_by_command,
)
from cadalign import Alignment, Camera, RansacOptions, metrics
from cadalign.datasets import Bundler, Colmap, Correspondences, KeypointNet, write_sample_dataset
from cadalign.evaluation.experiments.keypointnet import KeypointNetOptions
from cadalign.evaluation.instances.views import KeypointTasks, keypointnet_benchmark

_CHUNK = 100
_SEARCH = {"max_reproj_error": 4.0, "success_prob": 0.9999}
_OPENCV_DRAWS = 2  # it takes the better part of a second


# Evaluation ---------------------------------------------------------------------------------------


@dataclass
class Evaluation:
    """Instances a second by one core, and of whole runs on two.

    Whole runs are commands with two worker processes, or with two workers of a Dask cluster. Their
    rate is that of what a longer run takes more than a shorter one: neither start nor figures are
    in it. Ratios are those of processor time to `reference_seconds`, measured in turns; Dask's is
    its time over that of processes, that of memory the longer run's over the shorter one's.
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
                _dask_over_processes(root),
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
    """Rate of a run, and its memory over that of a shorter one."""
    few, many = views
    reference = reference_seconds()
    short, long = (_used_by_run(root, *options, "--workers=2", views=each) for each in views)
    reference = min(reference, reference_seconds())
    count = (many - few) * len(KeypointNet(root))
    rate = count / (long.wall - short.wall)
    busy = (long.processor - short.processor) / count
    yield figure(f"{name}, two processes", rate, "1/s", 1e3 * busy / reference)
    memory, grown = f"{name}, memory of {many} over {few} views", long.megabytes / short.megabytes
    yield figure(memory, long.megabytes, "MB", grown)


def _dask_over_processes(root: Path) -> Row:
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        dask = f"--dask={cluster.scheduler_address}"
        on_dask = _used_by_run(root, "--visibility=hull", dask, views=3)
    processes = _used_by_run(root, "--visibility=hull", "--workers=2", views=3)
    ratio = on_dask.wall / processes.wall
    return figure("run by Dask over one by processes", on_dask.wall, "s", ratio)


# Robust search ------------------------------------------------------------------------------------


@dataclass
class Ransac:
    """The robust search on real correspondences: success, and time over PoseLib's and OpenCV's.

    Scales are drawn anew for every image and draw, and the given share of the image points is
    replaced by uniform ones. PoseLib and OpenCV get the true scales: they solve the easier problem
    without stretch. Success is R < 0.5 deg and scales within 1 %.
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
                scale = np.array([1.0, *rng.uniform(0.5, 2.0, 2)])
                pose = image.cam_from_world
                gt = Alignment(pose.rotation, pose.translation, scale)
                points_2d = image.points_2d.copy()
                wrong = rng.choice(len(points_2d), round(share * len(points_2d)), replace=False)
                size = [image.camera.width - 1, image.camera.height - 1]
                points_2d[wrong] = rng.uniform([0, 0], size, (len(wrong), 2))
                model = image.points_3d / scale
                wall, _, est = clocked(partial(_search, model, points_2d, image.camera, options))
                ours.append(wall)
                succeeded.append(est is not None and _is_close(est, gt))
                poselibs.append(seconds(partial(_poselib, image, points_2d, max_iterations)))
                if draw < _OPENCV_DRAWS:
                    opencvs.append(seconds(partial(_opencv, image, points_2d)))
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


def _search(
    model: np.ndarray, points_2d: np.ndarray, camera: Camera, options: RansacOptions
) -> Alignment | None:
    try:
        return cadalign.fit(model, points_2d, camera, ransac=options).alignment
    except cadalign.CadalignError:
        return None


def _is_close(est: Alignment, gt: Alignment) -> bool:
    scale = metrics.scale_error(est=est, gt=gt).max()
    return bool(metrics.rotation_error(est=est, gt=gt) < 0.5 and scale < 0.01)


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
