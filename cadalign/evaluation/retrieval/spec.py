"""Specification of the retrieval experiment."""

from __future__ import annotations

from functools import partial

from cadalign.datasets import KeypointNet
from cadalign.evaluation.metrics.table import QUERIES
from cadalign.evaluation.retrieval.experiment import REQUIRED_COLUMNS, retrieval_benchmark
from cadalign.evaluation.retrieval.options import RetrievalRunOptions
from cadalign.evaluation.retrieval.summary import HEADLINE, console_table, lines, plots, summarize
from cadalign.evaluation.retrieval.tasks import RetrievalTask, retrieval_tasks
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.opened import Run
from cadalign.evaluation.runs.work import Plan
from cadalign.evaluation.spec import Spec, on_datasets
from cadalign.retrieval.library import Library

_CHUNK = 16


def plan(options: RetrievalRunOptions, folder: RunFolder) -> Plan[RetrievalTask]:
    """Plan a run over the models of a library, which the folder gets as ``library.cadalign``."""
    library = _library_of(options)
    tasks = retrieval_tasks(library, options)
    folder.make()
    file = folder.path / "library.cadalign"
    name = library.fingerprint[:16]
    claimed = folder.read_config()
    # One that no run.json speaks of is from a run that died before it began, perhaps another's; the
    # library of another run, which is to be refused, stays as it is.
    if claimed is None or claimed.get("library") == name:
        library.save(file)
    config = {
        **options.as_config(),
        "experiment": options.experiment,
        "root": str(options.root.absolute()),
        "library": name,
    }
    return Plan(retrieval_benchmark(str(file.absolute()), options), tasks, config, _CHUNK)


def _library_of(options: RetrievalRunOptions) -> Library:
    """The library at a place, or one of the data set there."""
    if options.root.is_file():
        return Library.open(options.root)
    categories = None if options.whole_library else options.categories
    return Library.from_dataset(
        KeypointNet(options.root, shapenet_root=options.shapenet), categories=categories
    )


def _describe(run: Run) -> str:
    models = run.count("category", "model_id")
    return f"of finding {models:,} model{'s' * (models != 1)} of {run.dataset} again"


SPEC = Spec(
    options=RetrievalRunOptions,
    plan=plan,
    columns=HEADLINE,
    results=REQUIRED_COLUMNS,
    summarize=summarize,
    lines=lines,
    table=console_table,
    group=lambda run: QUERIES,
    plots=plots,
    title=partial(on_datasets, "retrieval"),
    describe=_describe,
    note=(
        "Leave-in: the library holds the true model; models whose keypoints are the same after "
        "stretch count as it. Leave-out: it and these are taken out. Shape distance, box IoU, "
        "rotation error and time are medians, the first three of the best match. None of "
        "these: the share of queries whose object is more likely none of the models than one."
    ),
)
