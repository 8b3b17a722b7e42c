"""Engine of resumable runs: evaluates chunks of tasks on an executor and collects their rows.

One loop serves every `concurrent.futures.Executor`: threads of this process, processes of this
machine, or a Dask cluster. A finished chunk is a file in ``parts`` of the run's folder
(`cadalign.evaluation.runs.folder`), which is written atomically. A restarted run evaluates the
chunks without a file. Chunks do not depend on the number of workers, and their rows depend only on
the run's seed and the tasks' names, so ``results.parquet`` is reproducible.
"""

from __future__ import annotations

import copy
import pickle
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from cadalign.arrays import is_whole as is_integer
from cadalign.arrays import worker_count
from cadalign.errors import CadalignError, InputError, quote
from cadalign.evaluation.runs.executors import dask_cluster, process_pool, thread_pool
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import SECONDS, read_cells, write_rows, write_tables
from cadalign.evaluation.runs.work import AbortError, Columns, Experiment, Plan, Row, reason_of
from cadalign.io.files import create_folder

T = TypeVar("T")
Chunk = tuple[int, Sequence[Any]]
"""Index of a chunk, and its tasks."""

KILLED_REASON = "its chunk killed a worker process twice (a crash, or out of memory)"
_MOST_DEATHS = 3  # of executors in succession without a finished chunk


@dataclass(frozen=True)
class Progress:
    """Numbers of finished tasks and of all tasks."""

    done: int
    total: int


OnProgress = Callable[[Progress], object]


@dataclass(frozen=True)
class Workers:
    """Executor of chunks, and how it fails."""

    open: Callable[[], AbstractContextManager[tuple[Executor, int]]]
    """Opens an executor; also returns the maximum number of pending chunks."""
    deaths: tuple[type[Exception], ...] = ()
    """Errors of a future whose worker has died; empty for threads. If it is not empty, experiments
    are pickled."""


def workers_of(count: int, dask: str | None, *, threads: int = 1) -> Workers:
    """Choose workers by options; see `cadalign.evaluation.options.RunOptions`.

    A run without worker processes uses this many ``threads``.
    """
    if dask is not None:
        try:
            from distributed import KilledWorker
        except ImportError:
            fix = "pip install 'cadalign[dask]'"
            raise CadalignError("Dask is not installed", where="--dask", fix=fix) from None
        # A lost scheduler cancels all calls; the error comes from the attempt to reconnect.
        return Workers(partial(dask_cluster, dask), (KilledWorker, CancelledError))
    if not is_integer(count) or count < -1:
        raise InputError(
            f"{quote(count)} is not a number of processes",
            where="workers",
            fix="give 1 or more, -1 for one per core, or 0 for this process alone",
        )
    if count:
        return Workers(partial(process_pool, worker_count(count)), (BrokenProcessPool,))
    return Workers(partial(thread_pool, threads))


def execute(
    plan: Plan[T],
    folder: RunFolder,
    *,
    workers: Workers,
    on_progress: OnProgress = lambda progress: None,
) -> None:
    """Run a plan or continue it; ``on_progress`` is called after every chunk."""
    folder.make()
    experiment, total = plan.experiment, len(plan.tasks)
    with folder.lock():
        folder.claim({**plan.config, "tasks": total, "chunk_size": plan.chunk_size})
        _sweep(folder.path)
        if not folder.is_finished:
            _do_chunks(plan, folder, workers, on_progress)
            parts = [folder.part(k) for k in range(-(-total // plan.chunk_size))]
            tables = {folder.timings: SECONDS, folder.records: experiment.record_columns}
            # The results last: they mark the run as finished.
            for path, columns in {**tables, folder.results: experiment.columns}.items():
                if columns:
                    is_record = path == folder.records
                    found = (read_cells(part, columns, is_record=is_record) for part in parts)
                    write_tables(path, columns, found)
        on_progress(Progress(total, total))
        shutil.rmtree(folder.parts, ignore_errors=True)


def _do_chunks(plan: Plan[T], folder: RunFolder, workers: Workers, on_progress: OnProgress) -> None:
    _sweep(create_folder(folder.parts))
    experiment, tasks, size = plan.experiment, plan.tasks, plan.chunk_size
    own = [each for each in experiment.record_columns if each not in experiment.columns]
    columns: Columns = (*experiment.columns, *SECONDS, *own)
    starts = range(0, len(tasks), size)
    missing = [k for k in range(len(starts)) if not folder.part(k).is_file()]
    done = len(tasks) - sum(min(size, len(tasks) - starts[index]) for index in missing)
    on_progress(Progress(done, len(tasks)))
    chunks = ((index, tasks[starts[index] : starts[index] + size]) for index in missing)
    for (index, some), rows in evaluate_chunks(workers, experiment, chunks):
        write_rows(folder.part(index), columns, rows)
        done += len(some)
        on_progress(Progress(done, len(tasks)))


def _sweep(path: Path) -> None:
    """Remove unfinished files of killed processes."""
    for unfinished in path.glob(".unfinished-*"):
        unfinished.unlink(missing_ok=True)


# Chunks -------------------------------------------------------------------------------------------


def evaluate_chunks(
    workers: Workers, experiment: Experiment[Any], chunks: Iterable[Chunk]
) -> Iterator[tuple[Chunk, list[Row]]]:
    """Evaluate chunks and yield each with its rows, in any order.

    Chunks of workers that died are repeated at the end, one at a time. A chunk that kills its
    worker again gets failed rows.
    """
    call = partial(evaluate_chunk, experiment)
    if workers.deaths:
        call = partial(_evaluate_pickled, _pickle(experiment))
    lost: list[Chunk] = []
    yield from _evaluate_once(workers, call, chunks, lost)
    for chunk in lost:
        lost_again: list[Chunk] = []
        yield from _evaluate_once(workers, call, [chunk], lost_again)
        if lost_again:
            failures = [experiment.failure(task, KILLED_REASON) for task in chunk[1]]
            yield chunk, [row for rows in failures for row in rows]


def _evaluate_once(
    workers: Workers, call: Callable[..., Any], chunks: Iterable[Chunk], lost: list[Chunk]
) -> Iterator[tuple[Chunk, list[Row]]]:
    """Evaluate chunks once; chunks of dead workers are appended to ``lost``."""
    source, deaths = iter(chunks), 0
    running: dict[Future[list[Row]], Chunk] = {}
    window = 1  # the first chunk alone compiles the kernels for all workers
    while True:
        reason = ""  # set once the executor is dead
        with workers.open() as (executor, size):
            while True:
                for chunk in islice(source, 0 if reason else window - len(running)):
                    try:
                        running[executor.submit(call, chunk[1])] = chunk
                    except Exception as error:
                        # A process of the pool has died, or the scheduler is lost.
                        if not workers.deaths:
                            raise
                        reason = reason_of(error)
                        lost.append(chunk)
                        break
                if not running:
                    break
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    chunk = running.pop(future)
                    try:
                        rows = future.result()
                    except CadalignError:
                        raise
                    except workers.deaths as error:
                        reason = reason_of(error)
                        lost.append(chunk)
                    except Exception as error:
                        raise _worker_error(error) from error
                    else:
                        window, deaths = size, 0
                        yield chunk, rows
        if not reason:
            return
        deaths += 1
        if deaths == _MOST_DEATHS:
            fix = "there may be too little memory: try fewer workers, or 0 to see the error"
            what = f"worker processes die before they finish a chunk: {reason}"
            raise CadalignError(what, where="workers", fix=fix)


def _worker_error(error: Exception) -> CadalignError:
    return CadalignError(
        f"a worker failed: {reason_of(error)}",
        where="workers",
        fix="install the same version of cadalign, and the modules of your functions, for every "
        "worker",
    )


def evaluate_chunk(experiment: Experiment[T], tasks: Sequence[T]) -> list[Row]:
    """Evaluate tasks; a task that raises gets failed rows."""
    try:
        return experiment.evaluate(tasks)
    except AbortError as error:
        raise copy.copy(error) from None
    except Exception as error:
        if len(tasks) == 1:
            return experiment.failure(tasks[0], reason_of(error))
    return [row for task in tasks for row in evaluate_chunk(experiment, [task])]


def _pickle(experiment: Experiment[Any]) -> bytes:
    """Pickle an experiment; raises InputError for functions that workers cannot import."""
    try:
        pickled = pickle.dumps(experiment)
        reason = "it is defined in a script or a notebook" if b"__main__" in pickled else ""
    except Exception as error:
        reason = reason_of(error)[:200]
    if reason:
        raise InputError(
            f"a function cannot be sent to worker processes ({reason})",
            where="workers",
            fix="define it in an importable module, give module:function, or set workers to 0",
        )
    return pickled


# One object for all chunks of a process, so that its caches last.
_unpickle = lru_cache(maxsize=1)(pickle.loads)


def _evaluate_pickled(pickled: bytes, tasks: Sequence[Any]) -> list[Row]:
    return evaluate_chunk(_unpickle(pickled), tasks)
