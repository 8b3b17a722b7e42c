"""`cadalign simulate`: the AEPnP paper's simulation, and figures like its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from cadalign.cli.output import new_console
from cadalign.cli.report import write_run_report
from cadalign.cli.runs import exit_code, print_json, run_progress

if TYPE_CHECKING:
    from cadalign.evaluation.simulation.experiment import SweepKind
    from cadalign.evaluation.simulation.figures import SweepSummary


@dataclass(frozen=True)
class _Sweep:
    """What the sweeps share."""

    name: ClassVar[str]

    methods: tuple[str, ...] | None = None
    """Methods of `cadalign fit`, optimal-huber, optimal-cauchy, ransac-optimal, ransac-ap4p,
    ransac-aepnp, and limit: the Cramer-Rao limit. The sweep's own by default."""
    values: tuple[float, ...] | None = None
    """What is varied: these values instead of the sweep's own."""
    runs: int | None = None
    """Problems for each value."""
    points: int | None = None
    """Number of points, where it is held."""
    noise_px: float | None = None
    """Standard deviation of the noise in pixels, where it is held."""
    seed: int = 0
    """Seed of everything random."""
    workers: int | None = None
    """Processes; -1 for one for each core (the default, but for runtime: 1), 0 for none."""
    dask: str | None = None
    """Address of a Dask scheduler, whose workers are used instead."""
    out: Path | None = None
    """The run's folder; runs/simulate_<sweep> by default."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> int:
        """Run the simulation; returns the exit code."""
        from cadalign.evaluation.api import run_sweep, sweep_of
        from cadalign.evaluation.runs.folder import RunFolder
        from cadalign.evaluation.simulation.figures import write_sweep_report

        kind = sweep_of(
            self.name,
            methods=self.methods,
            values=self.values,
            runs=self.runs,
            points=self.points,
            noise_px=self.noise_px,
        )
        # Processes side by side would slow one another down.
        workers = self.workers if self.workers is not None else 1 if kind.is_timed else -1
        folder = RunFolder(self.out or Path("runs") / f"simulate_{self.name}")
        with run_progress(f"simulating {self.name}") as on_progress:
            run_sweep(
                kind,
                folder,
                seed=self.seed,
                workers=workers,
                dask=self.dask,
                on_progress=on_progress,
            )
        summaries = write_sweep_report(folder, kind)
        write_run_report(folder)
        metric = summaries[0].metric
        shown = [summary for summary in summaries if summary.metric == metric]
        rows, failed = sum(s.runs for s in shown), sum(s.failed for s in shown)
        if self.json:
            rest = {"rows": rows, "failed": failed, "summary": [asdict(s) for s in summaries]}
            print_json({"run": str(folder.path), **rest})
        else:
            _print_table(kind, shown)
            new_console().print(f"Figures: {folder.figures}", markup=False)
        return exit_code(rows, failed)


@dataclass(frozen=True)
class SimulateNoise(_Sweep):
    """Errors against the keypoints' noise, at 1,024 points."""

    name: ClassVar[str] = "noise"


@dataclass(frozen=True)
class SimulatePoints(_Sweep):
    """Errors against the number of points, at 2 px noise."""

    name: ClassVar[str] = "points"


@dataclass(frozen=True)
class SimulateOutliers(_Sweep):
    """Errors against the share of wrong keypoints, at 100 points and 2 px noise."""

    name: ClassVar[str] = "outliers"


@dataclass(frozen=True)
class SimulateRuntime(_Sweep):
    """Time of one call against the number of points."""

    name: ClassVar[str] = "runtime"


@dataclass(frozen=True)
class Simulate:
    """Repeat the AEPnP paper's simulation: tables, a page, and figures as PNG and PDF."""

    what: (
        Annotated[SimulateNoise, tyro.conf.subcommand("noise")]
        | Annotated[SimulatePoints, tyro.conf.subcommand("points")]
        | Annotated[SimulateOutliers, tyro.conf.subcommand("outliers")]
        | Annotated[SimulateRuntime, tyro.conf.subcommand("runtime")]
    )

    def run(self) -> int:
        """Run the simulation that was chosen; returns its exit code."""
        return self.what.run()


def _print_table(kind: SweepKind, summaries: Sequence[SweepSummary]) -> None:
    """Print one metric's medians, a row for each value."""
    from rich.table import Table

    table = Table(title=f"Median {summaries[0].metric}")
    table.add_column(kind.column, justify="right")
    for method in kind.methods:
        table.add_column(method, justify="right", no_wrap=True)
    for value in kind.values:
        row = [s for s in summaries if s.value == value]
        table.add_row(
            f"{value:g}", *("-" if s.failed == s.runs else f"{s.median:.4g}" for s in row)
        )
    new_console(stderr=False).print(table)
