"""`cadalign demo`: see it work, on the sample dataset or on your own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cadalign.cli.evaluate import RunCommand, command_of
from cadalign.cli.options import new_console
from cadalign.cli.runs import NOTHING_WORKED, SUCCESS, conclude
from cadalign.evaluation.experiments.demo import DemoOptions


@dataclass(frozen=True, kw_only=True)
class _DemoCommand(RunCommand):
    """The end of a demonstration: a page called index.html, whatever failed."""

    out: Path = Path("demo")
    """Folder to write to."""

    def run(self) -> int:
        """Run the demonstration; returns the exit code."""
        # Renderers and solvers take a moment to import; `cadalign --help` should not wait for them.
        from cadalign.report import write_report

        spec, run = self.do_run()
        console = new_console()
        for row in run.results.to_pylist():
            if row["reason"]:
                text = f"{row['category']} {row['model_id']}: {row['reason']}"
                console.print(text, markup=False)
        code = conclude(spec, run, json=self.json)
        write_report([self.out], self.out / "index.html", title="cadalign demo")
        console.print(f"Pictures: {self.out / 'index.html'}", markup=False)
        return NOTHING_WORKED if code == NOTHING_WORKED else SUCCESS


Demo: Any = command_of(DemoOptions, _DemoCommand)
