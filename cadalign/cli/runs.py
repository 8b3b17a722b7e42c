"""Runs of commands: experiments, and the fits or retrievals of many observations."""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.progress import MofNCompleteColumn, Progress

from cadalign.cli.common import exit_code, new_console, path_beside, print_json, print_table, say
from cadalign.cli.options import add_flags, flags_of
from cadalign.errors import DataError
from cadalign.io.observation import DetectorOptions

if TYPE_CHECKING:
    from collections.abc import Callable

    from cadalign.batch.runs import FitRunOptions
    from cadalign.cli.options import ManyCommand
    from cadalign.evaluation.registry import Spec
    from cadalign.evaluation.runs.engine import Progress as RunProgress
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Run

_MOST_REASONS, _MOST_OF_EVALUATIONS = 10, 3
_PICTURES = 100
"""Number of observations with pictures on the page, from the first."""
_MOST_ON_PAGE = 5000
"""Largest number of observations for which the page is written without `cadalign report`."""


def conclude(spec: Spec, run: Run, *, json: bool) -> int:
    """Write and print the summary of a finished run, and draw figures; returns the exit code.

    Raises DataError if the run has no row.
    """
    if not len(run.results):
        given = run.config.get("categories")
        what = "the run has no rows"
        what += f": no object has the categories {', '.join(given)}" if given else ""
        fix = "give other categories or data; also remove this folder or give another --out"
        raise DataError(what, where=str(run.folder.path), fix=fix)
    from cadalign.evaluation.runs.work import FAILED

    summaries = spec.write(run)
    statuses = run.results["status"].to_pylist()
    apart, failed = statuses.count(spec.apart), statuses.count(FAILED)
    rows = len(statuses) - apart
    if json:
        print_json(
            {
                "run": str(run.folder.path),
                "rows": rows,
                "failed": failed,
                spec.apart.replace(" ", "_"): apart,
                "summary": [summary.cells() for summary in summaries],
            }
        )
    else:
        print_table(spec.console_table(run, summaries))
        _say_reasons(_reasons(run.folder)[1], most=_MOST_OF_EVALUATIONS)
        note = f", {apart} more were {spec.apart}" if apart else ""
        say(f"Run: {run.folder.path} ({failed} of {rows} rows failed{note})")
    return exit_code(failed, rows)


def write_run_report(folder: RunFolder) -> None:
    """Write a run's page, and print its path."""
    from cadalign.report import write_report

    say(f"Report: {write_report([folder.path], folder.report)}")


@contextmanager
def run_progress(label: str) -> Iterator[Callable[[RunProgress], None]]:
    """Show a progress bar with the time left; yields the function that updates it."""
    if not sys.stderr.isatty():  # rich prints an empty line, before 14.3 even if disabled
        yield lambda state: None
        return
    columns = *Progress.get_default_columns(), MofNCompleteColumn()
    with Progress(*columns, console=new_console(), transient=True) as progress:
        bar = progress.add_task(label, total=None)
        yield lambda state: progress.update(bar, total=state.total, completed=state.done)


def inputs_of(command: Any) -> dict[str, Any]:
    """Return the fields of `FitRunOptions` that a command sets."""
    names = DetectorOptions.__dataclass_fields__
    return {
        "inputs": command.observations,
        "changes": command.changes,
        "detector": DetectorOptions(**{name: getattr(command, name) for name in names}),
        "pictures": _PICTURES if command.picture else 0,
    }


def run_command(command: ManyCommand, options: FitRunOptions, *, done: str) -> int:
    """Do the run of a command, and print the reasons of failures; returns the exit code.

    ``done`` says what was done to the other observations, such as "aligned".
    """
    import pyarrow.parquet as pq

    from cadalign.batch.outputs import WARNING_COLUMNS, warnings_text
    from cadalign.batch.runs import run_many

    folder = run_folder(command, options)
    with run_progress(options.experiment) as on_progress:
        workers, dask = command.workers, command.dask
        run_many(options, folder.path, workers=workers, dask=dask, on_progress=on_progress)
    if command.json:
        print_json(pq.read_table(folder.results).to_pylist())
    total, reasons = _reasons(folder)
    failed = sum(count for _, count in reasons)
    _say_reasons([(_typed_reason(reason, command), count) for reason, count in reasons])
    table = folder.path / "results.csv"
    if text := warnings_text(pq.read_table(folder.results, columns=list(WARNING_COLUMNS))):
        say(text)
    say(f"{total - failed:,} of {total:,} {done}, {failed:,} failed: {table}")
    if command.picture and total <= _MOST_ON_PAGE:
        write_run_report(folder)
    return exit_code(failed, total)


def _typed_reason(reason: str, command: ManyCommand) -> str:
    """The reason of a failure, with the options of the command line in its remedy."""
    what, mark, fix = reason.rpartition("; ")
    if fix.startswith("known are"):
        return reason
    return f"{what}{mark}{add_flags(fix, flags_of(command)) if mark else fix}"


def _reasons(folder: RunFolder) -> tuple[int, list[tuple[str, int]]]:
    """Count the rows of a run, and its failures by reason, the most frequent first."""
    from cadalign.evaluation.runs.tables import DONE_ANEW, read_groups
    from cadalign.evaluation.runs.work import FAILED

    counts: Counter[str] = Counter()
    whole: dict[str, str] = {}  # with the source, for reasons that occur once
    total = 0
    for table in read_groups(folder.results, fix=DONE_ANEW):
        total += len(table)
        names = [name for name in ("status", "source", "reason") if name in table.column_names]
        for row in table.select(names).to_pylist():
            if row["status"] == FAILED:
                reason = row["reason"].removeprefix(row.get("source", "")).lstrip(": ,.")
                counts[reason] += 1
                whole[reason] = row["reason"]
    return total, [
        (whole[each] if count == 1 else each, count) for each, count in counts.most_common()
    ]


def _say_reasons(reasons: Sequence[tuple[str, int]], *, most: int = _MOST_REASONS) -> None:
    """Print the most frequent reasons of failures with their counts."""
    for reason, count in reasons[:most]:
        say(f"failed {count:,}: {reason}")
    rest = reasons[most:]
    if rest:
        others = "another reason" if len(rest) == 1 else f"{len(rest):,} other reasons"
        say(f"failed {sum(count for _, count in rest):,}: {others}")


def run_folder(command: ManyCommand, options: FitRunOptions) -> RunFolder:
    """Return the run's folder, by default beside the first input."""
    from cadalign.evaluation.runs.folder import RunFolder

    kind, first = options.experiment, command.first
    if command.out is not None:
        return RunFolder(command.out)
    if len(command.observations) > 1 or not os.path.exists(first):
        return RunFolder(first.parent / kind)
    return RunFolder(path_beside(first, f"_{kind}"))
