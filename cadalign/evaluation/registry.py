"""Specifications of experiments, all that command line and report know of them.

An experiment is a module of `cadalign.evaluation.experiments`: options
(`cadalign.evaluation.options`), tasks and an experiment (`cadalign.evaluation.runs.work`), and a
specification. Its runs, tables and page follow.
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
from cadalign.evaluation.plots import Plot, draw_plot
from cadalign.evaluation.runs.work import COLUMNS, SKIPPED, Columns, Plan
from cadalign.evaluation.summary import ConsoleTable, Summary, summary_csv
from cadalign.io.files import made_folder, write_text

if TYPE_CHECKING:
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Run

    Summaries = Sequence[Summary]


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
    console: tuple[Metric, ...] = ()
    """Columns of the table for the console; by default those of the headline table."""
    console_note: str = ""
    group: Callable[[Run], Metric] = lambda run: CATEGORY
    """The column that a run's tasks are grouped by."""
    plots: Callable[[Sequence[Run]], list[Plot]] = lambda runs: []
    """Makes the plots of a page of runs to be compared."""
    apart: str = SKIPPED
    """Status of rows that are counted neither as failed nor as ok."""
    metrics: tuple[Metric, ...] = ()
    """Columns of the result table that a page's gallery shows, for experiments on instances."""
    kind: Callable[[Run], str] = lambda run: run.experiment
    joins: bool = False
    """Runs of one kind, whose name this gives, can be compared."""
    topic: str = ""  # what is evaluated, by default the experiment: ``topic on dataset``
    subject: str = "tasks"  # what the tasks are, in the plural
    describe: Callable[[Run], str] | None = None
    """Says what the methods were run on, in place of the subject and the dataset."""
    about: str = ""  # explains the pictures
    note: str = ""  # explains the numbers of the headline table

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
        topic = self.topic or self.kind(runs[0])
        datasets = dict.fromkeys(filter(None, (run.dataset for run in runs)))
        return f"{topic} on {', '.join(datasets)}" if datasets else topic

    def description_of(self, run: Run) -> str:
        """Says what the methods were run on."""
        if self.describe is not None:
            return self.describe(run)
        dataset = f" of {run.dataset}" if run.dataset else ""
        return f"on {self.subject}{dataset} ({run.total:,})"

    def console_table(self, run: Run, summaries: Summaries) -> ConsoleTable:
        """The table for the console."""
        shown = self.shown_columns(summaries, [run], self.console or self.columns)
        heading = self.group(run).heading
        return ConsoleTable(
            title=f"Medians and rates by {heading} and method",
            labels=(heading, "method"),
            heads=tuple(column.symbol for column in shown),
            rows=[
                (s.group, s.method, *(column.text(s.number(column.key)) for column in shown))
                for s in summaries
            ],
            note=self.console_note,
        )

    def shown_columns(
        self, lines: Summaries, runs: Sequence[Run], columns: Sequence[Metric] | None = None
    ) -> list[Metric]:
        """The columns, by default the headline's, that some line has a value of.

        Those of further metrics are the last.
        """
        further = {metric.key: metric for run in runs for metric in run.metrics}
        chosen = (*(self.columns if columns is None else columns), *further.values())
        return [c for c in chosen if told(c, [line.number(c.key) for line in lines])]

    def write(self, run: Run) -> Summaries:
        """Write ``summary.csv`` and ``figures`` of a finished run."""
        summaries = self.summarize(run)
        names = {"value": self.group(run).key}
        write_text(run.folder.summary, summary_csv(summaries, rename=names))
        for plot in self.plots([run]):
            draw_plot(made_folder(run.folder.figures) / plot.id, plot)
        return summaries


# In the order in which they are named to users, with module and name of their specifications.
_EXPERIMENTS = {
    "keypointnet": "cadalign.evaluation.experiments.keypointnet:SPEC",
    "demo": "cadalign.evaluation.experiments.keypointnet:DEMO",
    "simulate": "cadalign.evaluation.experiments.simulation:SPEC",
    "correspondences": "cadalign.evaluation.experiments.correspondences:SPEC",
    "retrieval": "cadalign.evaluation.experiments.retrieval:SPEC",
    "unseen": "cadalign.evaluation.experiments.unseen:SPEC",
    "photos": "cadalign.evaluation.experiments.photos:SPEC",
}
BATCHES: dict[str, str] = {}
"""Specifications of runs over many observations, which `cadalign.report` shows likewise."""


def known_options() -> Iterator[type[ExperimentOptions]]:
    """The options of all experiments."""
    return (spec_named(name).options for name in _EXPERIMENTS)


def spec_named(name: str) -> Spec:
    """The specification of an experiment."""
    place = (_EXPERIMENTS | BATCHES).get(name)
    if place is None:
        raise unknown("experiment", name, list(_EXPERIMENTS))
    module, _, attribute = place.partition(":")
    spec: Spec = getattr(import_module(module), attribute or "SPEC")
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
