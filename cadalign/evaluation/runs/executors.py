"""Executors of runs: threads, processes of this machine, and the workers of a Dask cluster.

Each is a context manager that yields the executor and the maximum number of pending chunks.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from types import ModuleType
from typing import Any

from cadalign.errors import DataError
from cadalign.io.files import printable

# One thread per worker: the rounding of sums depends on the number of threads.
_ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@contextmanager
def thread_pool(count: int) -> Iterator[tuple[Executor, int]]:
    """Threads of this process, for functions that release the interpreter lock."""
    with _cancel_at_exit(ThreadPoolExecutor(count)) as executor:
        yield executor, count


@contextmanager
def process_pool(count: int) -> Iterator[tuple[Executor, int]]:
    """Processes with one thread each, which do not import this process's main script."""
    main, kept = sys.modules["__main__"], {name: os.environ.get(name) for name in _ENVIRONMENT}
    sys.modules["__main__"] = ModuleType("__main__")
    os.environ.update(_ENVIRONMENT)
    try:
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker)
        with _cancel_at_exit(pool) as executor:
            yield executor, count + 1
    finally:
        sys.modules["__main__"] = main
        for name, value in kept.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


@contextmanager
def _cancel_at_exit(executor: Executor) -> Iterator[Executor]:
    """Yield the executor; at the end, cancel pending calls and wait for running ones."""
    try:
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)


def _start_worker() -> None:
    sys.stdout = sys.stderr  # keep prints of functions out of the command's output
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback from each process
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


@contextmanager
def dask_cluster(address: str, *, timeout: float = 15.0) -> Iterator[tuple[Executor, int]]:
    """The Dask cluster of a scheduler's address, such as tcp://10.0.0.1:8786.

    Workers need the same version of cadalign, and the same folders at the same paths. Dask repeats
    the chunk of a dead worker on others, up to its setting ``allowed-failures``. ``timeout`` [s]
    limits the wait for the scheduler and for the first worker.
    """
    from distributed import Client
    from distributed.utils import silence_logging_cmgr

    # Lost connections are reported as errors; the client's tracebacks would repeat them.
    with silence_logging_cmgr(logging.CRITICAL):
        try:
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
        with client:
            try:
                client.wait_for_workers(1, timeout=timeout)
            except TimeoutError:
                fix = "start some with `dask worker ADDRESS`"
                raise DataError("the Dask cluster has no workers", where=address, fix=fix) from None
            # pure=False: hashing the content of a chunk takes longer than evaluating it.
            executor = client.get_executor(pure=False)
            # Twice the threads: a round trip may take longer than a chunk.
            yield executor, 2 * sum(client.nthreads().values()) + 2
