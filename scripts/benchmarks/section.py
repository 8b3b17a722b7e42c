"""Shared parts of the sections of `bench.py`: data that they are given, tables, cases, clocks."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import tyro

import cadalign
from cadalign import CadalignError
from cadalign.arrays import FloatArray
from cadalign.datasets import AnnotatedModel, KeypointNet, write_sample_dataset
from cadalign.evaluation.experiments.unseen import UnseenOptions
from cadalign.evaluation.instances.unseen import UnseenObject, observe_object, unseen_tasks
from cadalign.evaluation.simulation import SimulatedProblem
from cadalign.geometry.rotations import vector_from_rotation

COMMAND = (sys.executable, "-c", "import sys; from cadalign.cli import main; sys.exit(main())")
"""What runs `cadalign`, wherever it is installed."""
LIMIT_DRAWS = 20
"""Draws of an ideal estimator's errors for each problem."""
_DATA = Path(os.environ["CADALIGN_DATA"]) if os.environ.get("CADALIGN_DATA") else None

Row = dict[str, Any]
T = TypeVar("T")


class NotGivenError(Exception):
    """A section cannot do without data that are not given."""


@dataclass(kw_only=True)
class BenchmarkData:
    """Data, seed and choice of the sections; CADALIGN_DATA names the folder of the data."""

    data: Path | None = _DATA
    """Folder of the data; some sections need it, others use it."""
    seed: int = 0
    """Seed of random problems."""
    count: int | None = None
    """Problems, objects, queries or calls of a row; by default the section's own number."""
    sizes: tuple[int, ...] = (50_000,)
    """Models of the synthetic libraries of the section retrieval."""
    out: Path = Path("bench")
    """Folder for what is measured: <section>.json."""
    sections: tyro.conf.Positional[tuple[str, ...]] = ()
    """Sections to run; by default all that need no asking for."""
    stored: Path = Path(__file__).parents[1] / "benchmark_ratios.json"
    """Ratios to compare with."""
    store: bool = False
    """Store the measured ratios."""

    def folder(self, *parts: str) -> Path:
        """A folder of the data; NotGivenError where none are given."""
        if self.data is None:
            raise NotGivenError("give --data, or CADALIGN_DATA")
        return self.data.joinpath(*parts)


Table = tuple[str, Iterable[Row]]
"""A title, and rows by column; a cell may be a median with a 90th percentile."""
Tables = Iterator[Table]
Section = Callable[[BenchmarkData], Tables]


def markdown(rows: Sequence[Row]) -> str:
    """The rows as a table in Markdown."""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    lines = [[_cell(row.get(column)) for column in columns] for row in rows]
    head = [columns, ["---:"] * len(columns)]
    return "\n".join(f"| {' | '.join(line)} |" for line in head + lines)


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, tuple):
        return f"{_cell(value[0])} ({_cell(value[1])})"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def figure(name: str, value: float, unit: str, ratio: float, to: str = "") -> Row:
    """A measured figure, and its ratio to a time that was measured in turns with it.

    The ratio depends little on the machine, and less is better: `bench.py` compares it.
    """
    return {"name": name, "value": value, "unit": unit, "ratio": ratio, "to": to}


def spread(values: Any) -> tuple[float, float]:
    """Median and 90th percentile."""
    return float(np.median(values)), float(np.percentile(values, 90))


def percent(flags: Any) -> float:
    """Share of what is true [%]."""
    return 100 * float(np.mean(flags))


def summary(cases: Sequence[Row]) -> Row:
    """Number of cases, medians of their numbers, shares of their flags."""
    found: Row = {"count": len(cases)}
    for name in cases[0]:
        values = [case[name] for case in cases]
        take = np.mean if isinstance(values[0], bool | np.bool_) else np.nanmedian
        found[name] = float(take(values))
    return found


# Cases --------------------------------------------------------------------------------------------


def attempt(call: Callable[..., T], *given: Any, **options: Any) -> T | None:
    """Call a function; None where it raises a CadalignError."""
    try:
        return call(*given, **options)
    except CadalignError:
        return None


def fitted(problem: SimulatedProblem, **options: Any) -> cadalign.Result | None:
    """The fit of a simulated problem; None where it is refused."""
    given = problem.points_3d, problem.points_2d, problem.camera
    return attempt(cadalign.fit, *given, **options)


def seen_in(
    camera: cadalign.Camera,
    pose: cadalign.Alignment,
    points_3d: FloatArray,
    noise_px: float,
    rng: np.random.Generator,
) -> SimulatedProblem:
    """The problem of points (n, 3) of a model in an image, with Gaussian noise."""
    pixels = camera.project(pose.apply(points_3d))
    pixels += noise_px * rng.standard_normal(pixels.shape)
    return SimulatedProblem(points_3d, pixels, camera, pose, None)


def deviation(*, est: cadalign.Alignment, gt: cadalign.Alignment) -> FloatArray:
    """Errors (9,) in the order of a covariance: turn [rad], shift, logarithms of the scales."""
    turn = vector_from_rotation(est.rotation @ gt.rotation.T)
    return np.concatenate([turn, est.translation - gt.translation, np.log(est.scale / gt.scale)])


def meshed_models(
    given: BenchmarkData, folder: str, *, per_category: int
) -> tuple[list[AnnotatedModel], list[AnnotatedModel]]:
    """Models with meshes: the sample data set's, written to a folder, and ShapeNet's if given."""
    root = write_sample_dataset(Path(folder) / "sample", per_category=per_category)
    sample, real = (
        [] if place is None else [m for m in KeypointNet(place) if m.mesh_path is not None]
        for place in (root, given.data and given.folder("keypointnet"))
    )
    return sample, [model for model in real if model.mesh_path.suffix == ".obj"]


def learned_shape(dataset: KeypointNet, category: str) -> cadalign.ShapeModel:
    """The shape of a category, learned once from the split train."""
    return _learned_shape(dataset.root, category)


@cache
def _learned_shape(root: Path, category: str) -> cadalign.ShapeModel:
    dataset = KeypointNet(root)
    return cadalign.ShapeModel.from_dataset(dataset, category, split="train", meshes=False)


def unseen_objects(
    dataset: KeypointNet, category: str, count: int, **options: Any
) -> Iterator[tuple[int, UnseenObject]]:
    """So many objects of the split val, spread over all, each with its place among them.

    ``options`` are those of `cadalign evaluate unseen`.
    """
    chosen = UnseenOptions(root=dataset.root, categories=(category,), **options)
    tasks = unseen_tasks(dataset, chosen)
    for place in range(0, len(tasks), -(-len(tasks) // count)):
        seen = attempt(observe_object, tasks[place], chosen)
        if seen is not None:
            yield place, seen


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


def with_reference(call: Callable[[], T]) -> tuple[T, float]:
    """Value of a call, and the smaller of `reference_seconds` before and after it."""
    before = reference_seconds()
    found = call()
    return found, min(before, reference_seconds())


class Used(NamedTuple):
    """Wall clock and processor time of a command [s], and its largest process [MB]."""

    wall: float
    processor: float
    megabytes: float


def used_by(command: Sequence[str], **environment: str) -> Used:
    """Run a command that keeps byte code, and measure it with its workers; its rows may fail."""
    begun = time.perf_counter()
    process = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "", **environment},
    )
    _, status, usage = os.wait4(process.pid, 0)
    wall = time.perf_counter() - begun
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 3):  # 3: some rows failed
        raise subprocess.CalledProcessError(process.returncode, list(command))
    return Used(wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)


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
