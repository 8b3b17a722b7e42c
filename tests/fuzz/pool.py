"""Worker processes that may be killed by what they run: that seed is found, the rest goes on."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace

from fuzz.outcome import Failure, Outcome


@dataclass(frozen=True)
class Job:
    """The cases of the seeds ``start`` to ``stop``, that one left out, of one kind."""

    run: Callable[[str, int, int], Outcome]
    kind: str
    start: int
    stop: int

    def halves(self) -> list[Job]:
        """Two jobs of half the seeds each."""
        middle = (self.start + self.stop) // 2
        return [replace(self, stop=middle), replace(self, start=middle)]


def run_jobs(jobs: Iterable[Job], workers: int) -> Iterator[tuple[Job, Outcome]]:
    """Run jobs in some processes; yields each with what it found, as it ends."""
    waiting = iter(jobs)
    while True:
        suspects = yield from _run_until_killed(waiting, workers)
        if not suspects:
            return
        for job in suspects:
            yield from _run_alone(job)


def _run_until_killed(
    jobs: Iterator[Job], workers: int
) -> Iterator[tuple[Job, Outcome]]:  # and returns the jobs that ran when a process was killed
    running: dict[Future[Outcome], Job] = {}
    with _pool(workers) as pool:
        try:
            while True:
                for job in jobs:
                    running[pool.submit(job.run, job.kind, job.start, job.stop)] = job
                    if len(running) > workers:
                        break
                if not running:
                    return []
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    outcome = future.result()
                    yield running.pop(future), outcome
        except BrokenProcessPool:
            return list(running.values())


def _run_alone(job: Job) -> Iterator[tuple[Job, Outcome]]:
    """Run a job, and where it kills its process its halves, down to the seed that does."""
    try:
        with _pool(1) as pool:
            yield job, pool.submit(job.run, job.kind, job.start, job.stop).result()
    except BrokenProcessPool:
        if job.stop - job.start == 1:
            failure = Failure(f"{job.kind}: killed or ran out of time", job.start)
            yield job, Outcome([failure], [], 0.0)
        else:
            for half in job.halves():
                yield from _run_alone(half)


def _pool(workers: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
