"""Specifications of experiments, all that command line, report and `evaluate show` know of them.

An experiment is a module of `cadalign.evaluation.experiments`: options
(`cadalign.evaluation.options`), tasks and an experiment (`cadalign.evaluation.runs.work`), and a
specification. Its runs, tables, page and `evaluate show` follow.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cadalign.errors import DataError, InputError, quote, unknown
from cadalign.evaluation.metrics import CATEGORY, Metric, told
from cadalign.evaluation.options import ExperimentOptions
from cadalign.evaluation.plots import Plot, draw_plots
from cadalign.evaluation.runs.work import COLUMNS, FAILED, SKIPPED, Columns, Plan
from cadalign.evaluation.summary import Conclusion, ConsoleTable, Summary, summary_csv
from cadalign.io.files import write_text

if TYPE_CHECKING:
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Run

    Summaries = Sequence[Summary]

Reference = tuple[tuple[Summary, ...], str]
"""Published numbers beside a headline table, and a note on them."""


def count_failures(run: Run, summaries: Summaries, *, apart: str = SKIPPED) -> Conclusion:
    """Count rows and failures; rows of the status ``apart`` are neither."""
    statuses = run.results["status"].to_pylist()
    others = statuses.count(apart)
    note = f"{others} more were {apart}" if others else ""
    rows = len(statuses) - others
    return Conclusion(rows, statuses.count(FAILED), {apart.replace(" ", "_"): others}, note)


@dataclass(frozen=True)
class Spec:
    """Specification of an experiment."""

    options: type[ExperimentOptions]
    """A frozen dataclass derived from `ExperimentOptions`, which names the experiment; at once
    keywords of the API, flags of the command line and configuration of the run."""
    plan: Callable[[Any, RunFolder], Plan[Any]]
    """Makes the plan of a run from its options and its folder, in which it may put files."""
    columns: tuple[Metric, ...]
    """Columns of the headline table; those are left out that no line has a value of."""
    summarize: Callable[[Run], Summaries]
    """Makes summaries of a run, finished or not; see `cadalign.evaluation.summary`."""
    results: Columns = COLUMNS
    """Columns that the result table of a run must have to be summarized."""
    run: type[Run] | None = None
    """The class of its runs; by default `cadalign.evaluation.runs.tables.Run`."""
    lines: Callable[[Summaries], Summaries] = list
    """Makes lines of the headline table from summaries; by default a line of each."""
    table: Callable[[Run, Summaries], ConsoleTable] | None = None
    """Makes the table for the console of a run and its summaries; by default the headline table."""
    group: Callable[[Run], Metric] = lambda run: CATEGORY
    """The column that a run's tasks are grouped by."""
    plots: Callable[[Sequence[Run]], list[Plot]] = lambda runs: []
    """Makes the plots of a page of runs to be compared."""
    write_more: Callable[[Run, Summaries], object] = lambda run, summaries: None
    """Writes more files of a run and its summaries."""
    conclude: Callable[[Run, Summaries], Conclusion] = count_failures
    """Counts rows and failures of a run."""
    metrics: tuple[Metric, ...] = ()
    """Columns of the result table that a page's gallery shows, for experiments on instances."""
    kind: Callable[[Run], str] = lambda run: run.experiment
    joins: bool = False
    """Runs of one kind, whose name this gives, can be compared."""
    title: Callable[[Sequence[Run]], str] | None = None  # names runs of one kind in a few words
    topic: str = ""  # what is evaluated, in place of a title: ``topic on dataset``
    describe: Callable[[Run], str] = lambda run: f"on {run.total:,} tasks of {run.experiment}"
    """Says what the methods were run on."""
    about: str = ""  # explains the pictures
    note: str = ""  # explains the numbers of the headline table
    reference: Callable[[Sequence[Run], set[str]], Reference] = lambda *_: ((), "")
    """Published numbers for the groups of some runs."""

    @property
    def name(self) -> str:
        """Name of the experiment."""
        return self.options.experiment

    def open(self, path: Path, name: str | None = None) -> Run:
        """Read a run of the experiment, ``name`` being its name beside others."""
        from cadalign.evaluation.runs.tables import Run

        return (self.run or Run).open(path, name, columns=self.results)

    def title_of(self, runs: Sequence[Run]) -> str:
        """A few words that name runs of one kind, such as ``alignment on keypointnet``."""
        if self.title is not None:
            return self.title(runs)
        datasets = dict.fromkeys(run.dataset for run in runs)
        return f"{self.topic or runs[0].experiment} on {', '.join(datasets)}"

    def console_table(self, run: Run, summaries: Summaries) -> ConsoleTable:
        """The table for the console."""
        if self.table is not None:
            return self.table(run, summaries)
        lines = self.lines(summaries)
        columns = self.shown_columns(lines, [run])
        labels = (self.group(run).heading, "method")
        return ConsoleTable.of("Medians per group and method", lines, columns, labels=labels)

    def shown_columns(self, lines: Summaries, runs: Sequence[Run]) -> list[Metric]:
        """The columns that some line has a value of, those of further metrics last."""
        further = {metric.key: metric for run in runs for metric in run.metrics}
        columns = (*self.columns, *further.values())
        return [c for c in columns if told(c, [line.number(c.key) for line in lines])]

    def write(self, run: Run) -> Summaries:
        """Write ``summary.csv`` and ``figures`` of a finished run."""
        summaries = self.summarize(run)
        names = {"value": self.group(run).key}
        write_text(run.folder.summary, summary_csv(summaries, rename=names))
        plots = self.plots([run])
        if plots:
            draw_plots(run.folder.made_figures(), plots)
        self.write_more(run, summaries)
        return summaries


# In the order in which they are named to users, with their modules.
_EXPERIMENTS = {
    name: f"cadalign.evaluation.experiments.{module}"
    for name, module in {
        "keypointnet": "keypointnet",
        "demo": "demo",
        "simulate": "simulation",
        "correspondences": "correspondences",
        "retrieval": "retrieval",
        "unseen": "unseen",
        "photos": "photos",
    }.items()
}
BATCHES: dict[str, str] = {}
"""Modules of runs over many observations, which `cadalign.report` shows as experiments are."""


def known_options() -> Iterator[type[ExperimentOptions]]:
    """The options of all experiments."""
    return (spec_named(name).options for name in _EXPERIMENTS)


def spec_named(name: str) -> Spec:
    """The specification of an experiment."""
    module = (_EXPERIMENTS | BATCHES).get(name)
    if module is None:
        raise unknown("experiment", name, list(_EXPERIMENTS))
    spec: Spec = import_module(module).SPEC
    return spec


def spec_of(run: Run) -> Spec:
    """The specification of a run's experiment."""
    return spec_of_config(run.config, run.folder.path)


def spec_of_config(config: dict[str, Any], path: Path) -> Spec:
    """The specification of the experiment that a run's configuration names; see `spec_of`."""
    name = config.get("experiment")
    try:
        return spec_named(str(name))
    except InputError as error:
        raise DataError(
            f"there is no report on a run of {quote(name)}", where=str(path), fix=error.fix
        ) from None
