"""Connections to the annotator: few at a time, and closed where no whole request comes."""

from __future__ import annotations

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol

from cadalign.annotate.guard import PATIENCE

MOST_CONNECTIONS = 64


class BoundedProtocol(H11Protocol):
    """HTTP/1.1 whose requests have to begin, and their heads to end, within `PATIENCE`.

    Of more than `MOST_CONNECTIONS`, the one that has been open longest without a request under way
    is closed. Bodies are waited for by `cadalign.annotate.guard.Guard`.
    """

    _deadline: asyncio.TimerHandle | None = None
    _opened = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for a request."""
        super().connection_made(transport)
        self._opened = self.loop.time()
        self._wait()
        known = (each for each in self.connections if isinstance(each, BoundedProtocol))
        alive = [each for each in known if not each.transport.is_closing()]
        if len(alive) > MOST_CONNECTIONS:
            idle = (each for each in alive if not each._is_busy)
            min(idle, key=lambda each: each._opened).transport.close()

    def data_received(self, data: bytes) -> None:
        """Go on waiting until a request's head is whole."""
        super().data_received(data)
        if self._is_busy:
            self._stop_waiting()
        elif self._deadline is None:
            self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no longer."""
        self._stop_waiting()
        super().connection_lost(exc)

    @property
    def _is_busy(self) -> bool:
        """True from the end of a request's head to that of its answer."""
        return self.cycle is not None and not self.cycle.response_complete

    def _wait(self) -> None:
        self._deadline = self.loop.call_later(PATIENCE, self.transport.close)

    def _stop_waiting(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
