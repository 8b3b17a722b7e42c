"""Workers of a Dask cluster that exists already."""

from __future__ import annotations

import logging
import socket
from collections.abc import Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from cadalign.errors import CadalignError, DataError
from cadalign.evaluation.runs.parallel import Chunk, evaluate_on
from cadalign.evaluation.runs.work import Experiment, Rows
from cadalign.io.files import printable

T = TypeVar("T")


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


@dataclass(frozen=True)
class DaskWorkers:
    """The workers of a Dask cluster, whose scheduler has an address such as ``tcp://10.0.0.1:8786``.

    They need the same version of cadalign, and for meshes and overlays the same folders under the
    same names. Dask itself hands a chunk whose worker dies to others, until the cluster's
    ``distributed.scheduler.allowed-failures`` is exceeded.
    """

    address: str
    timeout: float = 30.0  # of the scheduler, and of its first worker [s]

    def evaluate(
        self, experiment: Experiment[T], chunks: Iterable[Chunk[T]]
    ) -> Iterator[tuple[Chunk[T], Rows]]:
        """See `cadalign.evaluation.runs.parallel.Workers`."""
        try:
            from distributed import Client, KilledWorker
        except ImportError:
            raise CadalignError(
                "Dask is not installed", where="--dask", fix="pip install 'cadalign[dask]'"
            ) from None
        try:
            _check_address(self.address)
            # `distributed` is not typed throughout.
            client: Any = Client(  # type: ignore[no-untyped-call]
                self.address, timeout=self.timeout, set_as_default=False
            )
        except (OSError, ValueError) as error:
            raise DataError(
                f"no Dask scheduler answers ({str(error)[:200]})",
                where=printable(self.address),
                fix="start one with `dask scheduler`, and give its address, tcp://host:8786",
            ) from None
        with _quiet(), client:
            try:
                client.wait_for_workers(1, timeout=self.timeout)
            except TimeoutError:
                raise DataError(
                    "the Dask cluster has no workers",
                    where=self.address,
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
                    where=self.address,
                    fix="start the same command again with a cluster: the run goes on",
                ) from None
            finally:
                executor.shutdown(wait=False)
