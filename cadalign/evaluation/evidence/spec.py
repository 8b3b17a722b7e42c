"""Specification of the experiment on evidence beyond keypoints."""

from __future__ import annotations

from functools import partial

from cadalign.datasets import KeypointNet
from cadalign.evaluation.evidence.experiment import COLUMNS, evidence_benchmark
from cadalign.evaluation.evidence.figures import plots
from cadalign.evaluation.evidence.options import EvidenceRunOptions
from cadalign.evaluation.evidence.summary import HEADLINE, console_table, summarize
from cadalign.evaluation.keypointnet.tasks import KeypointTask, KeypointTasks
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.opened import Run
from cadalign.evaluation.runs.work import Plan
from cadalign.evaluation.spec import Spec, on_datasets

_CHUNK = 2


def plan(options: EvidenceRunOptions, folder: RunFolder) -> Plan[KeypointTask]:
    """Plan a run over the views of a dataset's models that have meshes."""
    dataset = KeypointNet(options.root, shapenet_root=options.shapenet).subset(
        categories=options.categories, split=options.split, with_mesh=True
    )
    tasks = KeypointTasks(dataset, options)
    config = {
        **options.as_config(),
        "experiment": options.experiment,
        "root": str(options.root.absolute()),
        "annotations": tasks.fingerprint(),
    }
    benchmark = evidence_benchmark(options)
    return Plan(benchmark, tasks, config | benchmark.config, _CHUNK)


def _describe(run: Run) -> str:
    models = run.count("category", "model_id")
    views = run.count("category", "model_id", "view")
    return (
        f"on {views:,} views of {models:,} models of {run.dataset} with meshes, keypoints with "
        f"{run.noise_px or 0:g} px of noise"
    )


SPEC = Spec(
    options=EvidenceRunOptions,
    plan=plan,
    results=COLUMNS,
    columns=HEADLINE,
    summarize=summarize,
    table=console_table,
    plots=plots,
    title=partial(on_datasets, "evidence beyond keypoints"),
    describe=_describe,
    note=(
        "Medians over the views that did not fail; lengths in diagonals of the object. Each method "
        "is given keypoints and the evidence that it is named after; views without `free` have "
        "known camera motion. The bound is the median rotation error of an ideal estimator, from "
        "the Cramer-Rao bound of each instance; the ratio to it is taken instance by instance."
    ),
)
