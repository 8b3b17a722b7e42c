"""Specification of the experiment on unseen objects.

Cells of a summary: ``instances`` and ``failed``; ``keypoints``, the mean number of those that did
not fail; over these the medians of the result table's errors, ``rotation_error_deg_90``, the 90th
percentile, and ``milliseconds``, the median time of an estimate; ``rotation_in_68``,
``rotation_in_95``, ``stretch_in_68``, ``stretch_in_95``, ``keypoints_within_68`` and
``keypoints_within_95``, the share of the truths that lie within the regions of these probabilities.
NaN where there is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt

from cadalign.datasets import KeypointNet
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.plots import Plot, Trace, cumulative
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.opened import Cells, Run
from cadalign.evaluation.runs.work import Plan
from cadalign.evaluation.shape_files import learn
from cadalign.evaluation.spec import Spec, on_datasets
from cadalign.evaluation.summary import (
    ConsoleTable,
    Summary,
    by_category_and_method,
    counted,
    known,
    mean_of,
    median_of,
    text_rows,
)
from cadalign.evaluation.unseen.experiment import COLUMNS, unseen_benchmark
from cadalign.evaluation.unseen.options import UnseenOptions
from cadalign.evaluation.unseen.tasks import UnseenTask, UnseenTasks

_MEDIANS = (
    *(metrics.ROTATION, metrics.BEST_ROTATION),
    *(metrics.TRANSLATION, metrics.TRANSLATION_UP_TO_SCALE),
    *(metrics.BOX_IOU, metrics.BOX_IOU_UP_TO_SCALE, metrics.STATED_BOX_IOU_UP_TO_SCALE),
    metrics.KEYPOINT_ERROR,
)
_COVERAGE = (
    *(metrics.ROTATION_IN_68, metrics.ROTATION_IN_95),
    *(metrics.STRETCH_IN_68, metrics.STRETCH_IN_95),
    *(metrics.KEYPOINTS_IN_68, metrics.KEYPOINTS_IN_95),
)
GALLERY = _MEDIANS
"""Errors of single objects."""
HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.KEYPOINTS, metrics.ROTATION, metrics.ROTATION_90),
    *(*_MEDIANS[1:], *_COVERAGE, metrics.QUERY_MILLISECONDS),
)


def summarize(run: Run) -> list[Summary]:
    """A summary for every category and method, and for all categories together."""
    return by_category_and_method(run, _summarize)


def console_table(run: Run, summaries: Sequence[Summary]) -> ConsoleTable:
    """The summaries for the console."""
    shown = (
        *(metrics.INSTANCES, metrics.FAILED),
        *(replace(metrics.ROTATION, digits=2), replace(metrics.ROTATION_90, digits=1)),
        *(replace(metrics.TRANSLATION_UP_TO_SCALE, digits=3), metrics.BOX_IOU_UP_TO_SCALE),
        *(replace(metrics.KEYPOINT_ERROR, digits=3), *_COVERAGE, metrics.QUERY_MILLISECONDS),
        *run.metrics,
    )
    return ConsoleTable(
        title="Medians per category and method, and truths within stated regions",
        labels=("category", "method"),
        heads=tuple(column.symbol for column in shown),
        rows=text_rows(summaries, shown),
        note="lengths in model diagonals; ~ scaled about the camera centre",
        narrow=True,
        wraps=True,
    )


def _summarize(category: str, method: str, cells: Cells) -> Summary:
    counts, _, solved = counted(cells, method)
    rotations = known(solved["rotation_error_deg"])
    values = {
        **counts,
        "keypoints": mean_of(solved["keypoints"]),
        **{metric.key: median_of(solved[metric.key]) for metric in _MEDIANS},
        "rotation_error_deg_90": float(np.percentile(rotations, 90)) if len(rotations) else np.nan,
        **{
            f"{name}_in_{percent}": _share(solved[f"{name}_level"], percent / 100)
            for name in ("rotation", "stretch")
            for percent in (68, 95)
        },
        "keypoints_within_68": mean_of(solved["keypoints_within_68"]),
        "keypoints_within_95": mean_of(solved["keypoints_within_95"]),
        "milliseconds": median_of(1e3 * solved["seconds"]),
    }
    return Summary(category, {"category": category, "method": method}, values)


def _share(levels: npt.NDArray[np.object_], nominal: float) -> float:
    """Share of the known levels that are at most the nominal one; NaN of none."""
    found = known(levels)
    return float((found <= nominal).mean()) if len(found) else np.nan


_CURVES = (
    (metrics.ROTATION, np.array([0.5, 1, 2, 3, 5, 7.5, 10, 15, 20, 30])),
    (replace(metrics.BOX_IOU_UP_TO_SCALE, log=False), np.arange(0, 1.01, 0.1)),
)
_LEVELS = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.68, 0.8, 0.9, 0.95, 0.99])
_CALIBRATED = (("rotation_level", "rotation"), ("stretch_level", "stretch"))


def plots(runs: Sequence[Run]) -> list[Plot]:
    """Shares of objects within an error, and of truths within stated regions, by method."""
    curves = [
        cumulative(runs, metric, places, title=f"{metric.label} of unseen objects")
        for metric, places in _CURVES
    ]
    return [*curves, *(_calibration(runs, column, name) for column, name in _CALIBRATED)]


def _calibration(runs: Sequence[Run], column: str, name: str) -> Plot:
    traces = []
    for index, run in enumerate(runs):
        for method in run.methods:
            levels = known(run.cells[column][run.cells["method"] == method])
            if len(levels):
                shares = (levels <= _LEVELS[:, None]).mean(axis=1)
                places = (100 * _LEVELS).tolist()
                traces.append(Trace.of(index, method, places, shares.tolist(), metrics.COVERED))
    return Plot(
        id=f"calibration_{name}",
        x=metrics.NOMINAL,
        y=metrics.COVERED,
        traces=traces,
        note="over all categories; deviations are right where both are equal",
        title=f"Calibration of the {name}",
    )


_CHUNK = 8


def plan(options: UnseenOptions, folder: RunFolder) -> Plan[UnseenTask]:
    """Plan a run over a split's objects; the folder gets what is learned from the other split."""
    dataset = KeypointNet(options.root, shapenet_root=options.shapenet)
    tasks = UnseenTasks(dataset, options)
    learned = learn(dataset, tasks.categories, split=options.train, folder=folder)
    config = {
        **options.as_config(),
        "experiment": options.experiment,
        "root": str(options.root.absolute()),
        "annotations": tasks.fingerprint(),
        "learned": learned.fingerprint(),
    }
    benchmark = unseen_benchmark(learned, options, folder if options.meshes else None)
    return Plan(benchmark, tasks, config | benchmark.config, _CHUNK)


def _describe(run: Run) -> str:
    objects = run.count("category", "model_id")
    given = run.config.get("keypoints")
    keypoints = "all keypoints" if given is None else f"{given} random keypoints"
    share = float(run.config.get("outliers") or 0.0)
    outliers = f", {100 * share:g} % of them moved to anywhere" if share else ""
    return (
        f"on {objects:,} objects of {run.dataset} that are no stretched copy of any model, "
        f"{keypoints} with {run.noise_px or 0:g} px of noise{outliers}"
    )


SPEC = Spec(
    options=UnseenOptions,
    plan=plan,
    results=COLUMNS,
    columns=HEADLINE,
    summarize=summarize,
    table=console_table,
    plots=plots,
    title=partial(on_datasets, "unseen objects"),
    describe=_describe,
    metrics=GALLERY,
    about=(
        "Green is the object with the box of its keypoints, red what a method found: the object "
        "warped to the estimated keypoints, and their box."
    ),
    note=(
        "Medians over the objects that did not fail; lengths in diagonals of the object. Up to "
        "scale: the estimate is scaled about the camera centre first, since one image does not "
        "tell an object's size. Within 68 % and 95 %: how often the truth lies in the regions of "
        "these probabilities that a method states; the deviations are right where the two agree."
    ),
)
