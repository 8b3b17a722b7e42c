"""Consoles and output folders of the commands."""

from __future__ import annotations

import sys
from pathlib import Path

from rich.console import Console

from cadalign.errors import DataError
from cadalign.io.files import printable

_PIPE_WIDTH = 120


def new_console(*, stderr: bool = True) -> Console:
    """Make a console: messages go to standard error, results to standard output.

    Output to a file or a pipe has lines of a fixed width that is enough for tables.
    """
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
