"""Fuzz for as long as you like: ``python -m fuzz fits 1000000``, ``python -m fuzz readers 20000``.

Every case follows from its seed, which a failure names: ``--first-seed`` goes on where an earlier
run ended, or repeats one case. Cases run in worker processes, since what a reader reads may kill
it.
"""

from __future__ import annotations

import argparse
import collections
import multiprocessing
import signal
import sys
import time
from collections.abc import Iterator

from fuzz import readers
from fuzz.failures import command_outcome, fit_outcome, reader_outcome
from fuzz.pool import Job, run_jobs

CHUNK = 500
MEMORY = 500.0  # MB of a worker process, libraries and compiled kernels included
_NAMED = 5
_EVERY = 60.0  # seconds from one line of progress to the next
_RUNS = {"fits": fit_outcome, "batches": fit_outcome, "commands": command_outcome}


def _jobs(what: str, only: str | None, first: int, count: int) -> Iterator[Job]:
    for start in range(first, first + count, CHUNK):
        stop = min(start + CHUNK, first + count)
        if what == "readers":
            kinds = readers.FORMATS if only is None else [only]
            yield from (Job(reader_outcome, kind, start, stop) for kind in kinds)
        else:
            yield Job(_RUNS[what], what, start, stop)


def main() -> int:
    """Run the cases of a range of seeds; returns 1 where one of them failed."""
    parser = argparse.ArgumentParser(prog="fuzz", description=__doc__)
    parser.add_argument("what", choices=(*_RUNS, "readers"))
    parser.add_argument("count", type=int, help="cases; for readers, mutations of each format")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--format", choices=readers.FORMATS, help="only this reader")
    parser.add_argument("--workers", type=int, default=multiprocessing.cpu_count())
    chosen = parser.parse_args()
    found: dict[str, list[int]] = collections.defaultdict(list)
    slowest: list[tuple[float, str, int]] = []
    cases, memory, begin, told = 0, 0.0, time.monotonic(), time.monotonic()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # a killed run says what it found
    jobs = _jobs(chosen.what, chosen.format, chosen.first_seed, chosen.count)
    try:
        for job, outcome in run_jobs(jobs, chosen.workers):
            cases += job.stop - job.start
            memory = max(memory, outcome.memory)
            slowest = sorted(slowest + outcome.slowest)[-_NAMED:]
            for what, seed in outcome.failures:
                if what not in found:
                    print(f"{what}, seed {seed}", flush=True)
                found[what].append(seed)
            if time.monotonic() > told + _EVERY:
                told = time.monotonic()
                failed = sum(map(len, found.values()))
                print(f"{cases} cases, to seed {job.stop}, {failed} failed", flush=True)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
    for what, seeds in sorted(found.items(), key=lambda item: -len(item[1])):
        print(f"{len(seeds):6d} {what}, seeds {sorted(seeds)[:_NAMED]}")
    print("slowest: " + ", ".join(f"{s:.2f} s {kind} {seed}" for s, kind, seed in slowest[::-1]))
    failed = sum(map(len, found.values()))
    seconds = time.monotonic() - begin
    print(
        f"{chosen.what}: {cases} cases, {failed} failed, {seconds:.0f} s, "
        f"at most {memory:.0f} MB in a worker"
    )
    return 1 if failed or memory > MEMORY else 0


if __name__ == "__main__":
    sys.exit(main())
