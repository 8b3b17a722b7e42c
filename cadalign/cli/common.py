"""Common parts of commands: output, exit codes, output folders, groups of commands."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, make_dataclass
from functools import reduce
from operator import or_
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import tyro

from cadalign.errors import CadalignError
from cadalign.io.files import create_folder, finite, refuse_folder

if TYPE_CHECKING:
    from rich.console import Console

    from cadalign.evaluation.summary import ConsoleTable

SUCCESS: Final = 0
NOTHING_WORKED: Final = 1
"""Also the exit code of a refused input."""
SOME_FAILED: Final = 3
"""The run is complete, but some rows have the status ``failed``."""
_PIPE_WIDTH = 120


class UsageError(CadalignError):
    """A missing or superfluous argument on the command line; exits with 2."""


@dataclass(frozen=True, kw_only=True)
class JsonOption:
    """Option of commands that print a table or JSON."""

    json: bool = False
    """Print the result as JSON."""


def group_of(about: str, commands: dict[str, Any] | Callable[[], dict[str, Any]]) -> Any:
    """Make a command of several subcommands; ``about`` is its help.

    A function for ``commands`` is called when the command is.
    """

    def choice() -> Any:
        found = commands() if callable(commands) else commands
        return reduce(
            or_, [Annotated[each, tyro.conf.subcommand(name)] for name, each in found.items()]
        )

    def run(group: Any) -> int:
        code: int = group.what.run()
        return code

    what = Annotated[Any, tyro.conf.arg(name="", constructor_factory=choice)]
    namespace = {"run": run, "__doc__": about}
    return make_dataclass("Group", [("what", what)], namespace=namespace, frozen=True)


def exit_code(failed: int, total: int) -> int:
    """Return the exit code of a run of which ``failed`` of ``total`` rows failed."""
    if failed == total:
        return NOTHING_WORKED
    return SOME_FAILED if failed else SUCCESS


def say(text: str) -> None:
    """Write a message to standard error."""
    sys.stderr.write(f"{text}\n")


def answer(text: str) -> None:
    """Write a result to standard output."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()  # the reader of a pipe gets it at once


def print_json(value: Any) -> None:
    """Print a value as JSON on standard output; non-finite numbers become null."""
    answer(json.dumps(finite(value), indent=2))


@contextmanager
def show_status(text: str) -> Iterator[Callable[[str], object]]:
    """Show a text with a spinner on a terminal; elsewhere show nothing.

    Yields a function that changes the text.
    """
    if not sys.stderr.isatty():
        yield str
        return
    with new_console().status(text) as status:
        yield status.update


def new_console(*, stderr: bool = True) -> Console:
    """Make a console on standard error, for messages, or standard output, for results.

    Lines to a file or a pipe have a fixed width that is enough for tables.
    """
    from rich.console import Console  # not at the top: the import takes longer than a fit

    stream = sys.stderr if stderr else sys.stdout
    width = None if stream.isatty() else _PIPE_WIDTH
    return Console(stderr=stderr, highlight=False, soft_wrap=True, width=width)


def print_table(table: ConsoleTable) -> None:
    """Print a table on standard output."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    shown = Table(title=table.title, box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for name in table.labels:
        shown.add_column(escape(name), no_wrap=True)
    for name in table.heads:
        shown.add_column(escape(name), justify="right", no_wrap=False)
    previous = None
    for first, *rest in table.rows:
        if table.grouped and previous not in (None, first):
            shown.add_section()
        label = "" if table.grouped and first == previous else first
        shown.add_row(*map(escape, (label, *rest)))
        previous = first
    console = new_console(stderr=False)
    console.print(shown)
    if table.note:
        console.print(table.note)


def create_parent(file: Path) -> None:
    """Create the folder of an output file; raises DataError on failure, or for a folder."""
    refuse_folder(file)
    create_folder(file.absolute().parent)


def path_beside(given: Path, ending: str) -> Path:
    """Return the path beside an input that has its name and an ending; resolves `.` and `..`."""
    if given.is_dir():
        given = given.resolve()
        return given.with_name(given.name + ending)
    return given.with_name(given.stem + ending)
