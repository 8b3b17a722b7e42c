"""`cadalign fit` of many observations: a run, its table, and its page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from cadalign.batch.fits import Tally, run_fits
from cadalign.batch.options import FitRunOptions
from cadalign.batch.table import read_rows
from cadalign.cli.options import named_as_flags, new_console
from cadalign.cli.runs import NOTHING_WORKED, SOME_FAILED, SUCCESS, print_json, run_progress
from cadalign.errors import InputError
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.io.input_kinds import DetectorOptions

if TYPE_CHECKING:
    from cadalign.cli.fit import Fit

_MOST_REASONS = 10
_ON_PAGE = 5000
"""Observations beyond which the page is left to `cadalign report`."""


def fit_many(command: Fit) -> int:
    """Align all observations; returns the exit code, 3 where some have failed."""
    if command.overlay is not None:
        fix = "leave it out: the page of a run draws every model over its photo"
        raise InputError("is for one observation", where="--overlay", fix=fix)
    folder = RunFolder(command.out or _folder_of(command.observations))
    with named_as_flags(command, command.fitting, command.ransac):
        options = FitRunOptions(
            inputs=command.observations,
            estimate=command.estimate,
            changes=command.changes,
            detector=_detector_of(command),
            pictures=command.pictures if command.picture else 0,
        )
        with run_progress("fitting") as on_progress:
            tally = run_fits(
                options,
                folder,
                workers=command.workers,
                dask=command.dask,
                on_progress=on_progress,
            )
    if command.json:
        print_json(read_rows(folder))
    _conclude(folder, tally)
    if command.picture and tally.total <= _ON_PAGE:
        from cadalign.cli.runs import write_run_report

        write_run_report(folder)
    if tally.failed == tally.total:
        return NOTHING_WORKED
    return SOME_FAILED if tally.failed else SUCCESS


def _folder_of(inputs: tuple[Path, ...]) -> Path:
    """The run's folder, beside the first input."""
    first = inputs[0]
    if len(inputs) > 1 or not first.exists():
        return first.parent / "fit"
    name = first.resolve().name if first.is_dir() else first.stem
    return first.with_name(f"{name}_fit")


def _detector_of(command: Fit) -> DetectorOptions:
    names = DetectorOptions.__dataclass_fields__
    return DetectorOptions(**{name: getattr(command, name) for name in names})


def _conclude(folder: RunFolder, tally: Tally) -> None:
    """Say what came out, with the reasons of failures."""
    console = new_console()
    for reason, count in tally.reasons[:_MOST_REASONS]:
        console.print(f"failed {count:,}: {reason}", markup=False)
    rest = tally.reasons[_MOST_REASONS:]
    if rest:
        text = f"failed {sum(count for _, count in rest):,}: {len(rest):,} other reasons"
        console.print(text, markup=False)
    aligned = tally.total - tally.failed
    table = folder.path / "results.csv"
    text = f"{aligned:,} of {tally.total:,} aligned, {tally.failed:,} failed: {table}"
    console.print(text, markup=False)
