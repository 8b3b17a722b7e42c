"""Specifications of experiments: everything that the command line and reports need.

An experiment is a module of `cadalign.evaluation.experiments` with options
(`cadalign.evaluation.options`), tasks and an experiment (`cadalign.evaluation.runs.work`), and a
specification.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cadalign.errors import DataError, InputError, quote, unknown_name
from cadalign.evaluation.metrics import CATEGORY, Metric, has_values
from cadalign.evaluation.options import ExperimentOptions
from cadalign.evaluation.plots import Plot, draw_plot
from cadalign.evaluation.runs.work import COLUMNS, SKIPPED, Columns, Plan
from cadalign.evaluation.summary import ConsoleTable, Summary, summary_csv
from cadalign.io.files import create_folder, write_text

if TYPE_CHECKING:
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Run

    Summaries = Sequence[Summary]


@dataclass(frozen=True)
class Spec:
    """Specification of an experiment."""

    options: type[ExperimentOptions]
    """A frozen dataclass derived from `ExperimentOptions`: keywords of the API, options of the
    command line and configuration of the run."""
    plan: Callable[[Any, RunFolder], Plan[Any]]
    """Makes the plan of a run from its options and its folder, and may write files there."""
    columns: tuple[Metric, ...]
    """Columns of the headline table; columns without any value are left out."""
    summarize: Callable[[Run], Summaries]
    """Summarizes a run, finished or not; see `cadalign.evaluation.summary`."""
    results: Columns = COLUMNS
    """Required columns of a run's result table."""
    run: type[Run] | None = None
    """Class of the runs; `cadalign.evaluation.runs.tables.Run` by default."""
    console: tuple[Metric, ...] = ()
    """Columns of the console's table; the columns of the headline table by default."""
    console_note: str = ""
    group: Callable[[Run], Metric] = lambda run: CATEGORY
    """Returns the column that groups a run's tasks."""
    plots: Callable[[Sequence[Run]], list[Plot]] = lambda runs: []
    """Makes the plots of a page that compares runs."""
    apart: str = SKIPPED
    """Status of rows that count neither as failed nor as ok."""
    metrics: tuple[Metric, ...] = ()
    """Columns of the result table in a page's gallery, for experiments on instances."""
    kind: Callable[[Run], str] = lambda run: run.experiment
    """Returns the name of a run's kind; runs of one kind can be compared."""
    joins: bool = False
    topic: str = ""  # the kind by default; titles are "topic on dataset"
    subject: str = "tasks"  # plural noun for the tasks
    describe: Callable[[Run], str] | None = None
    """Describes the input of the methods, instead of subject and dataset."""
    about: str = ""  # explanation of the pictures
    note: str = ""  # explanation of the headline table

    @property
    def name(self) -> str:
        """Name of the experiment."""
        return self.options.experiment

    def open(self, path: Path, name: str | None = None) -> Run:
        """Read a run of the experiment; ``name`` distinguishes it from other runs."""
        from cadalign.evaluation.runs.tables import Run

        return (self.run or Run).open(path, name, columns=self.results)

    def title_of(self, runs: Sequence[Run]) -> str:
        """A title for runs of one kind, such as ``alignment on keypointnet``."""
        topic = self.topic or self.kind(runs[0])
        datasets = dict.fromkeys(filter(None, (run.dataset for run in runs)))
        return f"{topic} on {', '.join(datasets)}" if datasets else topic

    def description_of(self, run: Run) -> str:
        """Describe the input of the methods."""
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
        """The columns (of the headline by default) with at least one value.

        Metrics of users' functions come last.
        """
        further = {metric.key: metric for run in runs for metric in run.metrics}
        chosen = (*(self.columns if columns is None else columns), *further.values())
        return [c for c in chosen if has_values(c, [line.number(c.key) for line in lines])]

    def write(self, run: Run) -> Summaries:
        """Write ``summary.csv`` and ``figures`` of a finished run."""
        summaries = self.summarize(run)
        names = {"value": self.group(run).key}
        write_text(run.folder.summary, summary_csv(summaries, rename=names))
        for plot in self.plots([run]):
            draw_plot(create_folder(run.folder.figures) / plot.id, plot)
        return summaries


# In the order of help texts and messages.
_EXPERIMENTS = {
    "keypointnet": "cadalign.evaluation.experiments.keypointnet",
    "demo": "cadalign.evaluation.experiments.demo",
    "simulate": "cadalign.evaluation.experiments.simulation",
    "correspondences": "cadalign.evaluation.experiments.correspondences",
    "retrieval": "cadalign.evaluation.experiments.retrieval",
    "unseen": "cadalign.evaluation.experiments.unseen",
    "photos": "cadalign.evaluation.experiments.photos",
}
BATCHES: dict[str, str] = {}
"""Specifications of batch runs over observations, which `cadalign.report` also shows."""


def known_options() -> Iterator[type[ExperimentOptions]]:
    """The option classes of all experiments."""
    return (spec_named(name).options for name in _EXPERIMENTS)


def spec_named(name: str) -> Spec:
    """The specification of an experiment."""
    module = (_EXPERIMENTS | BATCHES).get(name)
    if module is None:
        raise unknown_name("experiment", name, list(_EXPERIMENTS))
    spec: Spec = import_module(module).SPEC
    return spec


def spec_of(run: Run) -> Spec:
    """The specification of a run's experiment."""
    return spec_of_config(run.config, run.folder.path)


def spec_of_config(config: dict[str, Any], path: Path) -> Spec:
    """The specification of the experiment in a run's configuration; raises DataError if unknown."""
    name = config.get("experiment")
    try:
        return spec_named(str(name))
    except InputError as error:
        raise DataError(
            f"there is no report on a run of {quote(name)}", where=str(path), fix=error.fix
        ) from None
