"""Measure what calls cost beside their solving: the warm command line, and small fits in Python.

Prints a table of times and of their ratios to work measured in turns with them, and writes a JSON
file. The ratios can be compared between machines.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tyro
from common import COMMAND, Benchmark, new_table, seconds_of_process, write_results
from rich.console import Console

import cadalign
from cadalign.datasets import sample_models
from cadalign.evaluation.simulation.problems import simulate_problem
from cadalign.io.images import write_image
from cadalign.io.observation import Observation
from cadalign.solvers.linear import aepnp_batch

LIBRARIES = [sys.executable, "-c", "import numpy, numba"]


@dataclass
class CallsArguments(Benchmark):
    """Measure what calls cost beside their solving."""

    json: Path | None = None
    """Write the figures to this file, too, by name: value, unit, and ratio."""
    runs: int = 7
    """Runs of each command."""
    calls: int = 2000
    """Calls of each fit."""


@dataclass(frozen=True)
class Figure:
    """A duration, and its ratio to that of other work."""

    value: float
    unit: str
    ratio: float
    to: str


def main(arguments: CallsArguments) -> None:
    """Run all measurements."""
    with tempfile.TemporaryDirectory() as folder:
        figures = _commands(Path(folder), arguments.runs)
    figures |= _calls(arguments.calls)
    table = new_table("Medians", "call", "time", "ratio", "to")
    for name, figure in figures.items():
        table.add_row(name, f"{figure.value:.3g} {figure.unit}", f"{figure.ratio:.2f}", figure.to)
    Console(width=130).print(table)
    found = {name: vars(figure) for name, figure in figures.items()}
    write_results(arguments.out, found)
    if arguments.json is not None:
        write_results(arguments.json, found)


def _commands(folder: Path, runs: int) -> dict[str, Figure]:
    """Processor time [s] of commands, once their kernels are compiled."""
    observation = str(_observation(folder))
    called = {
        "cadalign --help": ["--help"],
        "cadalign fit": ["fit", observation],
        "cadalign fit --json --no-picture": ["fit", observation, "--json", "--no-picture"],
        "cadalign demo": ["demo", "--out", str(folder / "demo"), "--workers", "0"],
    }
    figures = {}
    for name, given in called.items():
        counted = 1 if name == "cadalign demo" else runs
        seconds_of_process([*COMMAND, *given])  # compiles what is not yet on disk
        own, other = _in_turns(
            lambda given=given: seconds_of_process([*COMMAND, *given])[1],
            lambda: seconds_of_process(LIBRARIES)[1],
            counted,
        )
        figures[name] = Figure(own, "s", own / other, "import numpy, numba")
    return figures


def _observation(folder: Path) -> Path:
    """An observation that names a photo and an OBJ model."""
    (model,) = sample_models(categories=["chair"], per_category=1)
    problem = simulate_problem(np.random.default_rng(0), points=10, noise_px=0.5)
    camera = problem.camera
    photo, path = folder / "photo.jpg", folder / "chair.obj"
    write_image(photo, np.full((camera.height, camera.width, 3), 180, dtype=np.uint8))
    lines = [f"v {x} {y} {z}" for x, y, z in model.mesh.vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in (model.mesh.faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n")
    seen = Observation(problem.points_3d, problem.points_2d, camera, image=photo, model=path)
    seen.save(folder / "seen.json")
    return folder / "seen.json"


def _calls(count: int) -> dict[str, Figure]:
    """Times [us] of small fits over those of OpenCV, and over the kernel's own."""
    ten, seven = (
        simulate_problem(np.random.default_rng(0), points=points, noise_px=1.0)
        for points in (10, 7)
    )
    rays, offsets = ten.camera.normalize(ten.points_2d), np.array([0, 10])

    def linear() -> object:
        return cadalign.fit(ten.points_3d, ten.points_2d, ten.camera, method="aepnp")

    def kernel() -> object:
        return aepnp_batch(ten.points_3d, rays, offsets)

    def optimal() -> object:
        return cadalign.fit(seven.points_3d, seven.points_2d, seven.camera)

    def iterative() -> object:
        return cv2.solvePnP(ten.points_3d, ten.points_2d, ten.camera.matrix, None)

    figures = {}
    for name, ours, theirs, to in (
        ("fit(method='aepnp'), 10 points", linear, kernel, "its kernel"),
        ("fit, 7 points", optimal, iterative, "OpenCV's ITERATIVE, 10 points"),
    ):
        own, other = _in_turns(lambda f=ours: _seconds(f), lambda f=theirs: _seconds(f), count)
        figures[name] = Figure(1e6 * own, "us", own / other, to)
    return figures


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def _in_turns(
    ours: Callable[[], float], theirs: Callable[[], float], count: int
) -> tuple[float, float]:
    """Medians of two measurements, taken in turns after one of each that does not count."""
    ours(), theirs()
    own, other = zip(*((ours(), theirs()) for _ in range(count)), strict=True)
    return statistics.median(own), statistics.median(other)


if __name__ == "__main__":
    main(tyro.cli(CallsArguments))
