"""Specification of the experiment on real correspondences.

Cells of a summary: ``inputs``, the number that the method was given; ``failed``, of those for which
it found nothing; ``unreadable``, of inputs that there would be besides if all images could be read;
``success``, the share with a rotation error of less than 0.5 degrees and at most 1 % on either
scale, NaN where there are none; quartiles of the errors over all inputs, a failure counting as an
error beyond all others, the translation's over the distance from the camera to the mean of the
points; ``inlier_precision`` and ``inlier_recall``, medians over what it found, NaN for methods that
do not search for inliers; ``milliseconds``, quartiles of the time of one call, failed ones too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from cadalign.datasets import open_correspondences
from cadalign.evaluation.correspondences.experiment import (
    COLUMNS,
    CorrespondenceTask,
    CorrespondenceTasks,
    correspondence_benchmark,
)
from cadalign.evaluation.correspondences.options import CorrespondenceOptions
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.metrics.table import Metric
from cadalign.evaluation.outcome import OK
from cadalign.evaluation.plots import QUARTILES_NOTE, Plot, Trace
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.opened import Cells, Run
from cadalign.evaluation.runs.work import Plan
from cadalign.evaluation.spec import Spec, on_datasets
from cadalign.evaluation.summary import (
    Conclusion,
    ConsoleTable,
    Quartiles,
    Summary,
    group_name,
    median_of,
    where,
    with_medians,
)

ERRORS = (metrics.ROTATION, metrics.TRANSLATION_OF_DISTANCE, metrics.SCALE_Y, metrics.SCALE_Z)
HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.SUCCESS, *ERRORS),
    *(metrics.INLIER_RECALL, metrics.MILLISECONDS),
)
SUCCESS_NOTE = "success: rotation within 0.5 deg and both scales within 1 %"


def summarize(run: Run) -> list[Summary]:
    """A summary for every share of outliers and method, in the order of the run."""
    cells = run.cells
    return [
        with_medians(
            _summarize(share, method, cells),
            where(cells, cells["outliers"] == share),
            run.metrics,
        )
        for share in np.unique(cells["outliers"]).tolist()
        for method in run.methods
    ]


def console_table(run: Run, summaries: Sequence[Summary]) -> ConsoleTable:
    """Quartiles of the errors, and medians, for the console."""
    failed = replace(metrics.FAILED, symbol="fail")
    shown = (failed, metrics.SUCCESS, *ERRORS, metrics.INLIER_RECALL)
    return ConsoleTable(
        title="Lower quartile, median and upper quartile per share of outliers and method",
        labels=(metrics.OUTLIERS.symbol, "method"),
        heads=tuple(each.symbol for each in (*shown, metrics.MILLISECONDS, *run.metrics)),
        rows=[
            (
                f"{100 * s['outliers']:g} %",
                s.method,
                failed.text(s["failed"]),
                metrics.SUCCESS.text(s["success"]),
                *(_three(s[metric.key], metric) for metric in ERRORS),
                _number(100 * s["inlier_recall"], digits=1),
                _number(s["milliseconds"].median, digits=1),
                *(metric.text(s[metric.key]) for metric in run.metrics),
            )
            for s in summaries
        ],
        note=(
            f"{max(s['inputs'] for s in summaries)} inputs each; a failure counts as an error "
            "beyond all others (-).\n"
            "succ: R < 0.5 deg and both scales within 1 %; t: % of the camera's distance from the "
            "mean of the points;\nfound: share of the inliers that were kept (median); ms: median."
        ),
        narrow=True,
    )


def conclude(run: Run, summaries: Sequence[Summary]) -> Conclusion:
    """Numbers of rows, of failures, and of inputs whose image cannot be read."""
    unreadable = sum(summary["unreadable"] for summary in summaries)
    rows = sum(summary["inputs"] for summary in summaries) + unreadable
    failed = sum(summary["failed"] for summary in summaries) + unreadable
    note = f"{unreadable} of them because their image cannot be read" if unreadable else ""
    return Conclusion(rows, failed, {"unreadable": unreadable}, note)


def plots(runs: Sequence[Run]) -> list[Plot]:
    """Success, errors and times against the share of outliers."""
    found = [summarize(run) for run in runs]
    inputs = max((summary["inputs"] for summary in found[0]), default=0)
    made = []
    for metric in (metrics.SUCCESS, *ERRORS, metrics.MILLISECONDS):
        note = f"{QUARTILES_NOTE}; failures count as infinite"
        if metric is metrics.MILLISECONDS:
            note = QUARTILES_NOTE
        elif metric is metrics.SUCCESS:
            note = ""
        traces = []
        for index, summaries in enumerate(found):
            for method in runs[index].methods:
                rows = [summary for summary in summaries if summary.method == method]
                x = [100 * summary["outliers"] for summary in rows]
                y = [summary[metric.key] for summary in rows]
                traces.append(Trace.of(index, method, x, y, metric))
        caption = f"{inputs} inputs each; {note or SUCCESS_NOTE}"
        figure = f"outliers_{metric.key}"
        made.append(Plot(metric.key, metrics.OUTLIERS, metric, traces, note, caption, figure))
    return made


def _summarize(share: float, method: str, cells: Cells) -> Summary:
    chosen = (cells["outliers"] == share) & (cells["method"] == method)
    # No points were given where the image cannot be read.
    given = chosen & ~np.isnan(cells["points"].astype(float))
    solved = given & (cells["status"] == OK)
    inputs = int(given.sum())
    quartiles = {}
    for metric in ERRORS:
        errors = np.full(inputs, np.inf)
        errors[solved[given]] = cells[metric.key][solved].astype(float)
        quartiles[metric.key] = Quartiles.of(errors)
    values = {
        "inputs": inputs,
        "failed": inputs - int(solved.sum()),
        "unreadable": int(chosen.sum()) - inputs,
        "success": float(cells["success"][given].astype(float).mean()) if inputs else np.nan,
        **quartiles,
        "inlier_precision": median_of(cells["inlier_precision"][solved]),
        "inlier_recall": median_of(cells["inlier_recall"][solved]),
        "milliseconds": Quartiles.of(1e3 * cells["seconds"][given]),
    }
    names = {"outliers": share, "method": method}
    return Summary(group_name(metrics.OUTLIERS, share), names, values, tasks=inputs)


def _three(values: Quartiles, metric: Metric) -> str:
    quartiles = (values.lower, values.median, values.upper)
    return " ".join(_number(metric.factor * value, digits=metric.digits) for value in quartiles)


def _number(value: float, *, digits: int) -> str:
    """A number with so many digits after the point, fewer for larger ones; a dash for NaN."""
    if value != value:
        return "-"
    if value >= 1e4:
        return f"{value:.0e}"
    places = max(0, digits + 1 - len(str(int(value))))
    return f"{value:.{places}f}"


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
    columns=HEADLINE,
    results=COLUMNS,
    summarize=summarize,
    table=console_table,
    group=lambda run: metrics.OUTLIERS,
    plots=plots,
    conclude=conclude,
    title=partial(on_datasets, "correspondences"),
    describe=_describe,
    note=(
        "Medians; a failure counts as an error beyond all others. Success: rotation within 0.5 deg "
        "and both scales within 1 %."
    ),
)
