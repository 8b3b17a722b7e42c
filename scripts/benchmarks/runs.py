"""Whole runs: evaluations, fits of many observations, and searches in real correspondences."""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import poselib
from scipy.spatial.transform import Rotation

from benchmarks import section
from benchmarks.section import COMMAND, BenchmarkData, Row, Tables, Used
from cadalign import Camera, RansacOptions
from cadalign.batch.experiment import LARGEST_CHUNK
from cadalign.datasets import Colmap, Correspondences, KeypointNet, write_sample_dataset
from cadalign.evaluation.experiments.keypointnet import KeypointNetOptions
from cadalign.evaluation.instances.correspondences import errors_of, spoil
from cadalign.evaluation.instances.views import KeypointTasks, keypointnet_benchmark
from cadalign.evaluation.runs.folder import RunFolder

_POINTS = 8
_CAMERA = Camera(640, 480, 700.0, 700.0, 319.5, 239.5)
_CHUNK = 100
_SEARCH = {"max_reproj_error": 4.0, "success_prob": 0.9999}
_OPENCV_DRAWS = 2  # it takes the better part of a second


def _used(*call: str) -> Used:
    with tempfile.TemporaryDirectory() as folder:
        return section.used_by_command([*call, f"--out={folder}/run"])


def _rate_and_memory(
    rate: str, memory: str, count: int, shorter: list[str], longer: list[str]
) -> Iterator[Row]:
    """Rate of what a longer run of two processes does more, ``count`` items, and its memory.

    The rate's ratio is that of processor time to `reference_seconds`, the memory's the longer run's
    over the shorter one's.
    """
    (short, long), reference = section.with_reference(
        lambda: [_used(*call, "--workers=2") for call in (shorter, longer)]
    )
    busy = (long.processor - short.processor) / count
    name = f"{rate}, two processes"
    yield section.figure(name, count / (long.wall - short.wall), "1/s", 1e3 * busy / reference)
    yield section.figure(memory, long.megabytes, "MB", long.megabytes / short.megabytes)


@contextmanager
def _dask_cluster() -> Iterator[Any]:
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster


def _dask_over_processes(name: str, call: list[str]) -> Row:
    """Time of a run by two Dask workers over two processes."""
    with _dask_cluster() as cluster:
        on_dask = _used(*call, f"--dask={cluster.scheduler_address}")
    return section.figure(name, on_dask.wall, "s", on_dask.wall / _used(*call, "--workers=2").wall)


# Evaluation ---------------------------------------------------------------------------------------


def evaluation(given: BenchmarkData, *, count: int = 2000) -> Tables:
    """Instances a second by one core, and of whole runs on two.

    Whole runs are commands with two worker processes, or with two workers of a Dask cluster; rates
    are those of what a longer run does more than a shorter one: neither start nor figures are in
    them. Ratios are processor time over `reference_seconds`; Dask's is its time over that of
    processes.

    Parameters
    ----------
    count : int
        Instances on annotations alone.
    """
    root = given.needed()
    rows = [_on_annotations(root, method, count) for method in ("aepnp", "optimal")]
    yield "Evaluation in one process", rows
    with tempfile.TemporaryDirectory() as folder:
        samples = write_sample_dataset(Path(folder) / "samples", per_category=12)
        on_hulls = _evaluate(root, "--visibility=hull")
        rows = [
            *_whole_runs("run on annotations", [*on_hulls, "--methods=aepnp"], root, (4, 16)),
            *_whole_runs(
                "run with overlays",
                _evaluate(samples, "--methods=optimal", "--render=overlay"),
                samples,
                (1, 4),
            ),
            _dask_over_processes(
                "run by Dask over one by processes", [*on_hulls, "--views-per-model=3"]
            ),
        ]
    yield "Whole runs", rows


def _on_annotations(root: Path, method: str, count: int) -> Row:
    options = KeypointNetOptions(root, visibility="hull", methods=(method,))
    tasks = KeypointTasks(KeypointNet(root), options)
    experiment = keypointnet_benchmark(options)
    experiment.evaluate(tasks[:1])
    number = min(count, len(tasks))

    def evaluate_all() -> None:
        for start in range(0, number, _CHUNK):
            experiment.evaluate(tasks[start : min(start + _CHUNK, number)])

    busy, reference = section.with_reference(partial(section.processor_seconds, evaluate_all))
    name = f"evaluation on annotations, {method}"
    return section.figure(name, number / busy, "1/s", 1e3 * busy / number / reference)


def _evaluate(root: Path, *options: str) -> list[str]:
    return ["evaluate", "keypointnet", str(root), *options, "--json"]


def _whole_runs(name: str, call: list[str], root: Path, views: tuple[int, int]) -> Iterator[Row]:
    few, many = views
    memory = f"{name}, memory of {many} over {few} views"
    count = (many - few) * len(KeypointNet(root))
    runs = ([*call, f"--views-per-model={each}"] for each in views)
    return _rate_and_memory(name, memory, count, *runs)


# Observations ------------------------------------------------------------------------------------


def fits(
    given: BenchmarkData,
    *,
    sizes: tuple[int, int] = (25_000, 100_000),
    methods: tuple[str, ...] = ("aepnp", "optimal"),
    dask: bool = True,
    kills: int = 5,
) -> Tables:
    """Observations a second of whole runs by two processes, and memory.

    Rates and ratios are those of the section evaluation. A run that is killed again and again, and
    one that loses a Dask worker, must give the bytes of one that nothing happens to.

    Parameters
    ----------
    sizes : tuple[int, int]
        Observations of the shorter and of the longer run.
    methods : tuple[str, ...]
        Methods of the fits.
    dask : bool
        Compare two Dask workers with two processes on the shorter run.
    kills : int
        Times that the longer run is killed.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        short, long = (_write_observations(folder, n, given.seed) for n in sizes)
        for method in methods:
            name = f"fits by {method}"
            runs = (_fit(file, method) for file in (short, long))
            count = sizes[1] - sizes[0]
            rows = _rate_and_memory(name, f"{name}, memory", count, *runs)
            yield f"Fits of {_POINTS} keypoints by {method}", rows
        if dask:
            name = "fits by Dask over those by processes"
            row = _dask_over_processes(name, _fit(short, "aepnp"))
            yield "Fits on a cluster", [row]
        if kills:
            yield "Interrupted", _interrupted(long, sizes, dask, kills)


def _interrupted(file: Path, sizes: tuple[int, int], dask: bool, kills: int) -> Iterator[Row]:
    """Compare the tables of interrupted runs with those of one that was left alone."""
    chunks = sizes[1] // LARGEST_CHUNK

    def start(folder: RunFolder, workers: str = "--workers=2") -> subprocess.Popen[bytes]:
        call = [*COMMAND, *_fit(file, "aepnp"), f"--out={folder.path}", workers]
        return subprocess.Popen(call)

    calm, killed, lost = (RunFolder(file.with_name(n)) for n in ("calm", "killed", "lost"))
    if start(calm).wait():
        raise SystemExit("the run that is left alone failed")
    for kill in range(kills):
        process = start(killed)
        _wait_for(killed, chunks * (kill + 1) // (kills + 1), process)
        process.kill()
        process.wait()
    start(killed).wait()
    yield _same_bytes(f"killed {kills} times", calm, killed)
    if dask:
        with _dask_cluster() as cluster:
            process = start(lost, f"--dask={cluster.scheduler_address}")
            _wait_for(lost, chunks // 2, process)
            os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL)
            process.wait()
        yield _same_bytes("a Dask worker killed", calm, lost)


def _fit(file: Path, method: str) -> list[str]:
    return ["fit", str(file), "--no-picture", f"--method={method}"]


def _wait_for(folder: RunFolder, chunks: int, process: subprocess.Popen[bytes]) -> None:
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


def _write_observations(folder: Path, count: int, seed: int) -> Path:
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


# Robust search ------------------------------------------------------------------------------------


def ransac(
    given: BenchmarkData,
    *,
    draws: int = 20,
    outliers: tuple[float, ...] = (0.0, 0.2, 0.5, 0.8, 0.9),
) -> Tables:
    """The robust search on real correspondences: success, and time over PoseLib's and OpenCV's.

    Images are those of `cadalign evaluate correspondences`: scales are drawn anew for every image
    and draw, and a share of the points is moved to anywhere. PoseLib and OpenCV get the true
    scales: they solve the easier problem without stretch.

    Parameters
    ----------
    draws : int
        Draws of scales and outliers for each image.
    outliers : tuple[float, ...]
        Shares of outliers among the image points.
    """
    images = list(Colmap(given.needed("colmap")))
    yield "Robust search", [_row("COLMAP", images, share, draws) for share in outliers]


def _row(name: str, images: list[Correspondences], share: float, draws: int) -> Row:
    rng = np.random.default_rng(1)
    iterations = 200_000 if share > 0.85 else 10_000
    succeeded, ours, poselibs, opencvs = [], [], [], []
    for draw in range(draws):
        options = RansacOptions(**_SEARCH, max_iterations=iterations, seed=draw)
        for image in images:
            truth = spoil(image, share, rng=rng)
            wall, _, result = section.clocked(partial(section.fitted, truth, ransac=options))
            ours.append(wall)
            is_found = result is not None and errors_of(result.alignment, truth)["success"]
            succeeded.append(is_found)
            poselibs.append(section.seconds(_poselib(image, truth.points_2d, iterations)))
            if draw < _OPENCV_DRAWS:
                opencvs.append(section.seconds(_opencv(image, truth.points_2d)))
    own, other, opencv = (float(np.median(each)) for each in (ours, poselibs, opencvs))
    name = f"robust, {name}, {share:.0%} outliers"
    return section.figure(name, 1e3 * own, "ms", own / other, "PoseLib") | {
        "success": f"{np.mean(succeeded):.1%}",
        "over cv2 RANSAC EPNP": own / opencv,
    }


def _undistorted(image: Correspondences, points_2d: np.ndarray) -> np.ndarray:
    camera = image.camera
    return camera.normalize(points_2d) * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def _poselib(
    image: Correspondences, points_2d: np.ndarray, iterations: int
) -> Callable[[], object]:
    camera = image.camera
    params = [camera.fx, camera.fy, camera.cx, camera.cy]
    size = {"width": camera.width, "height": camera.height}
    intrinsics = {"model": "PINHOLE", **size, "params": params}
    options = _SEARCH | {"max_iterations": iterations}
    return lambda: poselib.estimate_absolute_pose(
        _undistorted(image, points_2d), image.points_3d, intrinsics, options, {}
    )


def _opencv(image: Correspondences, points_2d: np.ndarray) -> Callable[[], object]:
    return lambda: cv2.solvePnPRansac(
        image.points_3d,
        _undistorted(image, points_2d),
        image.camera.matrix,
        None,
        flags=cv2.SOLVEPNP_EPNP,
        iterationsCount=10_000,
        reprojectionError=_SEARCH["max_reproj_error"],
        confidence=_SEARCH["success_prob"],
    )
