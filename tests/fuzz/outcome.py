"""What the cases of some seeds showed."""

from __future__ import annotations

from typing import NamedTuple


class Failure(NamedTuple):
    """A description of what went wrong, and the seed."""

    what: str
    seed: int


class Outcome(NamedTuple):
    """What the cases of some seeds showed.

    Parameters
    ----------
    failures : list of Failure
    slowest : list of (float, str, int)
        The longest cases: seconds of processor time, kind, seed.
    memory : float
        The largest memory of the process so far [MB].
    """

    failures: list[Failure]
    slowest: list[tuple[float, str, int]]
    memory: float
