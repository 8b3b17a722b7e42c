"""The pool of processes that may be killed. Its processes import this module: it loads quickly."""

from __future__ import annotations

import os
import signal

from fuzz.pool import Job, Outcome, run_jobs


def end_at_seed_5(kind: str, start: int, stop: int) -> Outcome:
    if start <= 5 < stop:
        os.kill(os.getpid(), signal.SIGKILL)
    return Outcome([], [], 0.0)


def test_seed_that_kills_its_process_is_found() -> None:
    jobs = [Job(end_at_seed_5, "fits", start, start + 2) for start in (0, 2, 4, 6, 8)]
    outcomes = list(run_jobs(jobs, workers=2))
    assert sorted((job.start, job.stop) for job, _ in outcomes) == [
        (0, 2), (2, 4), (4, 5), (5, 6), (6, 8), (8, 10),
    ]  # fmt: skip
    failures = [failure for _, outcome in outcomes for failure in outcome.failures]
    assert failures == [("fits: killed or ran out of time", 5)]
