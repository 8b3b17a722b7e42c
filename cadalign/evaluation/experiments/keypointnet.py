"""The KeypointNet experiment: methods on views of annotated models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from cadalign.datasets import KeypointNet
from cadalign.errors import InputError
from cadalign.evaluation import metrics
from cadalign.evaluation.benchmark import VIEW_NAMES
from cadalign.evaluation.methods import LIMIT
from cadalign.evaluation.metrics import INSTANCE_METRICS, UP_TO_SCALE, Metric
from cadalign.evaluation.options import ViewOptions
from cadalign.evaluation.plots import in_math, label_log_axis, look_of, new_figure, save_figure
from cadalign.evaluation.registry import Reference, Spec
from cadalign.evaluation.runs.work import OK, SKIPPED, Columns, Plan
from cadalign.evaluation.summary import (
    ALL,
    ConsoleTable,
    Summary,
    counted,
    mean_of,
    median_of,
    summaries_of,
)

if TYPE_CHECKING:
    from cadalign.evaluation.instances.instance import KeypointTask
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Cells, Run


@dataclass(frozen=True)
class KeypointNetOptions(ViewOptions):
    """Evaluate methods on views of KeypointNet's models.

    Each view shows a model as it is; methods get its visible keypoints, with noise, and the model
    stretched by factors from 0.5 to 2 along y and z. The run's folder gets results.parquet with a
    row per model, view and method, summary.csv, figures, report.html and, if asked for, overlays.
    A killed run continues when the same command is started again.
    """

    experiment = "keypointnet"

    _: KW_ONLY
    methods: tuple[str, ...] = ("optimal", "aepnp", "aepnp-paper", "epnp", "limit")
    """Methods of `cadalign fit`, optimal-huber, optimal-cauchy, ransac-optimal, ransac-ap4p,
    ransac-aepnp, and limit: the Cramer-Rao bound."""
    shape: Path | None = None
    """File of `cadalign shape learn`, or a folder of such files: adds the method shape, which
    aligns the learned shape of the category and knows nothing of the model; and errors up to scale,
    since one image does not determine the object's size."""
    visibility: Literal["auto", "rays", "hull"] = "auto"
    """Keypoints are seen that rays cast at the mesh reach, or by a rule on the hull of the
    keypoints; auto takes rays where there is a mesh."""
    render: Literal["none", "overlay"] = "none"
    """Draw the first method's result for every model with a mesh, or nothing."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_methods()
        self.check_least(min_visible=1)
        self.check_known(visibility=("auto", "rays", "hull"), render=("none", "overlay"))


POSE_ERRORS = ("rotation_error_deg", "translation_error", "box_iou")
"""Errors that the symmetries of a model bear on."""
COLUMNS: Columns = (
    *VIEW_NAMES,
    *(("status", str), ("reason", str), ("visibility", str), ("keypoints", int)),
    *((name, float) for name in ("stretch_y", "stretch_z", "rotation_error_deg")),
    *((name, float) for name in ("translation_error", "scale_y_error", "scale_z_error")),
    *(("box_iou", float), ("rms_px", float), ("symmetry", str)),
    *((f"sym_{name}", float) for name in POSE_ERRORS),
    ("translation_error_up_to_scale", float),
)
"""Columns of every run; see docs/formats/runs.md."""
TABLE = (
    *(metrics.KEYPOINTS, metrics.ROTATION, metrics.TRANSLATION),
    *(metrics.SCALE_Y, metrics.SCALE_Z, metrics.BOX_IOU),
)
"""Columns of the plain medians."""
_MEDIANS = (*(metric for metric in INSTANCE_METRICS if metric is not metrics.RMS), *UP_TO_SCALE)
_COUNTS = (metrics.INSTANCES, metrics.FAILED, metrics.SKIPPED)


def summarize(run: Run) -> list[Summary]:
    """A summary for every category and method, and for all categories together."""
    return summaries_of(run.cells, run.methods, summarize_method, further=run.metrics, single=True)


def summarize_method(category: str, method: str, cells: Cells) -> Summary:
    """A summary of a method's rows, among those of all methods."""
    counts, skipped, solved = counted(cells, method)
    bound = median_of(counted(cells, LIMIT)[2]["rotation_error_deg"])
    medians = {each.key: median_of(solved[each.key]) for each in _MEDIANS if each.key in solved}
    values = {
        **counts,
        "keypoints": mean_of(solved["keypoints"]),
        **medians,
        "success_5deg_5pct": _success(solved, 5.0, 0.05, count=counts["instances"]),
        "success_10deg_10pct": _success(solved, 10.0, 0.10, count=counts["instances"]),
        "over_limit": medians["rotation_error_deg"] / bound if bound > 0 else np.nan,
        "skipped": skipped,
    }
    return Summary(category, {"category": category, "method": method}, values)


def _success(solved: Cells, degrees: float, fraction: float, *, count: int) -> float:
    within = solved["sym_rotation_error_deg"].astype(float) <= degrees
    for name in ("sym_translation_error", "scale_y_error", "scale_z_error"):
        within &= solved[name].astype(float) <= fraction
    return int(within.sum()) / count if count else np.nan


def lines(summaries: Sequence[Summary]) -> list[Summary]:
    """Lines of the headline table; a single category needs no line for all."""
    single = len({summary.group for summary in summaries}) == 2
    return [summary for summary in summaries if summary.group != ALL or not single]


def console_table(run: Run, summaries: Sequence[Summary]) -> ConsoleTable:
    """The summaries for the console."""
    # The table must not be wider.
    is_up_to_scale = metrics.BOX_IOU_UP_TO_SCALE.key in run.cells
    rest = UP_TO_SCALE if is_up_to_scale else (metrics.SYM_ROTATION, metrics.SUCCESS_5)
    told = [each for each in _COUNTS if metrics.told(each, [s[each.key] for s in summaries])]
    return ConsoleTable.of(
        "Medians per category and method; success over all instances",
        summaries,
        (*told, *TABLE, *rest, *run.metrics),
        note="t in model diagonals; scaled about the camera centre: one image leaves the size open"
        if is_up_to_scale
        else "t in model diagonals; * rotations that map a model onto itself are no errors",
    )


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
    cells = run.cells
    errors = metric.factor * cells[metric.key].astype(float)
    with new_figure(figsize=(6.4, 4.2)) as figure:
        axes = figure.add_subplot()
        for method in run.methods:
            chosen = (cells["method"] == method) & (cells["status"] != SKIPPED)
            values = np.sort(errors[chosen & (cells["status"] == OK)])
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
    from cadalign.evaluation.instances.views import KeypointTasks, keypointnet_benchmark
    from cadalign.evaluation.shape_files import NO_SHAPES, ShapeFiles

    dataset = KeypointNet(options.root, shapenet_root=options.shapenet).subset(
        categories=options.categories, split=options.split
    )
    tasks = KeypointTasks(dataset, options)
    drawn = options.render == "overlay"
    if drawn:
        _check_drawable(dataset, options)
    shapes, more = NO_SHAPES, {}
    if options.shape is not None:
        shapes = ShapeFiles.find(options.shape, dataset.categories)
        more = {"shapes": shapes.fingerprint()}
    benchmark = keypointnet_benchmark(
        options, folder.made_for_pictures() if drawn else None, shapes
    )
    chunk = _CHUNK_DRAWN if drawn else _CHUNK if len(tasks) < _LARGE else _LARGE_CHUNK
    return benchmark.plan(options, tasks, chunk=chunk, annotations=tasks.fingerprint(), **more)


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


# The AEPnP paper's Table 1 as printed: 1 px noise, medians [degrees, model units], mean keypoints.
# It prints the scale errors under "%"; by the numbers in its own source they are fractions.
PAPER_TABLE = {
    "chair": (0.998, 0.004, 0.008, 0.012, 7),
    "bottle": (7.004, 0.100, 0.089, 0.107, 7),
    "car": (1.599, 0.011, 0.029, 0.011, 10),
    "vessel": (4.592, 0.046, 0.063, 0.041, 7),
}
"""Rotation error, translation error, errors of s_y and s_z, number of keypoints."""
STATED = "AEPnP, stated in the paper"
PERCENT_NOTE = (
    'The paper\'s columns s1 and s2 are headed "%", but by the numbers in its own source they are '
    "fractions: 0.008 means 0.8 %. They are shown here as such, times 100."
)


def reference(runs: Sequence[Run], groups: set[str]) -> Reference:
    """The paper's numbers on the same categories; all of them are about 1 px of noise."""
    if 1.0 not in {run.noise_px for run in runs}:
        return (), ""
    keys = (*(metric.key for metric in TABLE[1:5]), metrics.KEYPOINTS.key)
    stated = tuple(
        Summary(name, {"category": name, "method": STATED}, dict(zip(keys, row, strict=True)))
        for name, row in PAPER_TABLE.items()
        if name in groups
    )
    return stated, f"{PERCENT_NOTE} Its models and views are others." if stated else ""


ON_INSTANCES: dict[str, Any] = {
    "columns": (
        *(*_COUNTS, *TABLE, *UP_TO_SCALE, metrics.SYM_ROTATION),
        *(metrics.SUCCESS_5, metrics.SUCCESS_10, metrics.OVER_BOUND),
    ),
    "results": COLUMNS[:-1],  # earlier runs lack the last
    "summarize": summarize,
    "lines": lines,
    "table": console_table,
    "metrics": (*INSTANCE_METRICS, *UP_TO_SCALE),
    "kind": lambda run: "views of models",
    "topic": "alignment",
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
