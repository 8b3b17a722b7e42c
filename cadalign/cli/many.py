"""Commands of many observations: a run, its table, and its page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from cadalign.batch.fits import Tally, run_many
from cadalign.batch.table import read_rows
from cadalign.cli.options import ManyCommand, new_console
from cadalign.cli.runs import NOTHING_WORKED, SOME_FAILED, SUCCESS, print_json, run_progress
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.io.input_kinds import DetectorOptions

if TYPE_CHECKING:
    from cadalign.batch.options import ManyOptions
    from cadalign.io.observation import ObservationChanges
    from cadalign.render import OverlayStyle

_MOST_REASONS = 10
_ON_PAGE = 5000
"""Observations beyond which the page is left to `cadalign report`."""


def inputs_of(command: ManyCommand, changes: ObservationChanges) -> dict[str, Any]:
    """The fields of `ManyOptions` that a command states."""
    names = DetectorOptions.__dataclass_fields__
    return {
        "inputs": command.observations,
        "changes": changes,
        "detector": DetectorOptions(**{name: getattr(command, name) for name in names}),
        "pictures": command.pictures if command.picture else 0,
    }


def run_command(command: ManyCommand, options: ManyOptions, *, done: str) -> int:
    """Do the run of a command; returns the exit code, 3 where some observations have failed.

    ``done`` is what was done to those that have not.
    """
    folder = run_folder(command, options)
    with run_progress(options.experiment) as on_progress:
        tally = run_many(
            options,
            folder,
            workers=command.workers,
            dask=command.dask,
            on_progress=on_progress,
        )
    if command.json:
        print_json(read_rows(folder))
    _conclude(folder, tally, done)
    if command.picture and tally.total <= _ON_PAGE:
        from cadalign.cli.runs import write_run_report

        write_run_report(folder)
    if tally.failed == tally.total:
        return NOTHING_WORKED
    return SOME_FAILED if tally.failed else SUCCESS


def run_folder(command: ManyCommand, options: ManyOptions) -> RunFolder:
    """The run's folder, by default beside the first input."""
    kind, first = options.experiment, command.observations[0]
    if command.out is not None:
        return RunFolder(command.out)
    if len(command.observations) > 1 or not first.exists():
        return RunFolder(first.parent / kind)
    name = first.resolve().name if first.is_dir() else first.stem
    return RunFolder(first.with_name(f"{name}_{kind}"))


def write_overlays(run: RunFolder, to: Path, style: OverlayStyle | None) -> None:
    """Draw all aligned models of a run over their photos, in a folder."""
    from cadalign.batch.exports import export_run

    found = export_run(run.path, to, format="overlay", style=style)
    left = f", {len(found.left_out):,} left out" if found.left_out else ""
    new_console().print(f"Overlays: {found.objects:,} in {to}{left}", markup=False)


def _conclude(folder: RunFolder, tally: Tally, done: str) -> None:
    """Say what came out, with the reasons of failures."""
    console = new_console()
    for reason, count in tally.reasons[:_MOST_REASONS]:
        console.print(f"failed {count:,}: {reason}", markup=False)
    rest = tally.reasons[_MOST_REASONS:]
    if rest:
        text = f"failed {sum(count for _, count in rest):,}: {len(rest):,} other reasons"
        console.print(text, markup=False)
    made = tally.total - tally.failed
    table = folder.path / "results.csv"
    text = f"{made:,} of {tally.total:,} {done}, {tally.failed:,} failed: {table}"
    console.print(text, markup=False)
