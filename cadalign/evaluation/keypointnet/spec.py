"""Specification of the KeypointNet experiment, and what it shares with others on instances.

Cells of a summary: ``instances``, those that were not skipped, ``failed`` and ``skipped``;
``keypoints``, the mean number of those that did
not fail; medians of the result table's errors over these, NaN where all failed; those up to scale
only in runs that have them; ``success_5deg_5pct`` and ``success_10deg_10pct``, the share of all
instances, failed ones too, with symmetry-aware rotation error, translation error in diagonals of
the model and both relative scale errors at most this; ``over_limit``, the median rotation error
over that of the Cramer-Rao bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets import KeypointNet
from cadalign.errors import InputError
from cadalign.evaluation.accuracy.style import label_log_axis, look_of, new_figure, save_figure
from cadalign.evaluation.keypointnet.experiment import REQUIRED_COLUMNS, keypointnet_benchmark
from cadalign.evaluation.keypointnet.options import KeypointNetOptions
from cadalign.evaluation.keypointnet.tasks import KeypointTask, KeypointTasks
from cadalign.evaluation.methods.fitted import LIMIT
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.metrics.table import INSTANCE_METRICS, UP_TO_SCALE, Metric
from cadalign.evaluation.outcome import OK, SKIPPED
from cadalign.evaluation.paper.table import PERCENT_NOTE, paper_lines
from cadalign.evaluation.plots import in_math
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.opened import Cells, Run
from cadalign.evaluation.runs.work import Plan
from cadalign.evaluation.shape_files import NO_SHAPES, ShapeFiles
from cadalign.evaluation.spec import Reference, Spec, on_datasets
from cadalign.evaluation.summary import (
    ALL,
    ConsoleTable,
    Summary,
    counted,
    mean_of,
    median_of,
    text_rows,
    where,
    with_medians,
)

MEDIANS = (
    *(metric.key for metric in metrics.INSTANCE_METRICS if metric is not metrics.RMS),
    *(metric.key for metric in metrics.UP_TO_SCALE),
)
TABLE = (
    *(metrics.KEYPOINTS, metrics.ROTATION, metrics.TRANSLATION),
    *(metrics.SCALE_Y, metrics.SCALE_Z, metrics.BOX_IOU),
)
"""Columns of the plain medians."""
HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.SKIPPED),
    *(*TABLE, *metrics.UP_TO_SCALE, metrics.SYM_ROTATION),
    *(metrics.SUCCESS_5, metrics.SUCCESS_10, metrics.OVER_BOUND),
)


def summarize(run: Run) -> list[Summary]:
    """A summary for every category and method, and for all categories together."""
    cells = run.cells
    categories = sorted(set(cells["category"].tolist()))
    summaries = [
        summary
        for name in categories
        for summary in summarize_cells(
            name, where(cells, cells["category"] == name), further=run.metrics
        )
    ]
    return [*summaries, *summarize_cells(ALL, cells, further=run.metrics)]


def summarize_cells(
    category: str, cells: Cells, *, further: Sequence[Metric] = ()
) -> list[Summary]:
    """A summary of rows for every method, in the order in which they come."""
    methods = list(dict.fromkeys(cells["method"].tolist()))
    bound = np.nan
    if LIMIT in methods:
        solved = (cells["method"] == LIMIT) & (cells["status"] == OK)
        bound = median_of(cells["rotation_error_deg"][solved])
    return [
        with_medians(_summarize_method(category, method, cells, bound), cells, further)
        for method in methods
    ]


def lines(summaries: Sequence[Summary]) -> list[Summary]:
    """Lines of the headline table; a single category needs no line for all."""
    single = len({summary.group for summary in summaries}) == 2
    return [summary for summary in summaries if summary.group != ALL or not single]


def texts(summary: Summary) -> list[str]:
    """The plain medians as shown."""
    return [column.text(summary[column.key]) for column in TABLE]


def console_table(run: Run, summaries: Sequence[Summary]) -> ConsoleTable:
    """The summaries for the console."""
    rest = (metrics.SYM_ROTATION, metrics.SUCCESS_5)
    if metrics.BOX_IOU_UP_TO_SCALE.key in run.cells:  # the table must not be wider
        rest = metrics.UP_TO_SCALE
    counts = (metrics.INSTANCES, metrics.FAILED, metrics.SKIPPED)
    told = [each for each in counts if metrics.told(each, [s[each.key] for s in summaries])]
    shown = (*told, *TABLE, *rest, *run.metrics)
    return ConsoleTable(
        title="Medians per category and method; success over all instances",
        labels=("category", "method"),
        heads=tuple(column.symbol for column in shown),
        rows=text_rows(summaries, shown),
        note="t in model diagonals; * rotations that map a model onto itself are no errors"
        if rest is not metrics.UP_TO_SCALE
        else "t in model diagonals; ~ up to scale: one image does not tell the size",
    )


def _summarize_method(category: str, method: str, cells: Cells, bound: float) -> Summary:
    counts, skipped, solved = counted(cells, method)
    count = counts["instances"]
    medians = {name: median_of(solved[name]) for name in MEDIANS if name in solved}
    values = {
        **counts,
        "keypoints": mean_of(solved["keypoints"]),
        **medians,
        "success_5deg_5pct": _success(solved, 5.0, 0.05) / count if count else np.nan,
        "success_10deg_10pct": _success(solved, 10.0, 0.10) / count if count else np.nan,
        "over_limit": medians["rotation_error_deg"] / bound if bound > 0 else np.nan,
        "skipped": skipped,
    }
    return Summary(category, {"category": category, "method": method}, values)


def _success(solved: Cells, degrees: float, fraction: float) -> int:
    """Number of instances within an angle, and a fraction of diagonal and scales."""
    within = solved["sym_rotation_error_deg"].astype(float) <= degrees
    for name in ("sym_translation_error", "scale_y_error", "scale_z_error"):
        within &= solved[name].astype(float) <= fraction
    return int(within.sum())


_BARS = (metrics.ROTATION, metrics.TRANSLATION, metrics.SCALE_Y, metrics.SCALE_Z)
_CURVES = (metrics.SYM_ROTATION, metrics.SYM_TRANSLATION, metrics.SCALE_Y)


def draw_figures(run: Run, summaries: Sequence[Summary]) -> None:
    """Draw all figures of a run, PNG and PDF."""
    folder = run.folder.made_figures()
    for metric in _BARS:
        _draw_categories(folder / f"categories_{metric.key}", summaries, metric)
    for metric in _CURVES:
        _draw_curves(folder / f"within_{metric.key}", run, metric)


def _draw_categories(path: Path, summaries: Sequence[Summary], metric: Metric) -> None:
    """Draw a metric's medians, a column of points for each category."""
    categories = list(dict.fromkeys(summary.group for summary in summaries))
    places = np.arange(len(categories))
    with new_figure(figsize=(max(6.4, 0.62 * len(categories) + 2), 4.2)) as figure:
        axes = figure.add_subplot()
        for method in dict.fromkeys(summary.method for summary in summaries):
            look = look_of(method)
            found = {s.group: s[metric.key] for s in summaries if s.method == method}
            heights = metric.factor * np.array([found.get(name, np.nan) for name in categories])
            if look.marker:
                axes.plot(places, heights, look.marker, color=look.color, label=look.label)
            else:  # the Cramer-Rao bound: a floor beneath each category
                axes.hlines(
                    heights,
                    places - 0.35,
                    places + 0.35,
                    color=look.color,
                    linestyle=look.dash,
                    lw=1.4,
                    label=look.label,
                )
        axes.set_yscale("log")
        label_log_axis(axes)
        axes.set_xticks(range(len(categories)), categories)
        axes.tick_params(axis="x", labelrotation=45 if len(categories) > 7 else 0)
        axes.grid(visible=False, axis="x")
        axes.set_ylabel(f"median {in_math(metric.axis)}")
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
        save_figure(figure, path)


def _draw_curves(path: Path, run: Run, metric: Metric) -> None:
    """Draw the share of instances within an error, for each method."""
    cells = run.cells
    errors = metric.factor * cells[metric.key].astype(float)
    with new_figure(figsize=(6.4, 4.2)) as figure:
        axes = figure.add_subplot()
        for method in run.methods:
            chosen = (cells["method"] == method) & (cells["status"] != SKIPPED)
            values: FloatArray = np.sort(errors[chosen & (cells["status"] == OK)])
            share = 100 * np.arange(1, len(values) + 1) / max(int(chosen.sum()), 1)
            look = look_of(method)
            axes.plot(values, share, color=look.color, linestyle=look.dash, label=look.label)
        axes.set_xlim(0, metric.limit)
        axes.set_ylim(0, 100)
        axes.set_xlabel(in_math(metric.axis))
        axes.set_ylabel("instances with at most this error [%]")
        axes.legend(loc="lower right")
        save_figure(figure, path)


# A chunk is three files: with few instances in each, large runs spend their time on files.
_CHUNK, _CHUNK_DRAWN, _LARGE_CHUNK = 64, 8, 256
_LARGE = 5_000  # views


def plan(options: KeypointNetOptions, folder: RunFolder) -> Plan[KeypointTask]:
    """Plan a run over the views of a dataset's models."""
    dataset = KeypointNet(options.root, shapenet_root=options.shapenet).subset(
        categories=options.categories, split=options.split
    )
    tasks = KeypointTasks(dataset, options)
    drawn = options.render == "overlay"
    if drawn:
        _check_drawable(dataset, options)
    shapes = NO_SHAPES
    of_shapes: dict[str, Any] = {}
    if options.shape is not None:
        shapes = ShapeFiles.find(options.shape, dataset.categories)
        of_shapes = {"shape": str(options.shape.absolute()), "shapes": shapes.fingerprint()}
    pictures = folder.made_for_pictures() if drawn else None
    benchmark = keypointnet_benchmark(options, pictures, shapes)
    given = {name: value for name, value in options.as_config().items() if name != "shape"}
    config = {
        **given,
        **of_shapes,
        "experiment": options.experiment,
        "root": str(options.root.absolute()),
        "annotations": tasks.fingerprint(),
        **benchmark.config,
    }
    large = _CHUNK if len(tasks) < _LARGE else _LARGE_CHUNK
    return Plan(benchmark, tasks, config, _CHUNK_DRAWN if drawn else large)


def _check_drawable(dataset: KeypointNet, options: KeypointNetOptions) -> None:
    """Refuse overlays, before the run, where there is no mesh to draw."""
    if options.visibility == "hull":
        raise InputError(
            "visibility hull uses no meshes, so that there is nothing to draw",
            where="render",
            fix="choose auto or rays, or draw nothing",
        )
    if not dataset.subset(with_mesh=True).ids():
        raise InputError(
            "none of the models has a mesh, so that there is nothing to draw",
            where="render",
            fix="name ShapeNet's folder by shapenet, or draw nothing",
        )


def describe(run: Run) -> str:
    """Numbers of views, models and categories, the dataset and the noise."""
    views, models = run.count("category", "model_id", "view"), run.count("category", "model_id")
    categories = run.count("category")
    view_words = "" if views == models else f"{views:,} views of "
    model_words = "1 model" if models == 1 else f"{models:,} models"
    category_words = "1 category" if categories == 1 else f"{categories:,} categories"
    noise = f"{run.noise_px or 0:g} px of noise"
    return f"on {view_words}{model_words} in {category_words} of {run.dataset}, {noise}"


def reference(runs: Sequence[Run], groups: set[str]) -> Reference:
    """The paper's numbers on the same categories; all of them are about 1 px of noise."""
    if 1.0 not in {run.noise_px for run in runs}:
        return Reference((), "")
    stated = tuple(line for line in paper_lines() if line.group in groups)
    return Reference(stated, f"{PERCENT_NOTE} Its models and views are others." if stated else "")


ON_INSTANCES: dict[str, Any] = {
    "columns": HEADLINE,
    "results": REQUIRED_COLUMNS,
    "summarize": summarize,
    "lines": lines,
    "table": console_table,
    "metrics": (*INSTANCE_METRICS, *UP_TO_SCALE),
    "kind": lambda run: "views of models",
    "title": partial(on_datasets, "alignment"),
    "describe": describe,
    "about": (
        "Each picture shows a model as it is; methods get its visible keypoints, with noise, and "
        "the model stretched by unknown factors along y and z. Green is the truth, red the "
        "prediction."
    ),
    "note": (
        "Medians over the instances that did not fail; the rates count failures, and not "
        "the instances that were skipped, since no view shows enough of their keypoints. The "
        "symmetry-aware error (sym.) takes rotations that map a model onto itself for right. A "
        "rate counts instances whose symmetry-aware rotation, translation in diagonals of the "
        "model and both scales are that good."
    ),
    "reference": reference,
}
"""Members of the specification of every experiment on views of models."""

SPEC = Spec(options=KeypointNetOptions, plan=plan, write_more=draw_figures, **ON_INSTANCES)
