"""One writer per photo among the browsers of a server."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection

from cadalign.errors import InputError

LEASE = 60.0
"""How long a photo stays with the browser that changed it last [s]."""


class Claims:
    """Claims of browsers on the photos that they change.

    Parameters
    ----------
    clock : callable
        Seconds since any moment.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._holders: dict[int, tuple[str, float]] = {}

    def take(self, photo: int, browser: str) -> None:
        """Claim a photo for a browser, or renew its claim.

        Raises
        ------
        InputError
            If another browser has changed it within the last `LEASE` seconds.
        """
        self.take_all((photo,), browser)

    def take_all(self, photos: Collection[int], browser: str) -> None:
        """Claim photos for a browser, all or none, or renew its claims.

        Raises
        ------
        InputError
            If another browser has changed one of them within the last `LEASE` seconds.
        """
        now = self._clock()
        for photo in photos:
            self._check(photo, browser, now)
        for photo in photos:
            self._holders[photo] = (browser, now)

    def _check(self, photo: int, browser: str, now: float) -> None:
        holder, since = self._holders.get(photo, (browser, now))
        left = since + LEASE - now
        if holder != browser and left > 0:
            raise InputError(
                "someone else is annotating this photo, so that your change is not made",
                where="photo",
                fix=f"take another one, or try again {left:.0f} s after their last change",
            )
