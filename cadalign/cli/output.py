"""Consoles and output folders of the commands."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from cadalign.errors import DataError
from cadalign.io.files import printable

if TYPE_CHECKING:
    from rich.console import Console

_PIPE_WIDTH = 120


def say(text: str) -> None:
    """Write a message to standard error."""
    sys.stderr.write(f"{text}\n")


@contextmanager
def waiting(text: str) -> Iterator[None]:
    """Show on a terminal what is waited for, and that it goes on; elsewhere show nothing."""
    with new_console().status(text) if sys.stderr.isatty() else nullcontext():
        yield


def new_console(*, stderr: bool = True) -> Console:
    """Make a console: messages go to standard error, results to standard output.

    Output to a file or a pipe has lines of a fixed width that is enough for tables.
    """
    from rich.console import Console  # only here: a fit is over before it is imported

    stream = sys.stderr if stderr else sys.stdout
    width = None if stream.isatty() else _PIPE_WIDTH
    return Console(stderr=stderr, highlight=False, soft_wrap=True, width=width)


def make_folder(path: Path) -> None:
    """Create an output folder; raises DataError on failure."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise DataError(
            f"the folder cannot be created ({getattr(error, 'strerror', None) or error})",
            where=printable(path),
            fix="choose another --out",
        ) from None
