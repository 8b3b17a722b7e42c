"""Specification of the experiment on real correspondences."""

from __future__ import annotations

from functools import partial

from cadalign.datasets import open_correspondences
from cadalign.evaluation.correspondences import summary
from cadalign.evaluation.correspondences.experiment import COLUMNS, correspondence_benchmark
from cadalign.evaluation.correspondences.options import CorrespondenceOptions
from cadalign.evaluation.correspondences.tasks import CorrespondenceTask, CorrespondenceTasks
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.opened import Run
from cadalign.evaluation.runs.work import Plan
from cadalign.evaluation.spec import Spec, on_datasets

_CHUNK = 8


def plan(options: CorrespondenceOptions, folder: RunFolder) -> Plan[CorrespondenceTask]:
    """Plan a run over the images of a model or data set."""
    images = open_correspondences(options.path, format=options.format)
    tasks = CorrespondenceTasks(images, options)
    config = {
        **options.as_config(),
        "experiment": options.experiment,
        "path": str(options.path.absolute()),
        "loader": type(images).__name__,
        "correspondences": tasks.fingerprint(),
    }
    del config["format"]  # the loader says it
    benchmark = correspondence_benchmark(options)
    return Plan(benchmark, tasks, config | benchmark.config, _CHUNK)


def _describe(run: Run) -> str:
    images = run.count("image")
    return (
        f"on real correspondences in {images:,} image{'s' * (images != 1)} of {run.dataset}, with "
        "a share of them moved to anywhere in the image"
    )


SPEC = Spec(
    options=CorrespondenceOptions,
    plan=plan,
    columns=summary.HEADLINE,
    results=COLUMNS,
    summarize=summary.summarize,
    table=summary.console_table,
    group=lambda run: metrics.OUTLIERS,
    plots=summary.plots,
    conclude=summary.conclude,
    title=partial(on_datasets, "correspondences"),
    describe=_describe,
    note=(
        "Medians; a failure counts as an error beyond all others. Success: rotation within 0.5 deg "
        "and both scales within 1 %."
    ),
)
