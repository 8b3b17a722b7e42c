"""Shared code of the sections of `bench.py`: data, tables of methods on cases, and clocks."""

from __future__ import annotations

import os
import subprocess
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import tyro

import cadalign
from cadalign import CadalignError
from cadalign.arrays import FloatArray
from cadalign.datasets import KeypointNet
from cadalign.errors import DataError
from cadalign.evaluation.experiments.unseen import UnseenOptions
from cadalign.evaluation.instances.unseen import UnseenObject, observe_object, unseen_tasks
from cadalign.geometry.rotations import vector_from_rotation

_DATA = Path(os.environ["CADALIGN_DATA"]) if os.environ.get("CADALIGN_DATA") else None

Row = dict[str, Any]
Table = tuple[str, Iterable[Row]]
"""A title and rows; a cell may be a pair of median and 90th percentile."""
Tables = Iterator[Table]
T = TypeVar("T")


@dataclass(kw_only=True)
class BenchmarkData:
    """Data, seed and choice of sections."""

    data: Path | None = _DATA
    """Folder of the data, which some sections need; CADALIGN_DATA by default."""
    seed: int = 0
    """Seed of the random number generators."""
    count: int | None = None
    """Number of problems, objects, queries or calls per row; the default depends on the section."""
    sizes: tuple[int, ...] = (50_000,)
    """Numbers of models in the synthetic libraries of the section retrieval."""
    sections: tyro.conf.Positional[tuple[str, ...]] = ()
    """Sections to run; all except evidence, photo and cars by default."""

    def folder(self, *parts: str) -> Path:
        """A folder of the data; raises DataError if there is no data."""
        if self.data is None:
            raise DataError("give --data, or set CADALIGN_DATA")
        return self.data.joinpath(*parts)


Section = Callable[[BenchmarkData], Tables]


# Cases by methods ---------------------------------------------------------------------------------


def attempt(call: Callable[..., T], *given: Any, **options: Any) -> T | None:
    """Call a function; None if it raises a CadalignError."""
    try:
        return call(*given, **options)
    except CadalignError:
        return None


def measure(
    cases: Iterable[tuple[Row, T]], methods: Mapping[str, Callable[[T], Row]]
) -> Iterator[Row]:
    """Run methods on cases: rows with the case's labels, the method's name, and its measurements.

    A CadalignError gives no row.
    """
    for labels, case in cases:
        for name, measure in methods.items():
            row = attempt(measure, case)
            if row is not None:
                yield labels | {"method": name} | row


def summaries(rows: Iterable[Row], *by: str) -> list[Row]:
    """Summarize groups of rows with equal cells in the columns ``by``.

    A summary has the number of rows, the share of true flags [%], and median and 90th percentile of
    other numbers. Cells that are None or missing do not count.
    """
    groups: dict[tuple[Any, ...], list[Row]] = defaultdict(list)
    for row in rows:
        groups[tuple(row[name] for name in by)].append(row)
    found = []
    for key, group in groups.items():
        found.append(dict(zip(by, key, strict=True)) | {"count": len(group)})
        for name in (name for name in group[0] if name not in by):
            values = [row[name] for row in group if row.get(name) is not None]
            if values and not isinstance(values[0], str):
                is_flag = isinstance(values[0], bool | np.bool_)
                found[-1][name] = 100 * float(np.mean(values)) if is_flag else spread(values)
    return found


def spread(values: Any) -> tuple[float, float]:
    """Median and 90th percentile."""
    return float(np.median(values)), float(np.percentile(values, 90))


def figure(name: str, value: float, unit: str, ratio: float, to: str) -> Row:
    """A row with a measured value, and its ratio to a reference measured on the same machine."""
    return {"name": name, "value": value, "unit": unit, "ratio": ratio, "to": to}


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


def deviation(*, est: cadalign.Alignment, gt: cadalign.Alignment) -> FloatArray:
    """Errors (9,) in the order of a covariance: rotation [rad], translation, logs of scales."""
    turn = vector_from_rotation(est.rotation @ gt.rotation.T)
    return np.concatenate([turn, est.translation - gt.translation, np.log(est.scale / gt.scale)])


@cache
def learned_shape(root: Path, category: str) -> cadalign.ShapeModel:
    """The shape of a category of KeypointNet, learned from the split train."""
    dataset = KeypointNet(root)
    return cadalign.ShapeModel.from_dataset(dataset, category, split="train", meshes=False)


def unseen_objects(
    root: Path, category: str, count: int, **options: Any
) -> Iterator[tuple[int, UnseenObject]]:
    """Up to ``count`` objects, drawn from a split, each with its index.

    ``options`` are those of `cadalign evaluate unseen`.
    """
    chosen = UnseenOptions(root=root, categories=(category,), **options)
    tasks = unseen_tasks(KeypointNet(root), chosen)
    drawn = np.random.default_rng(chosen.seed).permutation(len(tasks))[:count]
    for place in sorted(drawn.tolist()):
        seen = attempt(observe_object, tasks[place], chosen)
        if seen is not None:
            yield place, seen


# Clocks -------------------------------------------------------------------------------------------


def clock(call: Callable[[], T]) -> tuple[float, float, T]:
    """Wall clock and processor time of a call [s], and its value."""
    wall, busy = time.perf_counter(), time.process_time()
    found = call()
    return time.perf_counter() - wall, time.process_time() - busy, found


def seconds(call: Callable[[], object]) -> float:
    """Wall clock time of a call [s]."""
    return clock(call)[0]


def measure_command(command: Sequence[str], **environment: str) -> tuple[float, float]:
    """Run a command that keeps byte code; its time [s], and the memory of its largest process [MB].

    Some of its rows may fail.
    """
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
    return wall, usage.ru_maxrss / 1024
