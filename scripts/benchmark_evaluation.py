"""Measure evaluation: instances a second by one core, and of whole runs on two.

Whole runs are commands with two worker processes, or with two workers of a Dask cluster. Their
rate is that of what a longer run takes more than a shorter one: neither start nor figures are in
it. Ratios are those of processor time to `common.reference_seconds`, measured in turns; Dask's is
its time over that of processes, that of memory the longer run's over the shorter one's.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import tyro
from common import COMMAND, figure, processor_seconds, reference_seconds, write_figures

from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.evaluation.benchmark import Benchmark
from cadalign.evaluation.keypointnet.experiment import keypointnet_benchmark
from cadalign.evaluation.keypointnet.options import KeypointNetOptions
from cadalign.evaluation.keypointnet.tasks import KeypointTasks

CHUNK = 100


@dataclass
class EvaluationArguments:
    """Measure evaluation."""

    root: tyro.conf.Positional[Path]
    """Folder in KeypointNet's layout."""
    count: int = 2000
    """Instances on annotations alone."""
    json: Path | None = None
    """File for the figures, as `compare_ratios.py` reads them."""


def evaluate_all(experiment: Benchmark, tasks: KeypointTasks, count: int) -> None:
    """Evaluate the first tasks, chunk by chunk."""
    for start in range(0, count, CHUNK):
        experiment.evaluate(tasks[start : min(start + CHUNK, count)])


def on_annotations(root: Path, count: int, method: str) -> dict[str, Any]:
    """Rate of instances whose meshes are not looked at."""
    options = KeypointNetOptions(root, visibility="hull", methods=(method,))
    tasks = KeypointTasks(KeypointNet(root), options)
    experiment = keypointnet_benchmark(options)
    experiment.warm_up()
    count = min(count, len(tasks))
    reference = reference_seconds()
    seconds = processor_seconds(partial(evaluate_all, experiment, tasks, count))
    reference = min(reference, reference_seconds())
    return figure(count / seconds, "1/s", 1e3 * seconds / count / reference)


@dataclass(frozen=True)
class Used:
    """Wall clock and processor time of a run [s], and its largest process [MB]."""

    wall: float
    processor: float
    megabytes: float


def used_by_run(root: Path, *options: str, views: int) -> Used:
    """Run the command in a folder of its own, and measure it with its workers."""
    with tempfile.TemporaryDirectory() as folder:
        call = ["evaluate", "keypointnet", str(root), f"--views-per-model={views}", *options]
        call += [f"--out={folder}/run", "--json"]
        start = time.perf_counter()
        process = subprocess.Popen([*COMMAND, *call], stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 3):  # 3: some rows failed
        raise subprocess.CalledProcessError(process.returncode, call)
    return Used(wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)


def of_longer_run(root: Path, *options: str, views: tuple[int, int]) -> tuple[Used, Used, int]:
    """A short and a long run, and the number of instances that the long one has more."""
    few, many = views
    short, long = (used_by_run(root, *options, views=count) for count in views)
    return short, long, (many - few) * len(KeypointNet(root))


def whole_runs(root: Path, samples: Path) -> dict[str, Any]:
    """Rates of runs, on annotations and with overlays, memory, and Dask over processes."""
    from distributed import LocalCluster

    annotations = ("--visibility=hull", "--methods=aepnp")
    figures = {}
    for name, where, options, views in (
        ("run on annotations", root, annotations, (4, 16)),
        ("run with overlays", samples, ("--methods=optimal", "--render=overlay"), (1, 4)),
    ):
        reference = reference_seconds()
        short, long, count = of_longer_run(where, *options, "--workers=2", views=views)
        reference = min(reference, reference_seconds())
        rate = count / (long.wall - short.wall)
        seconds = (long.processor - short.processor) / count
        figures[f"{name}, two processes"] = figure(rate, "1/s", 1e3 * seconds / reference)
        grown = long.megabytes / short.megabytes
        figures[f"{name}, memory of {views[1]} over {views[0]} views"] = figure(
            long.megabytes, "MB", grown
        )
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        options = ("--visibility=hull", f"--dask={cluster.scheduler_address}")
        on_dask = used_by_run(root, *options, views=3)
    processes = used_by_run(root, "--visibility=hull", "--workers=2", views=3)
    figures["run by Dask over one by processes"] = figure(
        on_dask.wall, "s", on_dask.wall / processes.wall
    )
    return figures


def main(arguments: EvaluationArguments) -> None:
    """Measure all, print and write the figures."""
    figures = {}
    for method in ("aepnp", "optimal"):
        name = f"evaluation on annotations, {method}"
        figures[name] = on_annotations(arguments.root, arguments.count, method)
    with tempfile.TemporaryDirectory() as folder:
        samples = write_sample_dataset(Path(folder) / "samples", per_category=12)
        figures |= whole_runs(arguments.root, samples)
    for name, found in figures.items():
        print(f"{name:52} {found['value']:8.1f} {found['unit']:4} ratio {found['ratio']:.2f}")
    write_figures(arguments.json, figures)


if __name__ == "__main__":
    main(tyro.cli(EvaluationArguments))
