"""Fuzz for as long as you like: ``python -m fuzz fits 1000000``, ``python -m fuzz readers 20000``.

Every case follows from its seed, which a failure names. Cases run in worker processes, since what a
reader reads may kill it.
"""

from __future__ import annotations

import argparse
import collections
import multiprocessing
import resource
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from fuzz import readers
from fuzz.failures import Failure, command_failures, fit_failures, reader_failures

CHUNK = 200

Job = tuple[Callable[..., list[Failure]], tuple[Any, ...]]


def _jobs(
    what: str, first: int, count: int
) -> Iterator[tuple[Callable[..., list[Failure]], tuple]]:  # type: ignore[type-arg]
    for start in range(first, first + count, CHUNK):
        seeds = (start, min(start + CHUNK, first + count))
        if what == "fits":
            yield fit_failures, seeds
        elif what == "commands":
            yield command_failures, seeds
        else:
            yield from ((reader_failures, (name, *seeds)) for name in readers.FORMATS)


def main() -> int:
    """Run the cases of a range of seeds; returns 1 where one of them failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("fits", "readers", "commands"))
    parser.add_argument("count", type=int, help="cases; for readers, mutations of each format")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=multiprocessing.cpu_count())
    chosen = parser.parse_args()
    found: dict[str, list[int]] = collections.defaultdict(list)
    context = multiprocessing.get_context("spawn")
    begin = time.monotonic()
    with ProcessPoolExecutor(chosen.workers, mp_context=context) as pool:
        jobs = list(_jobs(chosen.what, chosen.first_seed, chosen.count))
        running = [pool.submit(job, *arguments) for job, arguments in jobs]
        for future, (_, arguments) in zip(running, jobs, strict=True):
            try:
                for text, seed in future.result():
                    found[text].append(seed)
            except BrokenProcessPool:
                print(f"a worker was killed, at or after the seeds {arguments}", file=sys.stderr)
                return 1
    for text, seeds in sorted(found.items(), key=lambda item: -len(item[1])):
        print(f"{len(seeds):6d} {text}, seeds {seeds[:4]}")
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    failed = sum(map(len, found.values()))
    print(
        f"{chosen.what}: {len(jobs)} x {CHUNK} cases at most, {failed} failed, "
        f"{time.monotonic() - begin:.0f} s, at most {peak:.0f} MB in a worker"
    )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
