"""Times that do not depend on the machine: ratios to a yardstick measured in turns with them.

A wall-clock limit says as much about the machine and its other users as about the code. Here a
duration is divided by that of some other work measured in between, of which the machine does the
one as slowly as the other; and while the quotient is too large, perhaps because the machine was
busy with other things, both are measured again. Code that has become slower stays slower.
"""

from __future__ import annotations

import gc
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Measure = Callable[[], float]
"""Does some work and returns how long it took [s]."""

_PATIENCE = 120.0  # seconds for which a machine that is busy with other things is waited for


@dataclass(frozen=True)
class Yardstick:
    """Some fixed work: how to measure it here, and its duration [s] where limits are stated for."""

    measure: Measure
    seconds: float


def ratio(ours: Measure, theirs: Measure, *, below: float, rounds: int = 3) -> float:
    """The duration of ours over that of theirs, both measured in turns.

    The median of a few rounds each; while that is not below its limit, they are measured anew, for
    a while, and the fastest of all rounds decide as well: other programs only ever add to what work
    takes.
    """
    end = time.monotonic() + _PATIENCE
    own, other = _measured_in_turns(ours, theirs, rounds)
    found = statistics.median(own) / statistics.median(other)
    while found >= below and time.monotonic() < end:
        time.sleep(0.2)
        more_own, more_other = _measured_in_turns(ours, theirs, rounds)
        own, other = own + more_own, other + more_other
        medians = statistics.median(more_own) / statistics.median(more_other)
        found = min(found, medians, min(own) / min(other))
    return found


def _measured_in_turns(
    ours: Measure, theirs: Measure, rounds: int
) -> tuple[list[float], list[float]]:
    pairs = [(ours(), theirs()) for _ in range(rounds)]
    return [own for own, _ in pairs], [other for _, other in pairs]


def timed(work: Callable[[], object], *, calls: int = 1) -> Measure:
    """Measure the median duration of some calls, without garbage collection.

    Of wall time and processor time the lesser: other programs lengthen the one, helper threads
    the other.
    """

    def measure() -> float:
        seconds = []
        gc.disable()  # the rest of the test suite's garbage is not the work's
        try:
            for _ in range(calls):
                wall, own = time.perf_counter(), time.process_time()
                work()
                seconds.append(min(time.perf_counter() - wall, time.process_time() - own))
        finally:
            gc.enable()
        return statistics.median(seconds)

    return measure


def timed_process(code: str) -> Measure:
    """Measure how long code takes in a new process, once that has started.

    The process keeps byte code, as every installation does: where the environment forbids it, each
    start would compile the package's modules, but not those of the yardstick's installed packages.
    """
    timing = (
        "import time; wall, own = time.perf_counter(), time.process_time(); "
        f"{code}; print(min(time.perf_counter() - wall, time.process_time() - own))"
    )

    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": ""}

    def measure() -> float:
        done = subprocess.run(
            [sys.executable, "-c", timing],
            env=environment,
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return float(done.stdout)

    return measure


def _usual_work() -> object:
    """Work of the kinds that the package's consists of: objects, text, arrays small and large."""
    values = {str(i): [i, i / 7, {"name": f"part {i}"}] for i in range(3000)}
    text = json.dumps(values)
    words = sorted(text.replace(",", " ").split(), key=len)
    rows = np.arange(300_000.0).reshape(-1, 3)
    for row in rows[:1000]:
        row @ row
    return json.loads(text), words, np.linalg.norm(rows @ rows[:3].T, axis=1).argsort()


USUAL = Yardstick(timed(_usual_work), 0.05)


def reference_seconds(
    measure: Measure, *, below: float, by: Yardstick = USUAL, rounds: int = 3
) -> float:
    """The duration [s] on the machine that limits are stated for, judging by the yardstick here."""
    limit = below / by.seconds
    return by.seconds * ratio(measure, by.measure, below=limit, rounds=rounds)
