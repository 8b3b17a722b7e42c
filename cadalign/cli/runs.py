"""Progress of runs, exit codes, and the summary at the end."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from cadalign.cli.options import new_console

if TYPE_CHECKING:
    from collections.abc import Callable

    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.opened import Run
    from cadalign.evaluation.runs.run import Progress as RunProgress
    from cadalign.evaluation.spec import Spec
    from cadalign.evaluation.summary import ConsoleTable


SUCCESS: Final = 0
NOTHING_WORKED: Final = 1
"""Also what a refused input gives."""
SOME_FAILED: Final = 3
"""The run is finished and its tables are written, but some rows say ``failed``."""


def conclude(spec: Spec, run: Run, *, json: bool) -> int:
    """Write a finished run's summary and figures, and say what came out; returns the exit code."""
    summaries = spec.write(run)
    found = spec.conclude(run, summaries)
    if json:
        print_json(
            {
                "run": str(run.folder.path),
                "rows": found.rows,
                "failed": found.failed,
                **found.counts,
                "summary": [summary.to_dict() for summary in summaries],
            }
        )
    else:
        print_table(spec.console_table(run, summaries))
        note = f", {found.note}" if found.note else ""
        text = f"Run: {run.folder.path} ({found.failed} of {found.rows} rows failed{note})"
        new_console().print(text, markup=False)
    if found.failed == found.rows:
        return NOTHING_WORKED
    return SOME_FAILED if found.failed else SUCCESS


def write_run_report(folder: RunFolder) -> None:
    """Write a run's page at its end, and say where it is."""
    from cadalign.report import write_report

    report = write_report([folder.path], folder.report)
    new_console().print(f"Report: {report.path}", markup=False)


def print_table(table: ConsoleTable) -> None:
    """Print a table on standard output."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    style: dict[str, Any] = {}
    if table.narrow:
        style = {"box": box.SIMPLE_HEAD, "show_edge": False, "padding": (0, 1, 0, 0)}
    shown = Table(title=table.title, **style)
    for name in table.labels:
        shown.add_column(escape(name), no_wrap=True)
    for name in table.heads:
        shown.add_column(escape(name), justify="right", no_wrap=not table.wraps)
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


class _Rate(ProgressColumn):
    """Tasks a second, lately."""

    def render(self, task: Task) -> Text:
        rate = task.speed or 0.0
        return Text(f"{rate:,.0f}/s" if rate >= 10 else f"{rate:.1f}/s")


@contextmanager
def run_progress(label: str) -> Iterator[Callable[[RunProgress], None]]:
    """Show a progress bar with rate and time left; gives what a run is to tell its progress to."""
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=new_console(),
        transient=True,
        disable=not sys.stderr.isatty(),  # else it ends in an empty line
    ) as progress:
        bar = progress.add_task(label, total=None)
        yield lambda state: progress.update(bar, total=state.total, completed=state.done)


def print_json(value: Any) -> None:
    """Print a value as JSON on standard output; NaN becomes null."""
    sys.stdout.write(json.dumps(_plain(value), indent=2) + "\n")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and value != value else value
