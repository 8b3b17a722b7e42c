"""`cadalign evaluate retrieval`: whether models are found again in a library."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from cadalign.cli.output import new_console
from cadalign.cli.report import write_run_report
from cadalign.cli.runs import exit_code, print_json, run_progress

if TYPE_CHECKING:
    from cadalign.evaluation.retrieval.figures import RetrievalSummary
    from cadalign.evaluation.runs.folder import RunFolder


@dataclass(frozen=True)
class EvaluateRetrieval:
    """Evaluate the retrieval of CAD models.

    Each model is stretched by factors from 0.5 to 2 along y and z and seen from a random view; some
    of its visible keypoints, with noise, are looked up in a library that holds the model
    (leave-in), and in one that doesn't (leave-out). The run's folder gets results.parquet with a
    row per query, protocol and method, summary.csv, figures and the library. Killed, it goes on
    where it was when the same command is started again.

    Exit codes: 0 all rows are good, 3 finished but some rows failed, 1 refused, interrupted or all
    rows failed, 2 a wrong command line.
    """

    root: Annotated[Path, tyro.conf.Positional]
    """Folder in KeypointNet's layout, or a library's file."""
    categories: tuple[str, ...] | None = None
    """Categories of the models to find; all by default."""
    noises_px: tuple[float, ...] = (1.0, 3.0, 5.0)
    """Standard deviations of the keypoints' noise, in pixels."""
    keypoints: tuple[int, ...] = (6, 7, 8, 9, 10)
    """How many visible keypoints are given."""
    protocols: tuple[str, ...] = ("leave-in", "leave-out")
    """leave-in, leave-out."""
    methods: tuple[str, ...] = ("optimal", "epnp")
    """optimal, optimal-unstretched, epnp."""
    whole_library: bool = False
    """Compare with the models of all categories, not only with those of the right one."""
    shape_sigma: float = 0.02
    """How far the keypoints of the best model may lie off where the library has not the right one,
    as a share of their extent."""
    max_models: int | None = None
    """How many models of each category at most."""
    seed: int = 0
    """Seed of everything random."""
    workers: int = -1
    """Processes; -1 for one for each core, 0 for none."""
    dask: str | None = None
    """Address of a Dask scheduler, whose workers are used instead."""
    out: Path = Path("runs/retrieval")
    """The run's folder."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> int:
        """Run the evaluation; returns the exit code."""
        from cadalign.evaluation.retrieval.experiment import run_retrieval
        from cadalign.evaluation.retrieval.tasks import RetrievalEvaluation
        from cadalign.evaluation.runs.folder import RunFolder

        options = RetrievalEvaluation(
            categories=self.categories,
            noises_px=self.noises_px,
            keypoints=self.keypoints,
            protocols=self.protocols,
            methods=self.methods,
            whole_library=self.whole_library,
            shape_sigma=self.shape_sigma,
            max_models=self.max_models,
            seed=self.seed,
        )
        folder = RunFolder(self.out)
        with run_progress("evaluating") as on_progress:
            run_retrieval(
                self.root,
                options,
                folder,
                workers=self.workers,
                dask=self.dask,
                on_progress=on_progress,
            )
        code = conclude_retrieval(folder, json=self.json)
        write_run_report(folder)
        return code


def conclude_retrieval(folder: RunFolder, *, json: bool) -> int:
    """Write a finished run's summary and say what came out; returns its exit code."""
    from cadalign.evaluation.accuracy.outcome import FAILED
    from cadalign.evaluation.retrieval.figures import ALL, write_retrieval_report
    from cadalign.evaluation.runs.tables import read_table

    summaries = write_retrieval_report(folder)
    statuses = read_table(folder.results, columns=["status"])["status"].to_pylist()
    rows, failed = len(statuses), statuses.count(FAILED)
    if json:
        summary = [asdict(summary) for summary in summaries]
        print_json({"run": str(folder.path), "rows": rows, "failed": failed, "summary": summary})
    else:
        _print_table([summary for summary in summaries if summary.category == ALL])
        text = f"Run: {folder.path} ({failed} of {rows} rows failed)"
        new_console().print(text, markup=False)
    return exit_code(rows, failed)


def _print_table(summaries: Sequence[RetrievalSummary]) -> None:
    from rich import box
    from rich.table import Table

    table = Table(
        title="Rates over the queries, medians of the best match",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        padding=(0, 1, 0, 0),
    )
    for name in ("protocol", "method"):
        table.add_column(name, no_wrap=True)
    numbers = (
        "px",
        "kpts",
        "n",
        "first%",
        "top5%",
        "MRR",
        "score%",
        "shape%",
        "IoU",
        "R deg",
        "ms",
    )
    for name in numbers:
        table.add_column(name, justify="right", no_wrap=True)
    for summary in summaries:
        values = (
            (100 * summary.rank_1, ".1f"),
            (100 * summary.rank_5, ".1f"),
            (summary.reciprocal_rank, ".3f"),
            (100 * summary.score, ".1f"),
            (100 * summary.shape_distance, ".2f"),
            (summary.box_iou, ".3f"),
            (summary.rotation_error_deg, ".2f"),
            (summary.milliseconds, ".1f"),
        )
        table.add_row(
            summary.protocol,
            summary.method,
            f"{summary.noise_px:g}",
            str(summary.keypoints),
            str(summary.queries),
            *("-" if value != value else format(value, form) for value, form in values),
        )
    new_console(stderr=False).print(table)
