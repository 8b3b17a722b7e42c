"""Specification of the experiment on evidence beyond keypoints.

Cells of a summary: ``instances`` and ``failed``; over those that did not fail the mean number of
``keypoints``, the medians of the result table's errors, ``over_limit``, the median ratio of the
rotation error to its bound, and ``milliseconds``, the median time of an alignment. NaN where there
is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from cadalign.datasets import KeypointNet
from cadalign.evaluation.evidence.experiment import COLUMNS, evidence_benchmark
from cadalign.evaluation.evidence.options import EvidenceRunOptions
from cadalign.evaluation.keypointnet.tasks import KeypointTask, KeypointTasks
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.plots import Plot, cumulative
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.opened import Cells, Run
from cadalign.evaluation.runs.work import Plan
from cadalign.evaluation.spec import Spec, on_datasets
from cadalign.evaluation.summary import (
    ConsoleTable,
    Summary,
    by_category_and_method,
    counted,
    mean_of,
    median_of,
    text_rows,
)

ROTATION_BOUND = replace(
    metrics.ROTATION,
    key="rotation_bound_deg",
    label="rotation error of an ideal estimator",
    head="R bound",
    symbol="bound",
)
_MEDIANS = (
    *(metrics.ROTATION, metrics.TRANSLATION, metrics.SCALE_Y, metrics.SCALE_Z, metrics.BOX_IOU),
    *(ROTATION_BOUND, metrics.OVER_BOUND),
)
HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.SKIPPED, metrics.KEYPOINTS, *_MEDIANS),
    metrics.QUERY_MILLISECONDS,
)


def summarize(run: Run) -> list[Summary]:
    """A summary for every category and method, and for all categories together."""
    return by_category_and_method(run, _summarize)


def console_table(run: Run, summaries: Sequence[Summary]) -> ConsoleTable:
    """The summaries for the console."""
    shown = (
        *(metrics.INSTANCES, metrics.FAILED, metrics.ROTATION),
        *(replace(metrics.TRANSLATION, digits=4), metrics.SCALE_Y, metrics.SCALE_Z),
        *(metrics.BOX_IOU, ROTATION_BOUND, replace(metrics.OVER_BOUND, symbol="R/bound")),
        metrics.QUERY_MILLISECONDS,
        *run.metrics,
    )
    return ConsoleTable(
        title="Medians per category and evidence",
        labels=("category", "evidence"),
        heads=tuple(column.symbol for column in shown),
        rows=text_rows(summaries, shown),
        note="t in diagonals of the object; R/bound: median ratio to the instance's own bound",
        narrow=True,
        wraps=True,
    )


def _summarize(category: str, method: str, cells: Cells) -> Summary:
    counts, skipped, solved = counted(cells, method)
    seconds = np.asarray(solved["seconds"], dtype=float)
    values = {
        **counts,
        "keypoints": mean_of(solved["keypoints"]),
        **{metric.key: median_of(solved[metric.key]) for metric in _MEDIANS},
        "milliseconds": median_of(1e3 * seconds),
        "skipped": skipped,
    }
    return Summary(category, {"category": category, "method": method}, values)


_CURVES = (
    (metrics.ROTATION, np.array([0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1, 1.5, 2, 3, 5, 10])),
    (replace(metrics.BOX_IOU, log=False), np.arange(0, 1.01, 0.05)),
)


def plots(runs: Sequence[Run]) -> list[Plot]:
    """Shares of objects within an error, by evidence."""
    return [
        cumulative(runs, metric, places, title=f"{metric.label} by evidence")
        for metric, places in _CURVES
    ]


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
