"""Commands that do runs: their options, progress, exit codes, and the summary at the end."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final

import tyro
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

from cadalign.cli.output import new_console
from cadalign.errors import InputError
from cadalign.evaluation.options import ExperimentOptions, RunOptions

if TYPE_CHECKING:
    from collections.abc import Callable

    from cadalign.evaluation.runs.opened import Run
    from cadalign.evaluation.runs.run import Progress as RunProgress
    from cadalign.evaluation.spec import Spec
    from cadalign.evaluation.summary import ConsoleTable


SUCCESS: Final = 0
NOTHING_WORKED: Final = 1
"""Also what a refused input gives."""
SOME_FAILED: Final = 3
"""The run is finished and its tables are written, but some rows say ``failed``."""


@dataclass(frozen=True, kw_only=True)
class RunCommand(RunOptions):
    """What the commands of experiments share; see `command_of`."""

    options_type: ClassVar[type[ExperimentOptions]]

    json: bool = False
    """Print the summary as JSON."""

    def __post_init__(self) -> None:
        """Check nothing: options check themselves once the command runs, and refuse in one line."""

    def run(self) -> int:
        """Do the run and say what came out; returns the exit code."""
        from cadalign.cli.report import write_run_report

        spec, run = self.do_run()
        code = conclude(spec, run, json=self.json)
        write_run_report(run.folder)
        return code

    def do_run(self) -> tuple[Spec, Run]:
        """Do the run, showing its progress; gives its specification and its tables.

        Raises
        ------
        InputError
            Which names options as flags, the way in which they were typed.
        """
        from cadalign.evaluation.registry import spec_named
        from cadalign.evaluation.runs.folder import RunFolder
        from cadalign.evaluation.runs.opened import Run
        from cadalign.evaluation.runs.run import execute, workers_of

        kind = self.options_type
        spec = spec_named(kind.experiment)
        try:
            options = kind(**{field.name: getattr(self, field.name) for field in fields(kind)})
            count = options.default_workers if self.workers is None else self.workers
            workers = workers_of(count, dask=self.dask)
            out = self.out or Path("runs") / options.run_name
            plan = spec.plan(options, RunFolder(out))
        except InputError as error:
            if error.where not in {field.name for field in fields(self)}:
                raise
            flag = f"--{error.where.replace('_', '-')}"
            raise InputError(error.what, where=flag, fix=error.fix) from None
        with run_progress(f"{kind.command.removesuffix('e')}ing") as on_progress:
            execute(plan, RunFolder(out), workers=workers, on_progress=on_progress)
        return spec, Run.open(out)


def command_of(
    options: type[ExperimentOptions],
    base: type[RunCommand] = RunCommand,
    *,
    about: str | None = None,
    **defaults: Any,
) -> Any:
    """The command of an experiment: its options, and those of every run.

    Parameters
    ----------
    options : type
        The experiment's options.
    base : type
        The command's own options, and what it does.
    about : str, optional
        Its help; by default that of the options.
    **defaults
        Options that it gives and that cannot be typed.
    """
    given = [
        (name, Annotated[str, tyro.conf.Suppress], field(default=value))
        for name, value in defaults.items()
    ]
    namespace = {"options_type": options, "__doc__": about or options.__doc__}
    return make_dataclass(
        options.__name__, given, bases=(base, options), namespace=namespace, frozen=True
    )


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
                "summary": [asdict(summary) for summary in summaries],
            }
        )
    else:
        print_table(spec.console_table(run, summaries))
        note = f", {found.note}" if found.note else ""
        text = f"Run: {run.folder.path} ({found.failed} of {found.rows} rows failed{note})"
        new_console().print(text, markup=False)
    return exit_code(found.rows, found.failed)


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
    """Tasks a second, since the run was started this time."""

    def render(self, task: Task) -> Text:
        rate = task.fields.get("rate", 0.0)
        return Text(f"{rate:,.0f}/s" if rate >= 10 else f"{rate:.1f}/s")


@contextmanager
def run_progress(label: str, *, quiet: bool = False) -> Iterator[Callable[[RunProgress], None]]:
    """Show a progress bar with rate and time left; gives what a run is to tell its progress to."""
    import time

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
        disable=quiet,
    ) as progress:
        bar = progress.add_task(label, total=None)
        first: list[tuple[float, int]] = []

        def show(state: RunProgress) -> None:
            now = time.monotonic()
            if not first:
                first.append((now, state.done))
            start, done_before = first[0]
            rate = (state.done - done_before) / max(now - start, 1e-9)
            progress.update(bar, total=state.total, completed=state.done, rate=rate)

        yield show


def exit_code(rows: int, failed: int) -> int:
    """The exit code of a finished run."""
    if failed == rows:
        return NOTHING_WORKED
    return SOME_FAILED if failed else SUCCESS


def print_json(value: Any) -> None:
    """Print a value as JSON on standard output; NaN becomes null."""
    sys.stdout.write(json.dumps(_plain(value), indent=2) + "\n")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and value != value else value
