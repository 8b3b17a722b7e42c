"""Sections of `bench.py`: the data they are given, their tables, clocks and limits."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage
from typing import Any, Protocol, TypeVar

import numpy as np
from common import COMMAND

from cadalign.errors import CadalignError
from cadalign.evaluation.metrics.cramer_rao import cramer_rao_bound, sample_limit
from cadalign.evaluation.simulation.problems import Problem

LIMIT_DRAWS = 20
_DATA = Path(os.environ["CADALIGN_DATA"]) if os.environ.get("CADALIGN_DATA") else None

Row = dict[str, Any]
T = TypeVar("T")


class NotGivenError(Exception):
    """A section cannot do without data that are not given."""


@dataclass(kw_only=True)
class BenchmarkData:
    """Data and seed of all sections; CADALIGN_DATA names the folder of the data."""

    keypointnet: Path | None = _DATA and _DATA / "keypointnet"
    """Folder in KeypointNet's layout, with splits; some sections need it, others use it."""
    colmap: Path | None = _DATA and _DATA / "sfm" / "maupertuis_colmap"
    """Folder of a COLMAP model."""
    bundler: Path | None = _DATA and _DATA / "sfm" / "balbianello"
    """Folder of a Bundler model."""
    seed: int = 0
    """Seed of random problems."""
    out: Path = Path("bench")
    """Folder for what is measured: <section>.json, and pictures of the annotator."""

    def needed(self, name: str) -> Path:
        """A folder that a section cannot do without; NotGivenError where there is none."""
        found: Path | None = getattr(self, name)
        if found is None:
            raise NotGivenError(f"give --{name}, or CADALIGN_DATA")
        return found


@dataclass(frozen=True)
class RatioTable:
    """A title, and rows by column; a cell may be a median with a 90th percentile."""

    title: str
    rows: list[Row]


class Section(Protocol):
    """A section: a dataclass of options that measures."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure, one table after the other."""


def figure(name: str, value: float, unit: str, ratio: float, to: str = "") -> Row:
    """A measured figure, and its ratio to a time that was measured in turns with it.

    The ratio depends little on the machine, and less is better: `bench.py` compares it.
    """
    return {"name": name, "value": value, "unit": unit, "ratio": ratio, "to": to}


# Clocks -------------------------------------------------------------------------------------------


def clocked(call: Callable[[], T]) -> tuple[float, float, T]:
    """Wall clock and processor time of a call, of all its threads [s], and what it returns."""
    wall, busy = time.perf_counter(), time.process_time()
    found = call()
    return time.perf_counter() - wall, time.process_time() - busy, found


def seconds(call: Callable[[], object]) -> float:
    """Wall clock time of a call."""
    return clocked(call)[0]


def processor_seconds(call: Callable[[], object]) -> float:
    """Processor time of a call in this process, of all its threads."""
    return clocked(call)[1]


def reference_seconds() -> float:
    """Processor time of 50,000 eigenvalue problems in NumPy, a measure of the machine's speed."""
    matrices = np.random.default_rng(0).standard_normal((50_000, 4, 4))
    return processor_seconds(lambda: np.linalg.eigvalsh(matrices))


def seconds_of_process(
    command: list[str], *, environment: Mapping[str, str] | None = None
) -> tuple[float, float]:
    """Wall clock and processor time of a command that keeps byte code, as installed packages do."""
    environment = {**(environment or os.environ), "PYTHONDONTWRITEBYTECODE": ""}
    before = getrusage(RUSAGE_CHILDREN)
    wall = seconds(
        lambda: subprocess.run(command, check=True, capture_output=True, env=environment)
    )
    after = getrusage(RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@dataclass(frozen=True)
class Used:
    """Wall clock and processor time of a command [s], and its largest process [MB]."""

    wall: float
    processor: float
    megabytes: float


def used_by_command(call: list[str]) -> Used:
    """Run a command of cadalign, and measure it with its workers; some of its rows may fail."""

    def wait() -> tuple[int, Any]:
        process = subprocess.Popen([*COMMAND, *call], stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        return process.returncode, usage

    wall, _, (code, usage) = clocked(wait)
    if code not in (0, 3):  # 3: some rows failed
        raise subprocess.CalledProcessError(code, call)
    return Used(wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)


def rate_and_memory(
    rate: str, memory: str, count: int, run: Callable[[int], Used]
) -> Iterator[Row]:
    """Rate of what a longer run does more than a shorter one, ``count`` items, and its memory.

    ``run`` does the shorter run for 0, the longer one for 1. The rate's ratio is that of processor
    time to `reference_seconds`, the memory's the longer run's over the shorter one's.
    """
    reference = reference_seconds()
    short, long = run(0), run(1)
    reference = min(reference, reference_seconds())
    busy = (long.processor - short.processor) / count
    yield figure(rate, count / (long.wall - short.wall), "1/s", 1e3 * busy / reference)
    yield figure(memory, long.megabytes, "MB", long.megabytes / short.megabytes)


def dask_over_processes(name: str, run: Callable[[str], Used]) -> Row:
    """Time of a run by two Dask workers over two processes; ``run`` is given the option of each."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        on_dask = run(f"--dask={cluster.scheduler_address}")
    return figure(name, on_dask.wall, "s", on_dask.wall / run("--workers=2").wall)


def medians_in_turns(
    measures: Mapping[str, Callable[[], float]], count: int, *, per_turn: int = 1
) -> dict[str, float]:
    """Medians of measurements, after one of each that does not count.

    They take turns, so that a slow moment of the machine hits all alike.
    """
    times: dict[str, list[float]] = {name: [] for name in measures}
    for measure in measures.values():
        measure()
    for _ in range(-(-count // per_turn)):
        for name, measure in measures.items():
            times[name] += [measure() for _ in range(per_turn)]
    return {name: float(np.median(values)) for name, values in times.items()}


# Limits -------------------------------------------------------------------------------------------


def ideal_errors(
    problems: Iterable[Problem], rng: np.random.Generator, *, sigma: float, focal: str
) -> dict[str, np.ndarray]:
    """Errors of an ideal estimator on all problems, by name; see `cramer_rao_bound`."""
    draws = []
    for problem in problems:
        try:
            bound = cramer_rao_bound(
                problem.points_3d, problem.camera, problem.alignment, sigma=sigma, focal=focal
            )
        except CadalignError:
            continue
        draws.append(sample_limit(bound, rng=rng, draws=LIMIT_DRAWS))
    return {error: np.concatenate([draw[error] for draw in draws]) for error in draws[0]}
