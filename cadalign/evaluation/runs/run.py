"""Runs: an experiment over many tasks in a folder, that can be killed and started again.

A finished chunk is a file in ``parts`` of the run's folder (`cadalign.evaluation.runs.folder`),
which appears whole or not at all. Started again, a run does the chunks that have none. Chunks are
the same whatever the number of workers, and their rows follow from the run's seed and the tasks'
names, so nothing in ``results.parquet`` tells how often the run was interrupted or who did the
work.

To evaluate something else, write an `Experiment` (``work.py``) and a sequence of tasks, and call
`execute`.
"""

from __future__ import annotations

import os
import platform
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from cadalign.errors import InputError
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.parallel import Chunk, InProcess, LocalProcesses, Workers
from cadalign.evaluation.runs.tables import read_table, write_rows, write_tables
from cadalign.evaluation.runs.work import Columns, Exhibiting, Experiment
from cadalign.io.files import write_json, writing

T = TypeVar("T")

_PROGRESS_EVERY = 1.0  # seconds


@dataclass(frozen=True)
class Progress:
    """How far a run is.

    Parameters
    ----------
    done, total : int
        Tasks.
    """

    done: int
    total: int


def execute(
    experiment: Experiment[T],
    tasks: Sequence[T],
    folder: RunFolder,
    *,
    config: dict[str, Any],
    chunk_size: int,
    workers: Workers | None = None,
    on_progress: Callable[[Progress], object] = lambda progress: None,
) -> None:
    """Do a run, or what is left of it.

    Parameters
    ----------
    experiment : Experiment
    tasks : sequence
        In the order of the result table. Sliced, and only as far as chunks are handed out.
    folder : RunFolder
    config : dict
        All that the results depend on, JSON; the run can only go on with the same.
    chunk_size : int
        How many tasks a worker gets at a time.
    workers : Workers, optional
        By default a process for each core.
    on_progress : callable
        Told of every chunk.

    Raises
    ------
    DataError
        If the folder holds another run, another process works on it, or it cannot be written.
    CadalignError
        If workers cannot work.
    """
    folder.make()
    with folder.locked():
        folder.claim({**config, "tasks": len(tasks), "chunk_size": chunk_size})
        _sweep(folder.path)
        if not folder.is_finished:
            _do_chunks(
                experiment, tasks, folder, chunk_size, workers or LocalProcesses(), on_progress
            )
            _assemble(experiment, folder, -(-len(tasks) // chunk_size))
        on_progress(Progress(len(tasks), len(tasks)))
        shutil.rmtree(folder.parts, ignore_errors=True)


def workers_of(count: int, *, dask: str | None = None) -> Workers:
    """The workers that the command line's options name.

    Parameters
    ----------
    count : int
        Processes; -1 for one for each core, 0 for none: all in this process.
    dask : str, optional
        The address of a Dask scheduler, whose workers are used instead.

    Raises
    ------
    InputError
        If the number is none.
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


def _do_chunks(
    experiment: Experiment[T],
    tasks: Sequence[T],
    folder: RunFolder,
    chunk_size: int,
    workers: Workers,
    on_progress: Callable[[Progress], object],
) -> None:
    """Do the chunks that are not done."""
    with writing(folder.parts):
        folder.parts.mkdir(exist_ok=True)
        _sweep(folder.parts)
    starts = range(0, len(tasks), chunk_size)
    missing = [index for index in range(len(starts)) if not folder.part(index).is_file()]
    done = len(tasks) - sum(min(chunk_size, len(tasks) - starts[index]) for index in missing)
    diary = _Diary(folder, len(tasks), done)
    on_progress(Progress(done, len(tasks)))
    chunks = (Chunk(index, tasks[starts[index] : starts[index] + chunk_size]) for index in missing)
    if not missing:
        return
    exhibited = _exhibit_columns(experiment)
    for chunk, result in workers.evaluate(experiment, chunks):
        # The results last: they say that the chunk is done.
        write_rows(folder.part_timings(chunk.index), experiment.timing_columns, result.timings)
        if exhibited:
            write_rows(folder.part_exhibits(chunk.index), exhibited, result.exhibits)
        write_rows(folder.part(chunk.index), experiment.columns, result.rows)
        done += len(chunk.tasks)
        diary.note(done)
        on_progress(Progress(done, len(tasks)))
    diary.note(done, last=True)


def _assemble(experiment: Experiment[Any], folder: RunFolder, chunks: int) -> None:
    """Make one table of the chunks' tables."""
    write_tables(
        folder.timings,
        experiment.timing_columns,
        (read_table(folder.part_timings(index)) for index in range(chunks)),
    )
    exhibited = _exhibit_columns(experiment)
    if exhibited:
        write_tables(
            folder.exhibits,
            exhibited,
            (read_table(folder.part_exhibits(index)) for index in range(chunks)),
        )
    # The results last: they say that the run is finished.
    write_tables(
        folder.results,
        experiment.columns,
        (read_table(folder.part(index)) for index in range(chunks)),
    )


def _exhibit_columns(experiment: Experiment[Any]) -> Columns:
    """The columns of an experiment's exhibits; none if it has no exhibits."""
    return experiment.exhibit_columns if isinstance(experiment, Exhibiting) else ()


class _Diary:
    """Keeps ``progress.json``."""

    def __init__(self, folder: RunFolder, total: int, done: int) -> None:
        self._file = folder.progress
        self._total = total
        self._done_before = done
        self._start = time.time()
        self._written = 0.0

    def note(self, done: int, *, last: bool = False) -> None:
        """Write how far the run is, if it was not written just now."""
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
