"""`cadalign demo`: see it work, on the sample dataset or on your own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cadalign.cli.output import make_folder, new_console, progress_over
from cadalign.errors import InputError

if TYPE_CHECKING:
    from cadalign.evaluation.accuracy.outcome import Outcome


@dataclass(frozen=True)
class Demo:
    """Align stretched models to pictures of the originals and show the result.

    For each model: choose a view, render it, stretch the model by factors from 0.5 to 2 along y
    and z, add noise to its visible keypoints, fit, and draw true (green) and predicted (red) box.
    Writes results.csv, overlays/*.png and index.html.
    """

    out: Path = Path("demo")
    """Folder to write to."""
    root: Path | None = None
    """Folder of a dataset in KeypointNet's layout; without it a sample dataset is made."""
    categories: tuple[str, ...] | None = None
    """Categories to take; all by default."""
    per_category: int = 6
    """How many models of each category at most."""
    noise_px: float = 1.0
    """Standard deviation of the keypoints' noise, in pixels."""
    seed: int = 0
    """Seed of everything random."""

    def run(self) -> int:
        """Run the demonstration; returns the exit code."""
        if self.per_category < 1:
            raise InputError(f"{self.per_category} is not positive", where="--per-category")
        if not 0 <= self.noise_px < float("inf"):
            raise InputError(f"{self.noise_px} is not a noise level", where="--noise-px")
        if self.seed < 0:
            raise InputError(f"{self.seed} is negative", where="--seed")
        # Renderers and solvers take a moment to import; `cadalign --help` should not wait for them.
        from cadalign.evaluation.accuracy.outcome import OK
        from cadalign.evaluation.demo.demo import (
            choose_models,
            open_dataset,
            run_demo,
            write_results,
        )
        from cadalign.report import write_report

        console = new_console()
        make_folder(self.out)
        dataset = open_dataset(self.root, out=self.out, per_category=self.per_category)
        keys = choose_models(dataset, categories=self.categories, per_category=self.per_category)
        trials = []
        for trial in progress_over(
            run_demo(dataset, keys, out=self.out, noise_px=self.noise_px, seed=self.seed),
            total=len(keys),
            label="aligning",
            console=console,
        ):
            trials.append(trial)
            for outcome in trial.outcomes:
                if outcome.status != OK:
                    name = f"{outcome.category} {outcome.model_id}"
                    console.print(f"{name}: {outcome.reason}", markup=False)
        write_results(self.out, trials, root=dataset.root, noise_px=self.noise_px, seed=self.seed)
        write_report([self.out], self.out / "index.html", title="cadalign demo")
        outcomes = [outcome for trial in trials for outcome in trial.outcomes]
        _print_table(outcomes)
        console.print(f"Pictures: {self.out / 'index.html'}", markup=False)
        return 0 if any(outcome.status == OK for outcome in outcomes) else 1


def _print_table(outcomes: Sequence[Outcome]) -> None:
    from rich.table import Table

    from cadalign.evaluation.accuracy.summary import summarize

    table = Table(title="Medians per category")
    table.add_column("category")
    for name in (
        "instances",
        "failed",
        "keypoints (mean)",
        "R error [deg]",
        "t error",
        "s1 (y) error [%]",
        "s2 (z) error [%]",
        "box IoU",
    ):
        table.add_column(name, justify="right")
    for summary in summarize(outcomes):
        table.add_row(
            summary.category,
            str(summary.instances),
            str(summary.failed),
            *summary.cells(),
        )
    new_console(stderr=False).print(table)
