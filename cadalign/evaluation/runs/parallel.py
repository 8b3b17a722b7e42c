"""Workers of runs, here or on a cluster: chunks of tasks handed out, and deaths survived.

Processes on this machine and a Dask cluster are used through the standard library's executor
interface, so one loop serves both. A process that dies, by a segmentation fault, the system's
out-of-memory killer or a signal, takes the chunks with it that were under way. These are then done
again, one at a time; one that kills its worker then, too, becomes failed rows.
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
from types import ModuleType
from typing import Any, ParamSpec, TypeVar

from cadalign.arrays import worker_count
from cadalign.errors import CadalignError, DataError, InputError
from cadalign.evaluation.runs.work import AbortError, Experiment, Rows, reason_of
from cadalign.io.files import printable

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

# Sums that several threads share are rounded in another order than those of one.
_ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
KILLED_REASON = "its chunk killed a worker process twice (a crash, or out of memory)"


Chunk = tuple[int, Sequence[T]]
"""Successive tasks of a run, which has many, and their number."""
Evaluated = Iterator[tuple[Chunk[T], Rows]]
Workers = Callable[[Experiment[Any], Iterable[Chunk[Any]]], Evaluated[Any]]
"""Place where chunks are evaluated, which yields each with its result, in any order."""


def in_this_process(
    experiment: Experiment[T], chunks: Iterable[Chunk[T]], *, threads: int = 1
) -> Evaluated[T]:
    """Evaluate chunks here, in so many threads; a crash ends this process.

    Threads serve what lets go of the interpreter lock, such as drawing.
    """
    call = partial(evaluate_chunk, experiment)
    if threads > 1:
        experiment.warm_up()
        with ThreadPoolExecutor(threads) as pool:
            yield from _evaluated(lambda: pool, call, experiment, chunks, window=threads)
        return
    for chunk in chunks:
        yield chunk, call(chunk[1])


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
    """Processes that end with this one, and that do not run its script again."""

    def __init__(self, count: int) -> None:
        context = multiprocessing.get_context("spawn")
        super().__init__(count, mp_context=context, initializer=_start_worker)

    def submit(self, function: Callable[P, R], /, *args: P.args, **options: P.kwargs) -> Future[R]:
        """Hand out a call; a process is started where all are busy."""
        try:
            with _spawning():
                return super().submit(function, *args, **options)
        except OSError as error:  # no process can be started, or the pool is just breaking
            raise BrokenProcessPool(reason_of(error)) from None

    def kill(self) -> None:
        """End the processes, whatever they are doing."""
        processes = list((self._processes or {}).values())
        self.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.kill()
            process.join()


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
    start: Callable[[], Executor],
    experiment: Experiment[T],
    chunks: Iterable[Chunk[T]],
    *,
    window: int,
    deadly: type[Exception],
) -> Evaluated[T]:
    """Evaluate chunks on an executor of other processes; see `_evaluated`."""
    pickled = _pickled(experiment)
    living = partial(_living, start, pickled, deadly)
    call = partial(_evaluate_pickled, pickled)
    yield from _evaluated(living, call, experiment, chunks, window=window, deadly=(deadly,))


def _evaluated(
    start: Callable[[], Executor],
    call: Callable[[Sequence[T]], Rows],
    experiment: Experiment[T],
    chunks: Iterable[Chunk[T]],
    *,
    window: int,
    deadly: tuple[type[Exception], ...] = (),
) -> Evaluated[T]:
    """Evaluate chunks on an executor, ``window`` at a time.

    ``start`` gives one that works, and is asked again after every death; ``deadly`` is raised by a
    future whose worker has died. Chunks are asked for only as fast as they are evaluated.
    """
    executor = start()
    source = iter(chunks)
    running: dict[Future[Rows], Chunk[T]] = {}
    suspects: list[Chunk[T]] = []
    try:
        while True:
            while not suspects and len(running) < window:
                chunk = next(source, None)
                if chunk is None:
                    break
                try:
                    running[executor.submit(call, chunk[1])] = chunk
                except deadly:
                    suspects.append(chunk)
            if not running and not suspects:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                chunk = running.pop(future)
                try:
                    yield chunk, _result(future, deadly)
                except deadly:
                    suspects.append(chunk)
            if suspects and not running:
                executor = start()
                for chunk in suspects:
                    try:
                        rows = _result(executor.submit(call, chunk[1]), deadly)
                    except deadly:
                        executor = start()
                        failures = [experiment.failure(task, KILLED_REASON) for task in chunk[1]]
                        rows = Rows.joined(failures)
                    yield chunk, rows
                suspects = []
    finally:
        for future in running:
            future.cancel()


def _result(future: Future[R], deadly: tuple[type[Exception], ...]) -> R:
    try:
        return future.result()
    except Exception as error:
        if isinstance(error, (CadalignError, CancelledError, *deadly)):
            raise
        raise _cannot_work(reason_of(error)) from error


def _living(start: Callable[[], Executor], pickled: bytes, deadly: type[Exception]) -> Executor:
    """Start an executor, of which one worker has compiled what all will need."""
    for _ in range(3):  # someone may have killed it; not three times, though
        executor = start()
        try:
            _result(executor.submit(_warm_up, pickled), (deadly,))
            return executor
        except deadly as error:
            reason = reason_of(error)
    raise CadalignError(
        f"worker processes die before they are given any task: {reason}",
        where="workers",
        fix="is there enough memory? Try fewer workers, or none (0) to see the error",
    )


def _cannot_work(reason: str) -> CadalignError:
    return CadalignError(
        f"a worker cannot work: {reason}",
        where="workers",
        fix="cadalign must be installed there, in the same version as here, and modules of your "
        "functions, too",
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
@lru_cache(maxsize=1)
def _unpickled(pickled: bytes) -> Any:
    return pickle.loads(pickled)


def _warm_up(pickled: bytes) -> None:
    _unpickled(pickled).warm_up()


def _evaluate_pickled(pickled: bytes, tasks: Sequence[Any]) -> Rows:
    return evaluate_chunk(_unpickled(pickled), tasks)


def evaluate_chunk(experiment: Experiment[T], tasks: Sequence[T]) -> Rows:
    """Evaluate tasks; one that raises becomes failed rows and does not stop the others."""
    try:
        return experiment.evaluate(tasks)
    except AbortError as error:
        raise copy.copy(error) from None
    except Exception as error:
        if len(tasks) == 1:
            return experiment.failure(tasks[0], reason_of(error))
    return Rows.joined([evaluate_chunk(experiment, [task]) for task in tasks])


# Workers of a cluster -----------------------------------------------------------------------------


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


def on_dask(
    experiment: Experiment[T], chunks: Iterable[Chunk[T]], *, address: str, timeout: float = 30.0
) -> Evaluated[T]:
    """Evaluate chunks on a Dask cluster, whose scheduler's address is such as tcp://10.0.0.1:8786.

    Its workers need the same version of cadalign, and for meshes and overlays the same folders
    under the same names. Dask itself hands a chunk whose worker dies to others, until the cluster's
    ``distributed.scheduler.allowed-failures`` is exceeded. ``timeout`` is that of the scheduler,
    and of its first worker [s].
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
            raise DataError(
                "the Dask cluster has no workers",
                where=address,
                fix="start some with `dask worker ADDRESS`",
            ) from None
        threads = sum(client.nthreads().values())
        # Named by chance: to name a chunk by its content takes longer than to evaluate it.
        executor = client.get_executor(pure=False)
        try:
            # Clusters grow, and a round trip may cost more than a chunk.
            window = 2 * threads + 2
            yield from _evaluated_elsewhere(
                lambda: executor, experiment, chunks, window=window, deadly=KilledWorker
            )
        except Exception as error:
            if client.status == "running" and not isinstance(error, CancelledError):
                raise
            raise CadalignError(
                "the Dask cluster has gone away",
                where=address,
                fix="start the same command again with a cluster: the run goes on",
            ) from None
        finally:
            executor.shutdown(wait=False)
