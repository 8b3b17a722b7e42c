"""`cadalign report`: the result of runs as one page, or as a table for papers and pull requests."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from cadalign.cli.output import new_console
from cadalign.errors import InputError

if TYPE_CHECKING:
    from cadalign.evaluation.runs.folder import RunFolder


@dataclass(frozen=True)
class Report:
    """Show the result of one or more runs.

    The page holds the headline table, plots, and a gallery whose instances open with their numbers
    and in 3D. It needs no network. Several runs of one kind are compared, instance by instance. A
    run may be unfinished: the page shows what there is.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs, as `cadalign demo`, `evaluate` and `simulate` write them."""
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

        if self.format == "html":
            report = write_report(self.runs, self.out or self._page(), assets=self.assets)
            console = new_console()
            console.print(f"Report: {report.path}", markup=False)
            if report.assets is not None:
                console.print(f"Its pictures: {report.assets}, to be kept beside it", markup=False)
            return 0
        if self.assets:
            raise InputError(
                f"a table has no pictures (--format {self.format})",
                where="--assets",
                fix="leave one of them out",
            )
        text = headline_text(self.runs, format=self.format)
        if self.out is None:
            sys.stdout.write(text)
        else:
            from cadalign.io.files import write_text

            write_text(self.out, text)
        return 0

    def _page(self) -> Path:
        return self.runs[0] / "report.html" if len(self.runs) == 1 else Path("report.html")


def write_run_report(folder: RunFolder) -> None:
    """Write a run's page at its end, and say where it is."""
    from cadalign.report import write_report

    report = write_report([folder.path], folder.report)
    new_console().print(f"Report: {report.path}", markup=False)
