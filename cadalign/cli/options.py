"""Common parts of commands: options of the library's functions, consoles, output folders."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from cadalign.errors import CadalignError, DataError, InputError
from cadalign.io.files import printable
from cadalign.io.input_kinds import DetectorOptions

if TYPE_CHECKING:
    from _typeshed import DataclassInstance
    from rich.console import Console


_PIPE_WIDTH = 120


class OptionError(CadalignError):
    """A command line option has an invalid value.

    Other than InputError it is no ValueError, which the parser would report without the name.
    """


class UsageError(CadalignError):
    """The command line lacks an argument, or has one too many; it exits with 2."""


@contextmanager
def named_as_flags(
    *options: DataclassInstance,
    kind: type[CadalignError] = InputError,
    others: Mapping[str, str] | None = None,
) -> Iterator[None]:
    """Let errors about fields of dataclasses of options name the command line's options.

    ``others`` are flags of further arguments by name. Their kind is `OptionError` while the
    command line is parsed.
    """
    flags = {field.name: flag_of(field.name) for each in options for field in fields(each)}
    flags |= others or {}
    try:
        yield
    except DataError as error:
        raise DataError(error.what, where=error.where, fix=_with_flags(error.fix, flags)) from None
    except InputError as error:
        if error.where not in flags:
            raise
        where = flags[str(error.where)]
        raise kind(error.what, where=where, fix=_with_flags(error.fix, flags)) from None


def _with_flags(fix: str | None, flags: Mapping[str, str]) -> str | None:
    """A remedy that names flags in the place of arguments of several words."""
    for name, flag in flags.items():
        if fix is not None and "_" in name:
            fix = re.sub(rf"(?<![\w-]){name}(?!\w)", flag, fix)
    return fix


def flag_of(name: str) -> str:
    """The command line's option for a field.

    Examples
    --------
    >>> flag_of("known_axis")
    '--known-axis'
    """
    return "--" + name.replace("_", "-")


@dataclass(frozen=True, kw_only=True)
class JsonOption:
    """The option of the commands that print a table or JSON."""

    json: bool = False
    """Print the result as JSON."""


@dataclass(frozen=True, kw_only=True)
class ObservationCommand(JsonOption):
    """Options of the commands on an observation file."""

    out: Path | None = None
    """Folder to write to; by default, fit writes to <observation>_fit beside the file."""
    sigma: float | None = None
    """Standard deviation of the keypoints [px]; by default the file's, or 1."""


@dataclass(frozen=True, kw_only=True)
class ManyCommand(ObservationCommand, DetectorOptions):
    """Options of the commands on one observation, or on many."""

    observations: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="OBSERVATION ...", help_behavior_hint="(required)"),
    ]
    """A JSON file with camera and keypoints, optionally image, model and further evidence. Or many:
    several such files, folders, patterns in quotes, JSON lines (.jsonl), or a detector's file of
    keypoints (COCO's JSON, or CSV) with --camera and --model or --shape."""
    picture: bool = True
    """Draw box and keypoints over the photo, as overlay.png; of many observations, write a page."""
    workers: int | None = None
    """Processes for many observations; -1 for one for each core, 0 for none. By default -1, for few
    observations 0."""
    dask: str | None = None
    """Address of a Dask scheduler, whose workers are used instead."""
    pictures: int = 100
    """Of many observations, the number of those whose photos the page shows, the first ones."""

    def first(self) -> Path:
        """The first observation; raises UsageError if none is given."""
        if not self.observations:
            fix = "give a JSON file with camera and keypoints, or a folder of such files"
            raise UsageError("no observation is given", where="OBSERVATION", fix=fix)
        return self.observations[0]


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
