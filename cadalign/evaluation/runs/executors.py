"""Executors of runs: threads, processes of this machine, and the workers of a Dask cluster.

Each is opened as a context manager, which gives the executor, and how many chunks it is given at a
time.
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

# Sums that several threads share are rounded in another order than those of one.
_ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@contextmanager
def in_threads(count: int) -> Iterator[tuple[Executor, int]]:
    """Threads of this process, for what lets go of the interpreter lock."""
    with _cancelling(ThreadPoolExecutor(count)) as executor:
        yield executor, count


@contextmanager
def processes(count: int) -> Iterator[tuple[Executor, int]]:
    """Processes of one thread each, which do not run this one's script again."""
    main, kept = sys.modules["__main__"], {name: os.environ.get(name) for name in _ENVIRONMENT}
    sys.modules["__main__"] = ModuleType("__main__")
    os.environ.update(_ENVIRONMENT)
    try:
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker)
        with _cancelling(pool) as executor:
            yield executor, count + 1
    finally:
        sys.modules["__main__"] = main
        for name, value in kept.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


@contextmanager
def _cancelling(executor: Executor) -> Iterator[Executor]:
    """The executor; at the end it finishes what it is doing, and does not begin anything else."""
    try:
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)


def _start_worker() -> None:
    sys.stdout = sys.stderr  # what functions print is not the command's output
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # without a traceback from each
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


@contextmanager
def cluster(address: str, *, timeout: float = 15.0) -> Iterator[tuple[Executor, int]]:
    """The Dask cluster of a scheduler's address, such as tcp://10.0.0.1:8786.

    Its workers need the same version of cadalign, and the same folders under the same names. Dask
    itself hands a chunk whose worker dies to others, until its ``allowed-failures`` are exceeded.
    ``timeout`` is that of the scheduler, and of its first worker [s].
    """
    from distributed import Client
    from distributed.utils import silence_logging_cmgr

    # Lost connections are errors for the user, without the client's tracebacks.
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
            # Named by chance: to name a chunk by its content takes longer than to evaluate it.
            executor = client.get_executor(pure=False)
            # Clusters grow, and a round trip may cost more than a chunk.
            yield executor, 2 * sum(client.nthreads().values()) + 2
