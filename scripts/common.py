"""Parts that the scripts share: arguments, tables, errors of an ideal estimator, output files."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage
from typing import Any

import cv2
import numpy as np
from rich.table import Table

from cadalign.errors import CadalignError
from cadalign.evaluation.accuracy.cramer_rao import cramer_rao_bound, sample_limit
from cadalign.evaluation.simulation.problems import Problem
from cadalign.io.files import write_json
from cadalign.io.images import write_image

COMMAND = (sys.executable, "-c", "import sys; from cadalign.cli import main; sys.exit(main())")
"""What runs `cadalign`, wherever it is installed."""
LIMIT_DRAWS = 20
STEM = Path(sys.argv[0]).stem


@dataclass
class Benchmark:
    """Arguments of all benchmarks; benchmark_focal.py writes bench/focal.json."""

    out: Path = Path("bench", STEM.removeprefix("benchmark_") + ".json")
    """JSON file to write."""


@dataclass
class SeededBenchmark(Benchmark):
    """Arguments of the benchmarks on random problems."""

    seed: int = 0
    """Seed of everything random."""


@dataclass
class Picture:
    """Arguments of the scripts that make a picture; make_overview.py writes docs/overview.png."""

    out: Path = Path(
        "docs", re.sub(r"^make_|^align_|_picture$", "", Path(sys.argv[0]).stem) + ".png"
    )
    """Where to write the picture."""


def new_table(title: str, *columns: str) -> Table:
    """A table whose columns stand to the right, as numbers do."""
    table = Table(title=title)
    for column in columns:
        table.add_column(column, justify="right")
    return table


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


def write_results(path: Path, results: Any) -> None:
    """Write a benchmark's figures and say where."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, results)
    print(f"written to {path}")


def figure(value: float, unit: str, ratio: float) -> dict[str, Any]:
    """A measured figure, and its ratio to a time that was measured in turns with it."""
    return {"value": value, "unit": unit, "ratio": ratio}


def write_figures(path: Path | None, figures: dict[str, dict[str, Any]]) -> None:
    """Write figures by name for `compare_ratios.py`, if there is a path."""
    if path is not None:
        write_results(path, figures)


def processor_seconds(call: Callable[[], object]) -> float:
    """Processor time of a call in this process, of all its threads."""
    start = time.process_time()
    call()
    return time.process_time() - start


def seconds_of_process(
    command: list[str], *, environment: Mapping[str, str] | None = None
) -> tuple[float, float]:
    """Wall clock and processor time of a command that keeps byte code, as installed packages do."""
    environment = {**(environment or os.environ), "PYTHONDONTWRITEBYTECODE": ""}
    began, before = time.perf_counter(), getrusage(RUSAGE_CHILDREN)
    subprocess.run(command, check=True, capture_output=True, env=environment)
    after = getrusage(RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - began, used


def reference_seconds() -> float:
    """Processor time of 50,000 eigenvalue problems in NumPy, a measure of the machine's speed."""
    matrices = np.random.default_rng(0).standard_normal((50_000, 4, 4))
    return processor_seconds(lambda: np.linalg.eigvalsh(matrices))


def write_row(path: Path, pictures: Sequence[np.ndarray], *, width: int) -> None:
    """Write pictures of one height side by side, shrunk to a width [px] in all."""
    row = np.hstack(pictures)
    height = round(row.shape[0] * width / row.shape[1])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, cv2.resize(row, (width, height), interpolation=cv2.INTER_AREA))
