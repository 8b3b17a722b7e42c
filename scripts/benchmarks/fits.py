"""Runs over many observations: `cadalign fit` of a file of JSON lines."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.section import (
    BenchmarkData,
    RatioTable,
    Row,
    Used,
    figure,
    reference_seconds,
    used_by_command,
)
from cadalign import Camera

_POINTS = 8
_CAMERA = Camera(640, 480, 700.0, 700.0, 319.5, 239.5)


@dataclass
class Fits:
    """Observations a second of whole runs by two processes, and memory.

    The rate is that of what the longer run takes more than the shorter one; the ratio is that of
    processor time to `reference_seconds`, that of memory the longer run's over the shorter one's,
    and Dask's its time over that of processes.
    """

    sizes: tuple[int, int] = (25_000, 100_000)
    """Observations of the shorter and of the longer run."""
    methods: tuple[str, ...] = ("aepnp", "optimal")
    """Methods of the fits."""
    dask: bool = True
    """Compare two Dask workers with two processes on the shorter run."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure rates, memory and Dask."""
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            files = [write_observations(folder, count, given.seed) for count in self.sizes]
            for method in self.methods:
                yield RatioTable(f"Fits of {_POINTS} keypoints", list(self._rates(method, files)))
            if self.dask:
                yield RatioTable("Fits on a cluster", [_dask_over_processes(files[0])])

    def _rates(self, method: str, files: list[Path]) -> Iterator[Row]:
        reference = reference_seconds()
        short, long = (_used(file, f"--method={method}", "--workers=2") for file in files)
        reference = min(reference, reference_seconds())
        count = self.sizes[1] - self.sizes[0]
        busy = (long.processor - short.processor) / count
        rate = count / (long.wall - short.wall)
        yield figure(f"fits by {method}, two processes", rate, "1/s", 1e3 * busy / reference)
        grown = long.megabytes / short.megabytes
        yield figure(f"fits by {method}, memory", long.megabytes, "MB", grown)


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


def _dask_over_processes(file: Path) -> Row:
    from distributed import LocalCluster

    method = "--method=aepnp"
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        on_dask = _used(file, method, f"--dask={cluster.scheduler_address}")
    ratio = on_dask.wall / _used(file, method, "--workers=2").wall
    return figure("fits by Dask over those by processes", on_dask.wall, "s", ratio)
