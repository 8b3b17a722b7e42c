"""Run ranges of seeds and collect what fails: what worker processes do."""

from __future__ import annotations

import faulthandler
import logging
import resource
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from fuzz import commands, fit_cases, fits, mutations, readers
from fuzz.pool import Failure, Outcome

LONGEST_FIT = 1.0  # seconds of processor time that one call of fit may take
BATCH = 4
LONGEST_SEARCH = 10.0  # the same, for a focal length to be estimated too
_STUCK = 120  # seconds after which a process that hangs in compiled code ends itself
_SLOWEST = 3


def fit_outcome(kind: str, start: int, stop: int) -> Outcome:
    """Fit the cases of some seeds, ``"fits"``, or a batch of cases for each, ``"batches"``."""

    def one(seed: int) -> tuple[str, float]:
        if kind == "batches":
            begin = time.process_time()
            fits.run_batch(fit_cases.draw_cases(seed, BATCH))
            return kind, (time.process_time() - begin) / (2 * BATCH)
        case = fit_cases.draw_case(seed)
        seconds = fits.run_case(case)
        if seconds > LONGEST_FIT:  # the first call with arguments of some type compiles
            seconds = fits.run_case(fit_cases.draw_case(seed))
        focal = case.options.get("focal")
        searches = isinstance(focal, str) and focal == "estimate"
        longest = LONGEST_SEARCH if searches else LONGEST_FIT
        assert seconds < longest, f"took more than {longest} s"
        return case.kind, seconds

    return _outcome(one, kind, start, stop)


def reader_outcome(kind: str, start: int, stop: int) -> Outcome:
    """Read the mutations of some seeds of one format."""
    with tempfile.TemporaryDirectory() as folder:
        files = mutations.MutatedFiles(readers.FORMATS[kind], Path(folder))

        def one(seed: int) -> tuple[str, float]:
            begin = time.process_time()
            files.run(seed)
            return kind, time.process_time() - begin

        return _outcome(one, kind, start, stop)


def command_outcome(kind: str, start: int, stop: int) -> Outcome:
    """Run the commands of some seeds."""
    with tempfile.TemporaryDirectory() as folder:

        def one(seed: int) -> tuple[str, float]:
            begin = time.process_time()
            commands.run_command(seed, Path(folder) / "data")
            words = commands.draw_command(seed, Path("data"))
            return " ".join(word[:30] for word in words[:1]), time.process_time() - begin

        return _outcome(one, kind, start, stop)


def _outcome(one: Callable[[int], tuple[str, float]], kind: str, start: int, stop: int) -> Outcome:
    failures, times = [], []
    with _unlogged():
        for seed in range(start, stop):
            faulthandler.dump_traceback_later(_STUCK, exit=True)
            try:
                what, seconds = one(seed)
                times.append((seconds, what, seed))
            except Exception as error:
                failures.append(Failure(f"{kind}: {describe(error)}", seed))
        faulthandler.cancel_dump_traceback_later()
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return Outcome(failures, sorted(times)[-_SLOWEST:], memory)


@contextmanager
def _unlogged() -> Iterator[None]:
    """Keep the warnings that are logged of damaged files from the terminal."""
    logger, nowhere = logging.getLogger("cadalign"), logging.NullHandler()
    logger.addHandler(nowhere)
    propagated, logger.propagate = logger.propagate, False
    try:
        yield
    finally:
        logger.removeHandler(nowhere)
        logger.propagate = propagated


def describe(error: Exception) -> str:
    """The error's type, its message's beginning, and where it was raised."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    name = "/".join(Path(place.filename).parts[-2:])
    return f"{type(error).__name__}: {' '.join(str(error).split())[:100]} ({name}:{place.lineno})"
