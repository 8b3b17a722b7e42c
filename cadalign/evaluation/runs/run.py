"""Runs: an experiment over many tasks in a folder, that can be killed and started again.

A finished chunk is a file in ``parts`` of the run's folder (`cadalign.evaluation.runs.folder`),
which appears whole or not at all. Started again, a run does the chunks that have none, or whose
tables are damaged. Chunks are the same whatever the number of workers, and their rows follow from
the run's seed and the tasks' names, so nothing in ``results.parquet`` shows how often the run was
interrupted or who did the work.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from cadalign.arrays import is_whole as is_integer
from cadalign.errors import InputError, quote
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.parallel import Workers, in_processes, in_this_process, on_dask
from cadalign.evaluation.runs.tables import (
    SECONDS,
    is_whole,
    read_cells,
    write_rows,
    write_tables,
)
from cadalign.evaluation.runs.work import Columns, Experiment, Plan
from cadalign.io.files import made_folder

logger = logging.getLogger("cadalign")

T = TypeVar("T")


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
    workers: Workers,
    on_progress: OnProgress = lambda progress: None,
) -> None:
    """Do a run, or what is left of it; ``on_progress`` is told of every chunk."""
    folder.make()
    total = len(plan.tasks)
    with folder.locked():
        folder.claim({**plan.config, "tasks": total, "chunk_size": plan.chunk_size})
        _sweep(folder.path)
        if not folder.is_finished:
            _do_chunks(plan, folder, workers, on_progress)
            parts = [folder.part(k) for k in range(-(-total // plan.chunk_size))]
            tables = {folder.timings: SECONDS, folder.records: plan.experiment.record_columns}
            # The results last: they say that the run is done.
            for path, columns in {**tables, folder.results: plan.experiment.columns}.items():
                if columns:
                    is_record = path == folder.records
                    found = (read_cells(part, columns, is_record=is_record) for part in parts)
                    write_tables(path, columns, found)
        on_progress(Progress(total, total))
        shutil.rmtree(folder.parts, ignore_errors=True)


def workers_of(count: int, dask: str | None, *, threads: int = 1) -> Workers:
    """Choose workers by options; see `cadalign.evaluation.options.RunOptions`.

    ``threads`` share the work of a run without workers.
    """
    if dask is not None:
        return partial(on_dask, address=dask)
    if not is_integer(count) or count < -1:
        raise InputError(
            f"{quote(count)} is not a number of processes",
            where="workers",
            fix="give 1 or more, -1 for one for each core, 0 for none",
        )
    return (
        partial(in_processes, count=count) if count else partial(in_this_process, threads=threads)
    )


def _do_chunks(plan: Plan[T], folder: RunFolder, workers: Workers, on_progress: OnProgress) -> None:
    _sweep(made_folder(folder.parts))
    experiment, tasks, size = plan.experiment, plan.tasks, plan.chunk_size
    starts = range(0, len(tasks), size)
    missing = [k for k in range(len(starts)) if not _is_done(experiment, folder.part(k))]
    done = len(tasks) - sum(min(size, len(tasks) - starts[index]) for index in missing)
    on_progress(Progress(done, len(tasks)))
    if not missing:
        return
    chunks = ((index, tasks[starts[index] : starts[index] + size]) for index in missing)
    for (index, some), found in workers(experiment, chunks):
        write_rows(folder.part(index), _columns_of_parts(experiment), found)
        done += len(some)
        on_progress(Progress(done, len(tasks)))


def _is_done(experiment: Experiment[Any], part: Path) -> bool:
    """True if a chunk can be read; one that was done, but is damaged, is told of."""
    if not part.is_file():
        return False
    if not is_whole(part, _columns_of_parts(experiment)):
        logger.warning("%s: damaged; its tasks are done again", part)
        return False
    return True


def _columns_of_parts(experiment: Experiment[Any]) -> Columns:
    """Columns of the results, then the seconds, then what the records have besides."""
    own = [each for each in experiment.record_columns if each not in experiment.columns]
    return (*experiment.columns, *SECONDS, *own)


def _sweep(path: Path) -> None:
    """Remove what a killed process left half written."""
    for unfinished in path.glob(".unfinished-*"):
        unfinished.unlink(missing_ok=True)
