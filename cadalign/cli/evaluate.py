"""`cadalign evaluate`: whole datasets, in runs that can be killed and started again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from cadalign.cli.evaluate_correspondences import EvaluateCorrespondences, conclude
from cadalign.cli.evaluate_retrieval import EvaluateRetrieval, conclude_retrieval
from cadalign.cli.output import new_console
from cadalign.cli.report import write_run_report
from cadalign.cli.runs import exit_code, print_json, run_progress

if TYPE_CHECKING:
    from cadalign.evaluation.accuracy.summary import CategorySummary
    from cadalign.evaluation.runs.folder import RunFolder


@dataclass(frozen=True)
class EvaluateKeypointNet:
    """Evaluate methods on views of KeypointNet's models.

    Each view shows a model as it is; methods get its visible keypoints, with noise, and the model
    stretched by factors from 0.5 to 2 along y and z. The run's folder gets results.parquet with a
    row per model, view and method, summary.csv, figures, report.html and, if asked for, overlays.
    Killed, it goes on where it was when the same command is started again.

    Exit codes: 0 all rows are good, 3 finished but some rows failed, 1 refused, interrupted or all
    rows failed, 2 a wrong command line.
    """

    root: Annotated[Path, tyro.conf.Positional]
    """Folder in KeypointNet's layout."""
    categories: tuple[str, ...] | None = None
    """Categories to take; all by default."""
    split: str | None = None
    """The dataset's split to take, such as test; all models by default."""
    noise_px: float = 1.0
    """Standard deviation of the keypoints' noise, in pixels."""
    min_visible: int = 6
    """How many keypoints a view must show."""
    views_per_model: int = 1
    """How many views of each model."""
    max_models: int | None = None
    """How many models of each category at most."""
    methods: tuple[str, ...] = ("optimal", "aepnp", "aepnp-paper", "epnp", "limit")
    """Methods of `cadalign fit`, optimal-huber, optimal-cauchy, ransac-optimal, ransac-ap4p,
    ransac-aepnp, and limit: the Cramer-Rao limit."""
    visibility: Literal["auto", "rays", "hull"] = "auto"
    """Keypoints are seen that rays cast at the mesh reach, or by a rule on the hull of the
    keypoints; auto takes rays where there is a mesh."""
    render: Literal["none", "overlay"] = "none"
    """Whether to draw the first method's result for every model with a mesh."""
    seed: int = 0
    """Seed of everything random."""
    workers: int = -1
    """Processes; -1 for one for each core, 0 for none."""
    dask: str | None = None
    """Address of a Dask scheduler, whose workers are used instead."""
    out: Path = Path("runs/keypointnet")
    """The run's folder."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> int:
        """Run the evaluation; returns the exit code."""
        from cadalign.evaluation.api import KeypointNetOptions, run_keypointnet
        from cadalign.evaluation.keypointnet.figures import write_keypointnet_report
        from cadalign.evaluation.runs.folder import RunFolder

        options = KeypointNetOptions(
            categories=self.categories,
            split=self.split,
            noise_px=self.noise_px,
            min_visible=self.min_visible,
            views_per_model=self.views_per_model,
            methods=self.methods,
            visibility=self.visibility,
            render=self.render,
            seed=self.seed,
            max_models=self.max_models,
        )
        folder = RunFolder(self.out)
        with run_progress("evaluating") as on_progress:
            run_keypointnet(
                self.root,
                options,
                folder,
                workers=self.workers,
                dask=self.dask,
                on_progress=on_progress,
            )
        summaries = write_keypointnet_report(folder)
        write_run_report(folder)
        return _conclude(folder, summaries, json=self.json)


@dataclass(frozen=True)
class EvaluateShow:
    """Show a finished run again: its summary, and its figures drawn anew."""

    run_folder: Annotated[Path, tyro.conf.Positional]
    """The run's folder."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> int:
        """Show the run; returns the exit code, that of the run."""
        from cadalign.errors import DataError
        from cadalign.evaluation.keypointnet.figures import write_keypointnet_report
        from cadalign.evaluation.runs.folder import RunFolder

        folder = RunFolder(self.run_folder)
        config = folder.read_config()
        experiment = None if config is None else config.get("experiment")
        if experiment not in ("keypointnet", "correspondences", "retrieval"):
            raise DataError("not the folder of an evaluation's run", where=str(self.run_folder))
        if not folder.is_finished:
            raise DataError(
                "the run is not finished",
                where=str(self.run_folder),
                fix="start the command that made it again: it goes on",
            )
        if experiment == "retrieval":
            return conclude_retrieval(folder, json=self.json)
        if experiment == "correspondences":
            from cadalign.evaluation.correspondences.figures import write_correspondences_report

            return conclude(folder, write_correspondences_report(folder), json=self.json)
        return _conclude(folder, write_keypointnet_report(folder), json=self.json)


@dataclass(frozen=True)
class Evaluate:
    """Evaluate methods on a dataset."""

    what: (
        Annotated[EvaluateKeypointNet, tyro.conf.subcommand("keypointnet")]
        | Annotated[EvaluateCorrespondences, tyro.conf.subcommand("correspondences")]
        | Annotated[EvaluateRetrieval, tyro.conf.subcommand("retrieval")]
        | Annotated[EvaluateShow, tyro.conf.subcommand("show")]
    )

    def run(self) -> int:
        """Run the evaluation that was chosen; returns its exit code."""
        return self.what.run()


def _conclude(folder: RunFolder, summaries: Sequence[CategorySummary], *, json: bool) -> int:
    """Say what came out."""
    total = [summary for summary in summaries if summary.category == "all"]
    rows = sum(summary.instances for summary in total)
    failed = sum(summary.failed for summary in total)
    if json:
        print_json(
            {
                "run": str(folder.path),
                "rows": rows,
                "failed": failed,
                "summary": [asdict(summary) for summary in summaries],
            }
        )
    else:
        _print_table(summaries)
        new_console().print(f"Run: {folder.path} ({failed} of {rows} rows failed)", markup=False)
    return exit_code(rows, failed)


def _print_table(summaries: Sequence[CategorySummary]) -> None:
    from rich.table import Table

    table = Table(title="Medians per category and method; success over all instances")
    for name in ("category", "method"):
        table.add_column(name, no_wrap=True)
    for name in ("n", "failed", "kpts", "R deg", "t", "s_y %", "s_z %", "IoU", "R deg*", "5/5 %*"):
        table.add_column(name, justify="right", no_wrap=True)
    previous = None
    for summary in summaries:
        if previous not in (None, summary.category):
            table.add_section()
        table.add_row(
            "" if summary.category == previous else summary.category,
            summary.method,
            str(summary.instances),
            str(summary.failed),
            *summary.cells(),
            "-" if summary.failed == summary.instances else f"{summary.sym_rotation_error_deg:.3f}",
            f"{100 * summary.success_5deg_5pct:.1f}",
        )
        previous = summary.category
    console = new_console(stderr=False)
    console.print(table)
    console.print("t in model diagonals; * rotations that map a model onto itself are no errors")
