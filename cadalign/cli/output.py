"""Consoles, progress bars and output folders of the commands."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

from cadalign.errors import DataError

T = TypeVar("T")
_PIPE_WIDTH = 120


def new_console(*, stderr: bool = True) -> Console:
    """Make a console: messages go to standard error, results to standard output.

    Output to a file or a pipe has lines of a fixed width that is enough for tables.
    """
    stream = sys.stderr if stderr else sys.stdout
    width = None if stream.isatty() else _PIPE_WIDTH
    return Console(stderr=stderr, highlight=False, soft_wrap=True, width=width)


def progress_over(items: Iterable[T], *, total: int, label: str, console: Console) -> Iterator[T]:
    """Yield the items and show a progress bar."""
    with Progress(
        TextColumn(label),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
        transient=True,
    ) as progress:
        task = progress.add_task(label, total=total)
        for item in items:
            progress.advance(task)
            yield item


def make_folder(path: Path) -> None:
    """Create an output folder; raises DataError on failure."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(
            f"the folder cannot be created ({error.strerror})",
            where=str(path),
            fix="choose another --out",
        ) from None
