"""The experiment on unseen objects, which are no stretched copy of any model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from cadalign.datasets import KeypointNet
from cadalign.errors import InputError
from cadalign.evaluation import metrics
from cadalign.evaluation.benchmark import VIEW_NAMES
from cadalign.evaluation.methods import LIMIT, SHAPE
from cadalign.evaluation.options import (
    FunctionOptions,
    ModelOptions,
    NoiseOption,
    SplitOptions,
)
from cadalign.evaluation.plots import Plot, Trace, cumulative_curves
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import Columns, Plan
from cadalign.evaluation.summary import (
    ConsoleTable,
    Summary,
    by_category_and_method,
    known,
    mean,
    median,
    milliseconds,
    percentile,
)

if TYPE_CHECKING:
    from cadalign.evaluation.instances.instance import KeypointTask
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Cells, Run

METHODS = (
    *("random-rigid", "random-stretched", "nearest", "mean-rigid", "mean-stretched"),
    *(SHAPE, "exact", LIMIT),
)


@dataclass(frozen=True)
class UnseenOptions(ModelOptions, SplitOptions, NoiseOption, FunctionOptions):
    """Evaluate alignment to objects that are no stretched copy of any model.

    Objects of one split of KeypointNet are aligned with models of the other split, by
    category: another model, the nearest one of a library, the mean shape, or the learned shape
    model; and, for comparison, with the object's own model. The run's folder gets results.parquet
    with a row per object, view and method, summary.csv, figures, report.html and the learned
    shapes. A killed run continues when the same command is started again.
    """

    experiment = "unseen"
    visibility: ClassVar[str] = "hull"

    _: KW_ONLY
    noise_px: float = 2.0
    """Standard deviation of the keypoints' noise, in pixels."""
    keypoints: int | None = None
    """Number of keypoints that are given, drawn at random; all by default."""
    outliers: float = 0.0
    """Share of the given keypoints that are moved to anywhere in the image; methods then search
    for those that agree."""
    views_per_model: int = 1
    """Number of views of each object."""
    meshes: bool = False
    """Keep small copies of the objects' meshes, which the report shows warped to the estimates."""
    methods: tuple[str, ...] = METHODS
    """random-rigid, random-stretched: a random model of the category; nearest: the best of the
    library; mean-rigid, mean-stretched: the category's mean; shape: its shape model; exact: the
    object's own model, stretched; limit: the Cramer-Rao bound of the latter."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(keypoints=1, views_per_model=1)
        if not 0 <= self.outliers < 1:
            raise InputError(f"{self.outliers} is not a share below 1", where="outliers")
        self.check_methods(METHODS)


COLUMNS: Columns = (
    *(*VIEW_NAMES, ("status", str), ("reason", str), ("keypoints", int)),
    *(("rotation_error_deg", float), ("best_rotation_error_deg", float)),
    *(("translation_error", float), ("translation_error_up_to_scale", float), ("box_iou", float)),
    *(("box_iou_up_to_scale", float), ("stated_box_iou_up_to_scale", float)),
    ("keypoint_error", float),
    *(("rotation_level", float), ("stretch_level", float)),
    *(("keypoints_within_68", float), ("keypoints_within_95", float)),
)
"""Columns of the result table; see docs/formats/runs.md."""
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
HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.KEYPOINTS, metrics.ROTATION, metrics.ROTATION_90),
    *(*_MEDIANS[1:], *_COVERAGE, metrics.QUERY_MILLISECONDS),
)


def _within(level: str, nominal: float) -> Callable[[Cells], float]:
    """Share of the known levels that are at most the nominal one; NaN of none."""

    def share(cells: Cells) -> float:
        found = known(cells[level])
        return float((found <= nominal).mean()) if len(found) else np.nan

    return share


_STATISTICS = {
    "keypoints": mean("keypoints"),
    **{metric.key: median(metric.key) for metric in _MEDIANS},
    "rotation_error_deg_90": percentile("rotation_error_deg", 90),
    **{
        f"{name}_in_{percent}": _within(f"{name}_level", percent / 100)
        for name in ("rotation", "stretch")
        for percent in (68, 95)
    },
    **{name: mean(name) for name in ("keypoints_within_68", "keypoints_within_95")},
    "milliseconds": milliseconds,
}


def console_table(run: Run, summaries: Sequence[Summary]) -> ConsoleTable:
    """The summaries for the console."""
    shown = (
        *(metrics.INSTANCES, metrics.FAILED),
        *(replace(metrics.ROTATION, digits=2), replace(metrics.ROTATION_90, digits=1)),
        *(replace(metrics.TRANSLATION_UP_TO_SCALE, digits=3), metrics.BOX_IOU_UP_TO_SCALE),
        *(replace(metrics.KEYPOINT_ERROR, digits=3), *_COVERAGE, metrics.QUERY_MILLISECONDS),
        *run.metrics,
    )
    return ConsoleTable.of(
        "Medians per category and method, and truths within stated regions",
        summaries,
        shown,
        note="lengths in model diagonals; scaled: about the camera centre",
        narrow=True,
        wraps=True,
    )


_CURVES = (
    (metrics.ROTATION, np.array([0.5, 1, 2, 3, 5, 7.5, 10, 15, 20, 30])),
    (replace(metrics.BOX_IOU_UP_TO_SCALE, log=False), np.arange(0, 1.01, 0.1)),
)
_LEVELS = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.68, 0.8, 0.9, 0.95, 0.99])
_CALIBRATED = (("rotation_level", "rotation"), ("stretch_level", "stretch"))


def plots(runs: Sequence[Run]) -> list[Plot]:
    """Shares of objects within an error, and of truths within stated regions, by method."""
    curves = cumulative_curves(runs, curves=_CURVES, of="of unseen objects")
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
        note="over all categories; uncertainties are right where both are equal",
        title=f"Calibration of the {name}",
    )


_CHUNK = 8


def plan(options: UnseenOptions, folder: RunFolder) -> Plan[KeypointTask]:
    """Plan a run over a split's objects; the folder gets what is learned from the other split."""
    from cadalign.evaluation.instances.unseen import UnseenTasks, unseen_benchmark
    from cadalign.evaluation.shape_files import learn

    dataset = KeypointNet(options.root, shapenet_root=options.shapenet)
    tasks = UnseenTasks(dataset, options)
    learned = learn(dataset, tasks.categories, split=options.train, folder=folder)
    hashes = {"annotations": tasks.fingerprint(), "learned": learned.fingerprint()}
    benchmark = unseen_benchmark(learned, options, folder if options.meshes else None)
    return benchmark.plan(options, tasks, chunk=_CHUNK, **hashes)


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
    summarize=lambda run: by_category_and_method(run, _STATISTICS),
    table=console_table,
    plots=plots,
    topic="unseen objects",
    describe=_describe,
    metrics=_MEDIANS,
    about=(
        "Green is the object with the box of its keypoints, red what a method found: the object "
        "warped to the estimated keypoints, and their box."
    ),
    note=(
        "Medians over the objects that did not fail; lengths in diagonals of the object. Up to "
        "scale: the estimate is scaled about the camera centre first, since one image leaves "
        "an object's size open. Within 68 % and 95 %: how often the truth lies in the regions of "
        "these probabilities that a method states; the uncertainties are right where the two agree."
    ),
)
