"""The experiment on evidence beyond keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from cadalign.datasets import KeypointNet
from cadalign.errors import InputError
from cadalign.evaluation.benchmark import VIEW_NAMES
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.options import ViewOptions
from cadalign.evaluation.plots import cumulative_curves
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import Columns, Plan
from cadalign.evaluation.summary import (
    ConsoleTable,
    Summary,
    by_category_and_method,
    mean,
    median,
    milliseconds,
)

if TYPE_CHECKING:
    from cadalign.evaluation.instances.instance import KeypointTask
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Run

KEYPOINTS = "keypoints"
MASK, DEPTH, GRAVITY, LENGTH, IMAGE = "mask", "depth", "gravity", "length", "image"
MASK_ALONE = "mask-alone"
VIEWS_FREE = {"views-2-free": 2, "views-5-free": 5}
VIEWS_KNOWN = {"views-2": 2, "views-5": 5}
DAMAGED = {
    f"mask-{name}": name for name in ("dilated", "eroded", "smoothed", "hidden", "hole", "blob")
}
COMBINED = {
    "gravity+length": (GRAVITY, LENGTH),
    "mask+gravity": (MASK, GRAVITY),
    "mask+depth": (MASK, DEPTH),
    "mask+views-2": (MASK, "views-2"),
    "all": (MASK, DEPTH, GRAVITY, LENGTH, "views-2"),
}
METHODS = (
    *(KEYPOINTS, GRAVITY, LENGTH, DEPTH, *VIEWS_FREE, *VIEWS_KNOWN, MASK, *DAMAGED, *COMBINED),
    *(IMAGE, MASK_ALONE),
)
_ON_DEMAND = {*DAMAGED, IMAGE, MASK_ALONE} - {"mask-dilated"}
_DEFAULT = tuple(name for name in METHODS if name not in _ON_DEMAND)


@dataclass(frozen=True)
class EvidenceRunOptions(ViewOptions):
    """Evaluate what masks, further views, depth, gravity and lengths add to keypoints.

    Each view shows a model with a mesh as it is; methods get its visible keypoints with noise, the
    model stretched by factors from 0.5 to 2 along y and z, and one kind of evidence or several.
    Every error is compared with the Cramer-Rao bound of its own instance. The run's folder gets
    results.parquet with a row per view and method, summary.csv, figures and report.html. A killed
    run continues when the same command is started again.
    """

    experiment = "evidence"
    visibility: ClassVar[str] = "rays"

    _: KW_ONLY
    depth_sigma: float = 0.005
    """Relative noise of the depths."""
    up_sigma_deg: float = 1.0
    """Noise of the upward direction about each axis across it, in degrees."""
    length_sigma: float = 0.01
    """Relative noise of the height."""
    turn_deg: float = 25.0
    """Angle about the object between neighbouring cameras, in degrees."""
    methods: tuple[str, ...] = _DEFAULT
    """keypoints: these alone; gravity, length (the height), depth (of the keypoints), mask (of the
    first view): these and one kind of evidence; views-2, views-5: two and five views with known
    camera motion, views-2-free, views-5-free with unknown motion; mask-dilated, mask-eroded (by 2
    px), mask-smoothed (at random, 2 px), mask-hidden (a quarter), mask-hole, mask-blob: damaged
    masks; gravity+length, mask+gravity, mask+depth, mask+views-2, all; image: the photo itself, the
    object drawn before a random texture; mask-alone: the mask without any keypoint."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(min_visible=4)
        for name in ("depth_sigma", "up_sigma_deg", "length_sigma", "turn_deg"):
            value = getattr(self, name)
            if not 0 < value < 90:
                raise InputError(f"{value} is not between 0 and 90", where=name)
        self.check_methods(METHODS)


_ERRORS = ("rotation_error_deg", "translation_error", "scale_y_error", "scale_z_error")
BOUNDS = ("rotation_bound_deg", "translation_bound", "scale_y_bound", "scale_z_bound")
COLUMNS: Columns = (
    *(*VIEW_NAMES, ("status", str), ("reason", str), ("keypoints", int)),
    *((name, float) for name in (*_ERRORS, "box_iou", *BOUNDS, "over_limit")),
    ("warnings", int),
)
"""Columns of the result table; see docs/formats/runs.md."""
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
_STATISTICS = {
    "keypoints": mean("keypoints"),
    **{metric.key: median(metric.key) for metric in _MEDIANS},
    "milliseconds": milliseconds,
}


def console_table(run: Run, summaries: Sequence[Summary]) -> ConsoleTable:
    """The summaries for the console."""
    shown = (
        *(metrics.INSTANCES, metrics.FAILED, metrics.ROTATION),
        *(replace(metrics.TRANSLATION, digits=4), metrics.SCALE_Y, metrics.SCALE_Z),
        *(metrics.BOX_IOU, ROTATION_BOUND, replace(metrics.OVER_BOUND, symbol="R/bound")),
        metrics.QUERY_MILLISECONDS,
        *run.metrics,
    )
    return ConsoleTable.of(
        "Medians per category and evidence",
        summaries,
        shown,
        labels=("category", "evidence"),
        note="t in diagonals of the object; R/bound: median ratio to the instance's own bound",
        narrow=True,
        wraps=True,
    )


_CURVES = (
    (metrics.ROTATION, np.array([0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1, 1.5, 2, 3, 5, 10])),
    (replace(metrics.BOX_IOU, log=False), np.arange(0, 1.01, 0.05)),
)

plots = partial(cumulative_curves, curves=_CURVES, of="by evidence")
"""Shares of objects within an error, as `Spec.plots`."""


_CHUNK = 2


def plan(options: EvidenceRunOptions, folder: RunFolder) -> Plan[KeypointTask]:
    """Plan a run over the views of a dataset's models that have meshes."""
    from cadalign.evaluation.instances.evidence import evidence_benchmark
    from cadalign.evaluation.instances.views import KeypointTasks

    dataset = KeypointNet(options.root, shapenet_root=options.shapenet).subset(
        categories=options.categories, split=options.split, with_mesh=True
    )
    tasks = KeypointTasks(dataset, options)
    benchmark = evidence_benchmark(options)
    return benchmark.plan(options, tasks, chunk=_CHUNK, annotations=tasks.fingerprint())


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
    summarize=lambda run: by_category_and_method(run, _STATISTICS, count_skipped=True),
    table=console_table,
    plots=plots,
    topic="evidence beyond keypoints",
    describe=_describe,
    note=(
        "Medians over the views that did not fail; lengths in diagonals of the object. Each method "
        "is given keypoints and the evidence that it is named after. The bound is the median "
        "rotation error of an ideal estimator, from the Cramer-Rao bound of each instance; the "
        "ratio to it is taken instance by instance."
    ),
)
