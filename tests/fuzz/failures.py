"""Failures of ranges of seeds: what worker processes do."""

from __future__ import annotations

import logging
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from fuzz import commands, fits, readers

SLOW = 1.0  # seconds of processor time that one fit may take

Failure = tuple[str, int]
"""A description of what went wrong, and the seed."""


def fit_failures(start: int, stop: int) -> list[Failure]:
    """The failures of the fits of some seeds."""

    def one(seed: int) -> str:
        case = fits.draw_case(seed)
        begin = time.process_time()
        try:
            fits.run_case(case)
        except Exception as error:
            return f"{case.kind}: {_describe(error)}"
        is_slow = time.process_time() - begin > SLOW and seed > start  # the first one compiles
        return f"{case.kind}: slow" if is_slow else ""

    return _failures(one, start, stop)


def reader_failures(name: str, start: int, stop: int) -> list[Failure]:
    """The failures of one format's reader on the mutations of some seeds."""
    with tempfile.TemporaryDirectory() as folder:

        def one(seed: int) -> str:
            try:
                readers.run_mutation(readers.FORMATS[name], seed, Path(folder) / "data")
            except Exception as error:
                return f"{name}: {_describe(error)}"
            return ""

        return _failures(one, start, stop)


def command_failures(start: int, stop: int) -> list[Failure]:
    """The failures of the command line on the arguments of some seeds."""
    with tempfile.TemporaryDirectory() as folder:

        def one(seed: int) -> str:
            try:
                commands.run_command(seed, Path(folder) / "data")
            except Exception as error:
                return f"{' '.join(commands.draw_command(seed, Path('data')))}: {_describe(error)}"
            return ""

        return _failures(one, start, stop)


def _failures(one: Callable[[int], str], start: int, stop: int) -> list[Failure]:
    logging.disable(logging.WARNING)
    return [(text, seed) for seed in range(start, stop) if (text := one(seed))]


def _describe(error: Exception) -> str:
    place = traceback.extract_tb(error.__traceback__)[-1]
    return (
        f"{type(error).__name__}: {str(error)[:100]} ({Path(place.filename).name}:{place.lineno})"
    )
