"""Worker processes that may be killed by what they run: that seed is found, the rest goes on."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from itertools import chain
from typing import NamedTuple


class Failure(NamedTuple):
    """A description of what went wrong, and the seed."""

    what: str
    seed: int


class Outcome(NamedTuple):
    """What the cases of some seeds showed."""

    failures: list[Failure]
    slowest: list[tuple[float, str, int]]  # seconds of processor time, kind, seed
    memory: float  # the largest of the process so far [MB]


@dataclass(frozen=True)
class Job:
    """The cases of the seeds ``start`` to ``stop``, that one left out, of one kind."""

    run: Callable[[str, int, int], Outcome]
    kind: str
    start: int
    stop: int

    def outcomes(self) -> list[tuple[Job, Outcome]]:
        """Run in a process of its own; where that is killed its halves, down to the seed."""
        context = multiprocessing.get_context("spawn")
        try:
            with ProcessPoolExecutor(1, mp_context=context) as pool:
                return [(self, pool.submit(self.run, self.kind, self.start, self.stop).result())]
        except BrokenProcessPool:
            if self.stop - self.start == 1:
                failure = Failure(f"{self.kind}: killed or ran out of time", self.start)
                return [(self, Outcome([failure], [], 0.0))]
        middle = (self.start + self.stop) // 2
        return replace(self, stop=middle).outcomes() + replace(self, start=middle).outcomes()


def run_jobs(jobs: Iterable[Job], workers: int) -> Iterator[tuple[Job, Outcome]]:
    """Run jobs in some processes; yields each, or its parts, with what it found."""
    threads = ThreadPoolExecutor(workers)
    try:
        yield from chain.from_iterable(threads.map(Job.outcomes, jobs))
    finally:
        threads.shutdown(cancel_futures=True)
