"""Workers of runs: chunks handed to processes, or to a Dask cluster, and lost workers survived.

Both are used through the standard library's executor interface, so one loop serves both. The first
chunk is evaluated alone, which compiles the kernels that all workers need. A process that dies
takes the chunks with it that were under way. These are done again, one at a time; one that kills
its worker then, too, becomes failed rows.
"""

from __future__ import annotations

import copy
import logging
import multiprocessing
import os
import pickle
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import lru_cache, partial
from itertools import chain
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any, TypeVar

from cadalign.arrays import worker_count
from cadalign.errors import CadalignError, DataError, InputError
from cadalign.evaluation.runs.work import AbortError, Experiment, Row, reason_of
from cadalign.io.files import printable

T = TypeVar("T")

# Sums that several threads share are rounded in another order than those of one.
_ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
KILLED_REASON = "its chunk killed a worker process twice (a crash, or out of memory)"
_STARTS = 3  # of workers that die before they evaluate anything

Chunk = tuple[int, Sequence[T]]
"""Number of a chunk, and its tasks."""
Evaluated = Iterator[tuple[Chunk[T], list[Row]]]
Workers = Callable[[Experiment[Any], Iterable[Chunk[Any]]], Evaluated[Any]]
"""Place where chunks are evaluated, which yields each with its result, in any order."""


def in_this_process(
    experiment: Experiment[T], chunks: Iterable[Chunk[T]], *, threads: int = 1
) -> Evaluated[T]:
    """Evaluate chunks in threads of this process, for what lets go of the interpreter lock."""
    call = partial(evaluate_chunk, experiment)
    if threads == 1:
        for chunk in chunks:
            yield chunk, call(chunk[1])
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from _evaluated(lambda: pool, call, experiment, chunks, window=threads)


def in_processes(
    experiment: Experiment[T], chunks: Iterable[Chunk[T]], *, count: int
) -> Evaluated[T]:
    """Evaluate chunks in so many processes on this machine; -1 for one for each core."""
    count = worker_count(count)
    pools: list[_Processes] = []

    def start() -> Executor:
        pools.append(_Processes(count))
        return pools[-1]

    try:
        yield from _evaluated_elsewhere(
            start, experiment, chunks, window=count + 1, deadly=BrokenProcessPool
        )
    finally:
        for pool in pools:
            pool.kill()


class _Processes(ProcessPoolExecutor):
    """Processes that do not run this one's script again."""

    def __init__(self, count: int) -> None:
        context = multiprocessing.get_context("spawn")
        super().__init__(count, mp_context=context, initializer=_start_worker)
        self._started: set[BaseProcess] = set()

    def submit(self, *arguments: Any, **options: Any) -> Future[Any]:
        """Hand out a call; a process is started where all are busy."""
        before = set(multiprocessing.active_children())
        try:
            with _spawning():
                return super().submit(*arguments, **options)
        except OSError as error:  # no process can be started, or the pool is just breaking
            raise BrokenProcessPool(reason_of(error)) from None
        finally:
            self._started |= set(multiprocessing.active_children()) - before

    def kill(self) -> None:
        """End the processes, whatever they are doing; one that starts late would be waited for."""
        for process in self._started:
            process.kill()
        self.shutdown(cancel_futures=True)


@contextmanager
def _spawning() -> Iterator[None]:
    """Set what a new process is started with: one thread, and nothing of this one's script."""
    main, kept = sys.modules["__main__"], {name: os.environ.get(name) for name in _ENVIRONMENT}
    sys.modules["__main__"] = ModuleType("__main__")
    os.environ.update(_ENVIRONMENT)
    try:
        yield
    finally:
        sys.modules["__main__"] = main
        for name, value in kept.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _start_worker() -> None:
    sys.stdout = sys.stderr  # what functions print is not the command's output
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # without a traceback from each
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _evaluated_elsewhere(
    make: Callable[[], Executor],
    experiment: Experiment[T],
    chunks: Iterable[Chunk[T]],
    *,
    window: int,
    deadly: type[Exception],
) -> Evaluated[T]:
    """Evaluate chunks on an executor of other processes; see `_evaluated`."""
    pickled = _pickled(experiment)
    start, call = partial(_started, make, pickled, deadly), partial(_evaluate_pickled, pickled)
    yield from _evaluated(start, call, experiment, chunks, window=window, deadly=deadly)


def _evaluated(
    start: Callable[[], Executor],
    call: Callable[[Sequence[T]], list[Row]],
    experiment: Experiment[T],
    chunks: Iterable[Chunk[T]],
    *,
    window: int,
    deadly: type[Exception] = BrokenProcessPool,
) -> Evaluated[T]:
    """Evaluate chunks on an executor, at most ``window`` at a time.

    ``start`` gives one that works, and is asked again after every death; ``deadly`` is raised by a
    future whose worker has died. Chunks are taken only as fast as they are evaluated.
    """
    executor, source = start(), iter(chunks)
    is_warm = is_broken = False
    running: dict[Future[list[Row]], Chunk[T]] = {}
    lost: list[Chunk[T]] = []  # to be done again
    again: set[int] = set()
    try:
        while True:
            if is_broken and not running:
                executor, is_broken = start(), False
            is_alone = lost or not is_warm or again.intersection(k for k, _ in running.values())
            while len(running) < (1 if is_alone else window):
                chunk = lost.pop(0) if lost else next(source, None)
                if chunk is None:
                    break
                running[_submitted(executor, deadly, call, chunk[1])] = chunk
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                chunk = running.pop(future)
                try:
                    rows = _result(future, deadly)
                except deadly:
                    is_broken = True
                    if chunk[0] not in again:
                        again.add(chunk[0])
                        lost.append(chunk)
                        continue
                    failures = (experiment.failure(task, KILLED_REASON) for task in chunk[1])
                    rows = list(chain.from_iterable(failures))
                is_warm = True
                yield chunk, rows
    finally:
        for future in running:
            future.cancel()


def _submitted(
    executor: Executor, deadly: type[Exception], call: Callable[..., Any], *arguments: Any
) -> Future[Any]:
    """Hand out a call; the future of a dead executor has the error that says so."""
    try:
        return executor.submit(call, *arguments)
    except deadly as error:
        future: Future[Any] = Future()
        future.set_exception(error)
        return future


def _result(future: Future[Any], deadly: type[Exception]) -> Any:
    try:
        return future.result()
    except (CadalignError, CancelledError, deadly):
        raise
    except Exception as error:
        raise CadalignError(
            f"a worker cannot work: {reason_of(error)}",
            where="workers",
            fix="cadalign must be installed there, in the same version as here, and modules of "
            "your functions, too",
        ) from error


def _started(make: Callable[[], Executor], pickled: bytes, deadly: type[Exception]) -> Executor:
    """An executor of which one worker has loaded the experiment."""
    for _ in range(_STARTS):
        executor = make()
        try:
            _result(_submitted(executor, deadly, _load, pickled), deadly)
            return executor
        except deadly as error:
            reason = reason_of(error)
    raise CadalignError(
        f"worker processes die before they are given any task: {reason}",
        where="workers",
        fix="is there enough memory? Try fewer workers, or none (0) to see the error",
    )


def _pickled(experiment: Experiment[Any]) -> bytes:
    """The experiment for other processes; raises InputError for functions they cannot import."""
    try:
        pickled = pickle.dumps(experiment)
        reason = "it is defined in a script or a notebook" if b"__main__" in pickled else ""
    except Exception as error:
        reason = reason_of(error)[:200]
    if reason:
        raise InputError(
            f"a function cannot be sent to worker processes ({reason})",
            where="workers",
            fix="define it in a module that they can import, or name it module:function; or do "
            "without them (0)",
        )
    return pickled


# One object for all chunks of a process: what it keeps at hand is not made anew.
_unpickled = lru_cache(maxsize=1)(pickle.loads)


def _load(pickled: bytes) -> None:
    _unpickled(pickled)


def _evaluate_pickled(pickled: bytes, tasks: Sequence[Any]) -> list[Row]:
    return evaluate_chunk(_unpickled(pickled), tasks)


def evaluate_chunk(experiment: Experiment[T], tasks: Sequence[T]) -> list[Row]:
    """Evaluate tasks; one that raises becomes failed rows and does not stop the others."""
    try:
        return experiment.evaluate(tasks)
    except AbortError as error:
        raise copy.copy(error) from None
    except Exception as error:
        if len(tasks) == 1:
            return experiment.failure(tasks[0], reason_of(error))
    return [row for task in tasks for row in evaluate_chunk(experiment, [task])]


# Workers of a cluster -----------------------------------------------------------------------------


def on_dask(
    experiment: Experiment[T], chunks: Iterable[Chunk[T]], *, address: str, timeout: float = 30.0
) -> Evaluated[T]:
    """Evaluate chunks on the Dask cluster of a scheduler's address, such as tcp://10.0.0.1:8786.

    Its workers need the same version of cadalign, and the same folders under the same names. Dask
    itself hands a chunk whose worker dies to others, until its ``allowed-failures`` are exceeded.
    ``timeout`` is that of the scheduler, and of its first worker [s].
    """
    try:
        from distributed import Client, KilledWorker
    except ImportError:
        raise CadalignError(
            "Dask is not installed", where="--dask", fix="pip install 'cadalign[dask]'"
        ) from None
    try:
        _check_address(address)
        # `distributed` is not typed throughout.
        client: Any = Client(  # type: ignore[no-untyped-call]
            address, timeout=timeout, set_as_default=False
        )
    except (OSError, ValueError) as error:
        raise DataError(
            f"no Dask scheduler answers ({str(error)[:200]})",
            where=printable(address),
            fix="start one with `dask scheduler`, and give its address, tcp://host:8786",
        ) from None
    with _quiet(), client:
        try:
            client.wait_for_workers(1, timeout=timeout)
        except TimeoutError:
            fix = "start some with `dask worker ADDRESS`"
            raise DataError("the Dask cluster has no workers", where=address, fix=fix) from None
        # Named by chance: to name a chunk by its content takes longer than to evaluate it.
        executor = client.get_executor(pure=False)
        # Clusters grow, and a round trip may cost more than a chunk.
        window = 2 * sum(client.nthreads().values()) + 2
        try:
            yield from _evaluated_elsewhere(
                lambda: executor, experiment, chunks, window=window, deadly=KilledWorker
            )
        except Exception as error:
            if client.status == "running" and not isinstance(error, CancelledError):
                raise
            fix = "start the same command again with a cluster: the run goes on"
            what = "the Dask cluster has gone away"
            raise CadalignError(what, where=address, fix=fix) from None
        finally:
            executor.shutdown(wait=False)


def _check_address(address: str) -> None:
    """Raise a ValueError or OSError for what is no address: a client of it could not be closed."""
    from distributed.comm.addressing import get_address_host_port

    if not address.startswith("inproc://"):
        host, port = get_address_host_port(address)
        if not 0 < port < 2**16:
            raise ValueError(f"{port} is not a port")
        socket.getaddrinfo(host, port)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the client's tracebacks about lost connections from the user, who gets an error."""
    loggers = [logging.getLogger(f"distributed.{name}") for name in ("client", "utils")]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.CRITICAL)
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
