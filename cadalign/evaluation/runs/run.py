"""Runs: an experiment over many tasks in a folder, that can be killed and started again.

A finished chunk is a file in ``parts`` of the run's folder (`cadalign.evaluation.runs.folder`),
which appears whole or not at all. Started again, a run does the chunks that have none. Chunks are
the same whatever the number of workers, and their rows follow from the run's seed and the tasks'
names, so nothing in ``results.parquet`` tells how often the run was interrupted or who did the
work.

An experiment of one's own is a `Spec` (`cadalign.evaluation.registry`).
"""

from __future__ import annotations

import os
import platform
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from cadalign.errors import InputError
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.parallel import Chunk, InProcess, LocalProcesses, Workers
from cadalign.evaluation.runs.tables import Columns, read_table, write_rows, write_tables
from cadalign.evaluation.runs.work import Experiment, Plan, Recording
from cadalign.io.files import write_json, writing

T = TypeVar("T")

_PROGRESS_EVERY = 1.0  # seconds


@dataclass(frozen=True)
class Progress:
    """Number of tasks that are done, and of all."""

    done: int
    total: int


OnProgress = Callable[[Progress], object]


def execute(
    plan: Plan[T],
    folder: RunFolder,
    *,
    workers: Workers | None = None,
    on_progress: OnProgress = lambda progress: None,
) -> None:
    """Do a run, or what is left of it.

    Parameters
    ----------
    workers : Workers, optional
        By default a process for each core.
    on_progress : callable
        Told of every chunk.
    """
    folder.make()
    total = len(plan.tasks)
    with folder.locked():
        folder.claim({**plan.config, "tasks": total, "chunk_size": plan.chunk_size})
        _sweep(folder.path)
        if not folder.is_finished:
            _do_chunks(plan, folder, workers or LocalProcesses(), on_progress)
            _assemble(plan.experiment, folder, -(-total // plan.chunk_size))
        on_progress(Progress(total, total))
        shutil.rmtree(folder.parts, ignore_errors=True)


def workers_of(count: int, *, dask: str | None = None) -> Workers:
    """Choose workers by the command line's options.

    Parameters
    ----------
    count : int
        Processes; -1 for one for each core, 0 for none: all in this process.
    dask : str, optional
        Address of a Dask scheduler, whose workers are used instead.
    """
    if dask is not None:
        from cadalign.evaluation.runs.cluster import DaskWorkers

        return DaskWorkers(dask)
    if count < -1:
        raise InputError(
            f"{count} is not a number of processes",
            where="workers",
            fix="give 1 or more, -1 for one for each core, 0 for none",
        )
    return LocalProcesses(count) if count else InProcess()


def _do_chunks(plan: Plan[T], folder: RunFolder, workers: Workers, on_progress: OnProgress) -> None:
    """Do the chunks that are not done."""
    with writing(folder.parts):
        folder.parts.mkdir(exist_ok=True)
        _sweep(folder.parts)
    experiment, tasks, size = plan.experiment, plan.tasks, plan.chunk_size
    starts = range(0, len(tasks), size)
    missing = [index for index in range(len(starts)) if not folder.part(index).is_file()]
    done = len(tasks) - sum(min(size, len(tasks) - starts[index]) for index in missing)
    progress_file = _ProgressFile(folder, len(tasks), done)
    on_progress(Progress(done, len(tasks)))
    if not missing:
        return
    chunks = (Chunk(index, tasks[starts[index] : starts[index] + size]) for index in missing)
    recorded = _record_columns(experiment)
    for chunk, found in workers.evaluate(experiment, chunks):
        # The results last: they say that the chunk is done.
        write_rows(folder.part_timings(chunk.index), experiment.timing_columns, found.timings)
        if recorded:
            write_rows(folder.part_records(chunk.index), recorded, found.records)
        write_rows(folder.part(chunk.index), experiment.columns, found.rows)
        done += len(chunk.tasks)
        progress_file.note(done)
        on_progress(Progress(done, len(tasks)))
    progress_file.note(done, last=True)


def _assemble(experiment: Experiment[Any], folder: RunFolder, chunks: int) -> None:
    """Make one table of the chunks' tables."""

    def assemble(path: Path, columns: Columns, part: Callable[[int], Path]) -> None:
        write_tables(path, columns, (read_table(part(index)) for index in range(chunks)))

    assemble(folder.timings, experiment.timing_columns, folder.part_timings)
    recorded = _record_columns(experiment)
    if recorded:
        assemble(folder.records, recorded, folder.part_records)
    # The results last: they say that the run is finished.
    assemble(folder.results, experiment.columns, folder.part)


def _record_columns(experiment: Experiment[Any]) -> Columns:
    """The columns of an experiment's instance records; none if it keeps none."""
    return experiment.record_columns if isinstance(experiment, Recording) else ()


class _ProgressFile:
    """Keeps ``progress.json``."""

    def __init__(self, folder: RunFolder, total: int, done: int) -> None:
        self._file = folder.progress
        self._total = total
        self._done_before = done
        self._start = time.time()
        self._written = 0.0

    def note(self, done: int, *, last: bool = False) -> None:
        """Write the progress, if it was not written just now."""
        now = time.time()
        if not last and now - self._written < _PROGRESS_EVERY:
            return
        self._written = now
        write_json(
            self._file,
            {
                "tasks_done": done,
                "tasks": self._total,
                "tasks_done_before": self._done_before,
                "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(self._start)),
                "seconds": round(now - self._start, 3),
                "host": platform.node(),
                "process": os.getpid(),
            },
        )


def _sweep(path: Path) -> None:
    """Remove what a killed process left half written."""
    for unfinished in path.glob(".unfinished-*"):
        unfinished.unlink(missing_ok=True)
