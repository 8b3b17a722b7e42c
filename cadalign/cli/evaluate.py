"""`cadalign evaluate`, `simulate` and `demo`: runs of experiments; `cadalign report`."""

from __future__ import annotations

import sys
from contextlib import redirect_stdout
from dataclasses import dataclass, fields, make_dataclass
from inspect import getdoc
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import tyro

from cadalign.cli.common import NOTHING_WORKED, SUCCESS, JsonOption, group_of, say
from cadalign.cli.options import name_flags
from cadalign.cli.runs import conclude, run_progress, write_run_report
from cadalign.evaluation.experiments.demo import DemoOptions
from cadalign.evaluation.experiments.simulation import SweepOptions
from cadalign.evaluation.options import ExperimentOptions, RunOptions
from cadalign.evaluation.registry import Spec, known_options, spec_named
from cadalign.evaluation.runs.folder import RunFolder

if TYPE_CHECKING:
    from cadalign.evaluation.runs.tables import Run


_COMMAND = "evaluate"
_EXIT_CODES = (
    "Exit codes: 0 all rows succeeded, 3 some rows failed, 1 all rows failed or the run was "
    "refused or interrupted, 2 wrong command line."
)


@dataclass(frozen=True, kw_only=True)
class RunCommand(JsonOption, RunOptions):
    """Command of an experiment; see `command_of`."""

    options_type: ClassVar[type[ExperimentOptions]]

    def __post_init__(self) -> None:
        """Skip the checks: `do_run` makes them, and reports an error in one line."""

    def run(self) -> int:
        """Do the run and print its results; returns the exit code."""
        spec, run = self.do_run()
        code = conclude(spec, run, json=self.json)
        write_run_report(run.folder)
        return code

    def do_run(self) -> tuple[Spec, Run]:
        """Do the run and show its progress; returns its specification and its tables."""
        from cadalign.evaluation.api import prepare
        from cadalign.evaluation.runs.engine import execute

        kind = self.options_type
        # Modules of users may print, which must not mix with the command's output.
        with redirect_stdout(sys.stderr), name_flags(self, sweep="SWEEP"):
            options = kind(**{field.name: getattr(self, field.name) for field in fields(kind)})
            folder = RunFolder(self.out or Path("runs") / options.run_name)
            plan, pool = prepare(options, folder, workers=self.workers, dask=self.dask)
        label = f"{kind.command.removesuffix('e')}ing"
        with redirect_stdout(sys.stderr), run_progress(label) as on_progress:
            execute(plan, folder, workers=pool, on_progress=on_progress)
        spec = spec_named(kind.experiment)
        return spec, spec.open(folder.path)


def command_of(
    options: type[ExperimentOptions],
    base: type[RunCommand] = RunCommand,
    *,
    about: str | None = None,
) -> Any:
    """Make the command of an experiment from its options and a ``base`` command.

    ``about`` is its help, by default the docstring of the options.
    """
    namespace = {"options_type": options, "__doc__": about or options.__doc__}
    return make_dataclass(
        options.__name__, [], bases=(base, options), namespace=namespace, frozen=True
    )


def _evaluations() -> dict[str, Any]:
    """Make the subcommands of `cadalign evaluate`, one per experiment."""
    return {
        options.experiment: command_of(options, about=f"{getdoc(options)}\n\n{_EXIT_CODES}")
        for options in known_options()
        if options.command == _COMMAND
    }


Evaluate = group_of("Evaluate methods on a dataset.", _evaluations)
Simulate: Any = command_of(SweepOptions)


@dataclass(frozen=True, kw_only=True)
class _DemoCommand(RunCommand):
    """The command `cadalign demo`; it writes index.html even if models failed."""

    out: Path = Path("demo")
    """Folder for the results and index.html."""
    files: Path | None = None
    """Only write the files of the README's example to this folder."""

    def run(self) -> int:
        """Run the demonstration; returns the exit code."""
        if self.files is not None:
            from cadalign.cli.example import write_example

            write_example(self.files)
            return SUCCESS
        # Renderers and solvers take a moment to import; `cadalign --help` should not wait for them.
        from cadalign.report import write_report

        spec, run = self.do_run()
        code = conclude(spec, run, json=self.json)
        write_report([self.out], self.out / "index.html")
        say(f"Pictures: {self.out / 'index.html'}")
        return NOTHING_WORKED if code == NOTHING_WORKED else SUCCESS


Demo: Any = command_of(DemoOptions, _DemoCommand)


@dataclass(frozen=True)
class ReportCommand:
    """Write a page with the results of one or more runs.

    The page holds the main table, plots, and a gallery of instances in 3D. It works without a
    network. Several runs of one kind are compared side by side. An unfinished run is shown as far
    as it got.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Folders of runs that `cadalign demo`, `evaluate`, `simulate`, `fit` or `retrieve` wrote."""
    out: Path | None = None
    """Page to write; by default report.html, in the run's folder if there is a single run."""

    def run(self) -> int:
        """Write the report; returns the exit code."""
        from cadalign.report import write_report

        page = self.runs[0] / "report.html" if len(self.runs) == 1 else Path("report.html")
        say(f"Report: {write_report(self.runs, self.out or page)}")
        return 0
