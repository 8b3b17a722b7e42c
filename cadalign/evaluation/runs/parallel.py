"""Workers of runs, here or on a cluster: chunks of tasks handed out, and deaths survived.

The processes are joblib's (loky) or a Dask cluster's; both are used through the standard library's
executor interface, so one loop serves both. A process that dies, by a segmentation fault, the
system's out-of-memory killer or a signal, takes the chunks with it that were under way. These are
then handed out again, one at a time, in halves and halves of halves where one dies again, until it
is known which single task it is. A task that has killed its worker twice, all alone, becomes failed
rows.
"""

from __future__ import annotations

import copy
import logging
import os
import pickle
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import chain, islice
from typing import Any, TypeVar, cast

from cadalign.errors import CadalignError, DataError
from cadalign.evaluation.runs.work import AbortError, Experiment, Rows, reason_of
from cadalign.io.files import printable

T = TypeVar("T")

_STRIKES = 2
_IDLE_SECONDS = 30
_LOOK_AFTER_PARENT = 1.0  # seconds
# Sums that several threads share are rounded in another order than those of one.
_ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
KILLED_REASON = f"it killed its worker process {_STRIKES} times (a crash, or out of memory)"


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
    if threads > 1:
        with ThreadPoolExecutor(threads) as pool:
            yield from evaluate_on(lambda: pool, experiment, chunks, window=threads, deadly=())
        return
    for chunk in chunks:
        yield chunk, evaluate_chunk(experiment, chunk[1])


def in_processes(
    experiment: Experiment[T], chunks: Iterable[Chunk[T]], *, count: int
) -> Evaluated[T]:
    """Evaluate chunks in so many processes on this machine, joblib's; -1 for one for each core.

    There are no more processes than chunks, since each takes a moment to start.
    """
    from joblib import cpu_count
    from joblib.externals.loky import get_reusable_executor

    source = iter(chunks)
    first = list(islice(source, cpu_count() if count < 0 else count))
    count = max(1, len(first))
    used: list[Executor] = []

    def executor() -> Executor:
        # A broken one is replaced; workers wait a while for more, then end by themselves.
        pool = get_reusable_executor(
            max_workers=count,
            timeout=_IDLE_SECONDS,
            env=_ENVIRONMENT,
            initializer=_start,
            initargs=(os.getpid(),),
        )
        used[:] = [pool]
        return cast(Executor, pool)

    try:
        yield from evaluate_on(
            executor,
            experiment,
            chain(first, source),
            window=count + 1,
            deadly=(BrokenProcessPool,),
        )
    finally:
        for pool in used:
            pool.shutdown(wait=True, kill_workers=True)  # type: ignore[call-arg]


def _start(parent: int) -> None:
    sys.stdout = sys.stderr  # what functions print is not the command's output
    _end_with(parent)


def _end_with(parent: int) -> None:
    """End this worker once its parent is gone: a killed one has no chance to say so."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK_AFTER_PARENT)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def evaluate_on(
    executor: Callable[[], Executor],
    experiment: Experiment[T],
    chunks: Iterable[Chunk[T]],
    *,
    window: int,
    deadly: tuple[type[BaseException], ...],
) -> Evaluated[T]:
    """Evaluate chunks on an executor, ``window`` at a time.

    ``executor`` gives one that works, and is asked again after every death; ``deadly`` is raised by
    a future whose worker has died. Chunks are asked for only as fast as they are evaluated.
    """
    _check_life(executor, experiment, deadly)
    source = iter(chunks)
    running: dict[Future[Rows], Chunk[T]] = {}
    suspects: list[Chunk[T]] = []
    exhausted = False
    try:
        while True:
            while not exhausted and not suspects and len(running) < window:
                chunk = next(source, None)
                if chunk is None:
                    exhausted = True
                    break
                try:
                    future = executor().submit(evaluate_chunk, experiment, chunk[1])
                except deadly:
                    suspects.append(chunk)
                    break
                running[future] = chunk
            if not running and not suspects:
                return
            done = wait(running, return_when=FIRST_COMPLETED).done if running else ()
            for future in done:
                chunk = running.pop(future)
                try:
                    yield chunk, future.result()
                except deadly:
                    suspects.append(chunk)
                except (CadalignError, CancelledError):
                    raise
                except Exception as error:
                    raise _cannot_work(reason_of(error)) from error
            if suspects and not running:
                for chunk in suspects:
                    yield chunk, _alone(executor, experiment, chunk[1], deadly)
                suspects = []
    finally:
        for future in running:
            future.cancel()


def _alone(
    executor: Callable[[], Executor],
    experiment: Experiment[T],
    tasks: Sequence[T],
    deadly: tuple[type[BaseException], ...],
) -> Rows:
    """Evaluate tasks with nothing else under way, to find out which of them kills its worker."""
    for _ in range(_STRIKES if len(tasks) == 1 else 1):
        try:
            return executor().submit(evaluate_chunk, experiment, tasks).result()
        except deadly:
            _check_life(executor, experiment, deadly)
    if len(tasks) == 1:
        return experiment.failure(tasks[0], KILLED_REASON)
    middle = len(tasks) // 2
    halves = [tasks[:middle], tasks[middle:]]
    return Rows.joined([_alone(executor, experiment, half, deadly) for half in halves])


def _check_life(
    executor: Callable[[], Executor],
    experiment: Experiment[T],
    deadly: tuple[type[BaseException], ...],
) -> None:
    """Let one worker compile what all will need, and see that it lives."""
    if deadly:
        pickle.dumps(experiment)  # says which function cannot be sent, where an executor does not
    for attempt in range(3):
        try:
            executor().submit(experiment.warm_up).result()
        except deadly as error:  # someone may have killed it; not three times, though
            if attempt == 2:
                raise CadalignError(
                    f"worker processes die before they are given any task: {reason_of(error)}",  # type: ignore[arg-type]
                    where="workers",
                    fix="is there enough memory? Try fewer workers, or none (0) to see the error",
                ) from None
        except ImportError as error:
            raise _cannot_work(str(error)) from error
        else:
            return


def _cannot_work(reason: str) -> CadalignError:
    return CadalignError(
        f"a worker cannot work: {reason}",
        where="workers",
        fix="cadalign must be installed there, in the same version as here",
    )


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
            yield from evaluate_on(
                lambda: executor,
                experiment,
                chunks,
                # Clusters grow, and a round trip may cost more than a chunk.
                window=2 * threads + 2,
                deadly=(KilledWorker,),
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
