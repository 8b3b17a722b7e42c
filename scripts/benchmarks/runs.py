"""Throughput and memory of runs, and RANSAC on real correspondences."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import poselib
from scipy.spatial.transform import Rotation

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign import Camera, RansacOptions
from cadalign.datasets import Colmap, Correspondences
from cadalign.evaluation.experiments.correspondences import errors_of, make_problem
from cadalign.evaluation.methods import MethodInput

_COMMAND = (sys.executable, "-c", "import sys; from cadalign.cli import main; sys.exit(main())")
_POINTS = 8
_CAMERA = Camera(640, 480, 700.0, 700.0, 319.5, 239.5)
_SIZES = (25_000, 100_000)  # observations of the shorter and of the longer run
_SEARCH = {"max_reproj_error": 4.0, "success_prob": 0.9999}


def runs(given: BenchmarkData) -> Tables:
    """Fits of many observations, and RANSAC.

    Throughput is the difference of a longer and a shorter run with two processes, without start-up
    and figures. The memory's ratio is longer over shorter run.
    """
    with tempfile.TemporaryDirectory() as folder:
        files = [_write_observations(Path(folder), n, given.seed) for n in _SIZES]
        rows = list[Row]()
        for method in ("aepnp", "optimal"):
            fits = [["fit", str(file), "--no-picture", f"--method={method}"] for file in files]
            rows += _rate_and_memory(f"fits by {method}", _SIZES[1] - _SIZES[0], *fits)
            if method == "aepnp":
                rows.append(_dask_over_processes(fits[0]))
    yield f"Fits of {_POINTS} keypoints", rows
    yield "RANSAC on real correspondences", _ransac(given)


def _rate_and_memory(name: str, count: int, shorter: list[str], longer: list[str]) -> Iterator[Row]:
    (short, less), (long, more) = (_measure(*call, "--workers=2") for call in (shorter, longer))
    yield {"name": name, "value": count / (long - short), "unit": "1/s"}
    yield section.figure(f"{name}, memory", more, "MB", more / less, "the shorter run")


def _dask_over_processes(call: list[str]) -> Row:
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        dask, _ = _measure(*call, f"--dask={cluster.scheduler_address}")
    processes, _ = _measure(*call, "--workers=2")
    return section.figure("fits, two Dask workers", dask, "s", dask / processes, "two processes")


def _measure(*call: str) -> tuple[float, float]:
    with tempfile.TemporaryDirectory() as folder:
        return section.measure_command([*_COMMAND, *call, f"--out={folder}/run"])


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


# RANSAC -------------------------------------------------------------------------------------------


def _ransac(given: BenchmarkData) -> Iterator[Row]:
    """RANSAC on real correspondences: success rate, and time relative to PoseLib's.

    Problems are drawn as in `cadalign evaluate correspondences`. PoseLib gets the true scales, so
    it solves the easier problem without stretch.
    """
    images = list(Colmap(given.folder("sfm", "maupertuis_colmap")))
    for share in (0.0, 0.2, 0.5, 0.8, 0.9):
        rng = np.random.default_rng(1)
        iterations = 200_000 if share > 0.85 else 10_000
        succeeded, ours, poselibs = [], [], []
        for draw in range(given.count or 20):
            options = RansacOptions(**_SEARCH, max_iterations=iterations, seed=draw)
            for image in images:
                truth = make_problem(image, share, rng=rng)
                problem = truth.points_3d, truth.points_2d, truth.camera
                call = partial(section.attempt, cadalign.fit, *problem, ransac=options)
                wall, _, result = section.clock(call)
                ours.append(wall)
                known = MethodInput.from_problem(truth, 1.0)
                succeeded.append(result is not None and errors_of(result, known)["success"])
                poselibs.append(section.seconds(_poselib(image, truth.points_2d, iterations)))
        own, other = float(np.median(ours)), float(np.median(poselibs))
        row = section.figure(f"{share:.0%} outliers", 1e3 * own, "ms", own / other, "PoseLib")
        yield row | {"success": f"{np.mean(succeeded):.1%}"}


def _poselib(
    image: Correspondences, points_2d: np.ndarray, iterations: int
) -> Callable[[], object]:
    camera = image.camera
    params = [camera.fx, camera.fy, camera.cx, camera.cy]
    size = {"width": camera.width, "height": camera.height}
    intrinsics = {"model": "PINHOLE", **size, "params": params}
    options = _SEARCH | {"max_iterations": iterations}

    def call() -> object:
        undistorted = camera.normalize(points_2d) * params[:2] + params[2:]
        return poselib.estimate_absolute_pose(undistorted, image.points_3d, intrinsics, options, {})

    return call
