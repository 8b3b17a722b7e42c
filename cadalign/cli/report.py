"""`cadalign report`: the result of runs as one page, or as a table for papers and pull requests."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from cadalign.cli.common import say
from cadalign.cli.evaluate import command_of
from cadalign.cli.runs import conclude
from cadalign.errors import InputError
from cadalign.evaluation.experiments.estimates import EstimatesOptions
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.io.files import keeping, write_text


@dataclass(frozen=True)
class ReportCommand:
    """Show the result of one or more runs.

    The page holds the headline table, plots, and a gallery whose instances open with their numbers
    and in 3D. It needs no network. Several runs of one kind are compared, instance by instance. A
    run may be unfinished: the page shows what there is.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Folders of runs, as `cadalign demo`, `evaluate` and `simulate` write them."""
    estimates: tuple[Path, ...] = ()
    """Files of poses that other programs estimated, with --data: BOP's results (CSV) or
    scene_gt.json, or JSON in the form of Scan2CAD's annotations. Each is a method; they are scored
    by the data set's metrics, in the folder --run, and shown beside the runs given."""
    data: Path | None = None
    """Folder of the photos that the estimates are of."""
    run_folder: Annotated[Path, tyro.conf.arg(name="run")] = Path("runs/estimates")
    """Folder of the scored estimates."""
    workers: int = 0
    """Processes that score estimates; -1 for one for each core."""
    out: Path | None = None
    """File to write. By default report.html, in the run's folder if it is one run; a table goes to
    standard output."""
    format: Literal["html", "md", "csv", "latex"] = "html"
    """The page, or the headline table alone."""
    assets: bool = False
    """Put pictures into a folder beside the page, which then stays small. Pages that would exceed
    60 MB have one in any case."""

    def run(self) -> int:
        """Write the report; returns the exit code."""
        from cadalign.report import headline_text, write_report

        runs, code = self.runs, 0
        if self.estimates or self.data is not None:
            code = self._score()
            runs = (self.run_folder, *runs)
        if self.format == "html":
            page = runs[0] / "report.html" if len(runs) == 1 else Path("report.html")
            report = write_report(runs, self.out or page, assets=self.assets)
            say(f"Report: {report.path}")
            if report.assets is not None:
                say(f"Its pictures: {report.assets}, to be kept beside it")
            return code
        if self.assets:
            what = f"a table has no pictures (--format {self.format})"
            raise InputError(what, where="--assets", fix="leave one of them out")
        text = headline_text(runs, format=self.format)
        if self.out is None:
            sys.stdout.write(text)
        else:
            with keeping(path for run in runs for path in RunFolder(run).sources):
                write_text(self.out, text)
        return code

    def _score(self) -> int:
        """Score the estimates and print the table; returns the exit code."""
        if self.data is None:
            what = "the photos that they are of are not known"
            fix = "give --data, the folder of the data set"
            raise InputError(what, where="--estimates", fix=fix)
        command = command_of(EstimatesOptions)
        given = {"root": self.data, "estimates": self.estimates}
        spec, run = command(**given, out=self.run_folder, workers=self.workers).do_run()
        return conclude(spec, run, json=False)
