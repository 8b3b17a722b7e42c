"""`cadalign evaluate correspondences`: real images with known poses, and wrong correspondences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from cadalign.cli.output import new_console
from cadalign.cli.report import write_run_report
from cadalign.cli.runs import exit_code, print_json, run_progress

if TYPE_CHECKING:
    from cadalign.evaluation.correspondences.figures import CorrespondenceSummary, Quartiles
    from cadalign.evaluation.runs.folder import RunFolder


@dataclass(frozen=True)
class EvaluateCorrespondences:
    """Evaluate methods on real correspondences with outliers.

    For every image, share of outliers and draw, the scene is stretched by factors from 0.5 to 2
    along y and z, and the share of the image points is moved to anywhere in the image; all methods
    get the same input. The run's folder gets results.parquet with a row per input and method,
    summary.csv, figures and report.html. Killed, it goes on where it was when the same command is
    started again. Times are best measured with --workers 1.

    Exit codes: 0 all rows are good, 3 finished but some rows failed, 1 refused, interrupted or all
    rows failed, 2 a wrong command line.
    """

    path: Annotated[Path, tyro.conf.Positional]
    """Folder of a COLMAP or Bundler model, or of a blind-PnP data set's split."""
    format: Literal["auto", "colmap", "bundler", "blind-pnp"] = "auto"
    """Format of the folder; auto goes by the names of the files."""
    outliers: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
    """Shares of the image points that are moved, from 0 to less than 1."""
    draws: int = 20
    """How often scales and outliers are drawn for every image and share."""
    methods: tuple[str, ...] = (
        "epnp",
        "aepnp-paper",
        "ransac-aepnp",
        "ransac-aepnp-refined",
        "ransac-optimal",
    )
    """Methods of `cadalign fit`, optimal-huber, optimal-cauchy, and those that search for inliers:
    ransac-optimal, ransac-ap4p, and the paper's two steps, ransac-aepnp and ransac-aepnp-refined.
    The others get all points."""
    max_reproj_error: float = 4.0
    """Largest reprojection error of an inlier, in pixels."""
    max_iterations: int = 10_000
    """Bound on the samples of a search for inliers."""
    max_images: int | None = None
    """How many images at most, the first ones."""
    seed: int = 0
    """Seed of everything random."""
    workers: int = -1
    """Processes; -1 for one for each core, 0 for none."""
    dask: str | None = None
    """Address of a Dask scheduler, whose workers are used instead."""
    out: Path = Path("runs/correspondences")
    """The run's folder."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> int:
        """Run the evaluation; returns the exit code."""
        from cadalign.evaluation.correspondences.experiment import (
            CorrespondenceOptions,
            run_correspondences,
        )
        from cadalign.evaluation.correspondences.figures import write_correspondences_report
        from cadalign.evaluation.runs.folder import RunFolder

        options = CorrespondenceOptions(
            outliers=self.outliers,
            draws=self.draws,
            methods=self.methods,
            max_reproj_error=self.max_reproj_error,
            max_iterations=self.max_iterations,
            seed=self.seed,
            max_images=self.max_images,
        )
        folder = RunFolder(self.out)
        with run_progress("evaluating") as on_progress:
            run_correspondences(
                self.path,
                options,
                folder,
                format=self.format,
                workers=self.workers,
                dask=self.dask,
                on_progress=on_progress,
            )
        summaries = write_correspondences_report(folder)
        write_run_report(folder)
        return conclude(folder, summaries, json=self.json)


def conclude(folder: RunFolder, summaries: Sequence[CorrespondenceSummary], *, json: bool) -> int:
    """Say what came out of a finished run; returns its exit code."""
    unreadable = sum(summary.unreadable for summary in summaries)
    rows = sum(summary.inputs for summary in summaries) + unreadable
    failed = sum(summary.failed for summary in summaries) + unreadable
    if json:
        counts = {"rows": rows, "failed": failed, "unreadable": unreadable}
        summary = [asdict(summary) for summary in summaries]
        print_json({"run": str(folder.path), **counts, "summary": summary})
    else:
        _print_table(summaries)
        note = f", {unreadable} of them because their image cannot be read" if unreadable else ""
        text = f"Run: {folder.path} ({failed} of {rows} rows failed{note})"
        new_console().print(text, markup=False)
    return exit_code(rows, failed)


def _print_table(summaries: Sequence[CorrespondenceSummary]) -> None:
    from rich import box
    from rich.table import Table

    table = Table(
        title="Lower quartile, median and upper quartile per share of outliers and method",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        padding=(0, 1, 0, 0),
    )
    table.add_column("outl", no_wrap=True, justify="right")
    table.add_column("method", no_wrap=True)
    columns = ("fail", "succ%", "R deg", "t %", "s_y %", "s_z %", "found%", "ms")
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    previous = None
    for summary in summaries:
        if previous not in (None, summary.outliers):
            table.add_section()
        table.add_row(
            "" if summary.outliers == previous else f"{100 * summary.outliers:g} %",
            summary.method,
            str(summary.failed),
            "-" if summary.success != summary.success else f"{100 * summary.success:.1f}",
            _three(summary.rotation_error_deg, digits=3),
            _three(summary.translation_error, factor=100),
            _three(summary.scale_y_error, factor=100),
            _three(summary.scale_z_error, factor=100),
            _number(100 * summary.inlier_recall, digits=1),
            _number(summary.milliseconds.median, digits=1),
        )
        previous = summary.outliers
    console = new_console(stderr=False)
    console.print(table)
    console.print(
        f"{max(summary.inputs for summary in summaries)} inputs each; a failure counts as an error "
        "beyond all others (-).\n"
        "succ: R < 0.5 deg and both scales within 1 %; t: % of the camera's distance from the mean "
        "of the points;\nfound: share of the right points that were kept (median); ms: median."
    )


def _three(values: Quartiles, *, factor: float = 1.0, digits: int = 2) -> str:
    quartiles = (values.lower, values.median, values.upper)
    return " ".join(_number(factor * value, digits=digits) for value in quartiles)


def _number(value: float, *, digits: int) -> str:
    """So many digits after the point, fewer for larger numbers; a dash for NaN."""
    if value != value:
        return "-"
    if value >= 1e4:
        return f"{value:.0e}"
    places = max(0, digits + 1 - len(str(int(value))))
    return f"{value:.{places}f}"
