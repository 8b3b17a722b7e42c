"""The KeypointNet experiment: methods on views of annotated models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from cadalign.arrays import BoolArray
from cadalign.datasets import KeypointNet
from cadalign.errors import InputError
from cadalign.evaluation import metrics
from cadalign.evaluation.benchmark import VIEW_NAMES
from cadalign.evaluation.methods import LIMIT
from cadalign.evaluation.metrics import INSTANCE_METRICS
from cadalign.evaluation.options import ViewOptions
from cadalign.evaluation.plots import cumulative_curves
from cadalign.evaluation.registry import Reference, Spec
from cadalign.evaluation.runs.work import Columns, Plan
from cadalign.evaluation.summary import Group, Summary, mean, medians, share, summarize

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
    split: str | None = None
    """The dataset's split to take, such as test; all models by default."""
    min_visible: int = 6
    """Least number of keypoints that a view must show; of several views, the first."""
    methods: tuple[str, ...] = ("optimal", "aepnp", "aepnp-paper", "epnp", "limit")
    """Methods of `cadalign fit`, optimal-huber, optimal-cauchy, ransac-optimal, ransac-ap4p,
    ransac-aepnp, and limit: the Cramer-Rao bound."""
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
_COUNTS = (metrics.INSTANCES, metrics.FAILED, metrics.SKIPPED)


def _success(degrees: float, fraction: float) -> Callable[[Group], float]:
    def is_within(solved: Cells) -> BoolArray:
        within: BoolArray = solved["sym_rotation_error_deg"].astype(float) <= degrees
        for key in ("sym_translation_error", "scale_y_error", "scale_z_error"):
            within &= solved[key].astype(float) <= fraction
        return within

    return share(is_within)


_STATISTICS = {
    "keypoints": mean("keypoints"),
    **medians(*(metric for metric in INSTANCE_METRICS if metric is not metrics.RMS)),
    "success_5deg_5pct": _success(5.0, 0.05),
    "success_10deg_10pct": _success(10.0, 0.10),
}


def summarize_views(run: Run) -> list[Summary]:
    """A summary for every category and method; the errors over those of the bound besides."""
    found = summarize(run, _STATISTICS)
    key = metrics.ROTATION.key
    bounds = {each.group: each[key] for each in found if each.method == LIMIT}
    ratios = [each[key] / (bounds.get(each.group, 0) or np.nan) for each in found]
    return [
        replace(each, values=each.values | {"over_limit": ratio})
        for each, ratio in zip(found, ratios, strict=True)
    ]


_CURVES = tuple(
    (metric, np.linspace(0, metric.limit / metric.factor, 41))
    for metric in (metrics.SYM_ROTATION, metrics.SYM_TRANSLATION, metrics.SCALE_Y)
)


# A chunk is three files: with few instances in each, large runs spend their time on files.
_CHUNK, _CHUNK_DRAWN, _LARGE_CHUNK = 64, 8, 256
_LARGE = 5_000  # views


def plan(options: KeypointNetOptions, folder: RunFolder) -> Plan[KeypointTask]:
    """Plan a run over the views of a dataset's models."""
    from cadalign.evaluation.instances.views import KeypointTasks, keypointnet_benchmark

    dataset = KeypointNet(options.root, shapenet_root=options.shapenet).subset(
        categories=options.categories, split=options.split
    )
    tasks = KeypointTasks(dataset, options)
    drawn = options.render == "overlay"
    if drawn:
        _check_drawable(dataset, options)
    benchmark = keypointnet_benchmark(options, folder.made_for_pictures() if drawn else None)
    chunk = _CHUNK_DRAWN if drawn else _CHUNK if len(tasks) < _LARGE else _LARGE_CHUNK
    return benchmark.plan(options, tasks, chunk=chunk, annotations=tasks.fingerprint())


def _check_drawable(dataset: KeypointNet, options: KeypointNetOptions) -> None:
    """Refuse overlays, before the run, where there is no mesh to draw."""
    if options.visibility == "hull" or not dataset.subset(with_mesh=True).ids():
        raise InputError(
            "no mesh of the models is used, so that there is nothing to draw",
            where="render",
            fix="name ShapeNet's folder by shapenet, leave out visibility hull, or draw nothing",
        )


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
        *(*_COUNTS, *TABLE, metrics.TRANSLATION_UP_TO_SCALE, metrics.SYM_ROTATION),
        *(metrics.SUCCESS_5, metrics.SUCCESS_10, metrics.OVER_BOUND),
    ),
    "results": COLUMNS,
    "summarize": summarize_views,
    "console": (*_COUNTS, *TABLE, metrics.SYM_ROTATION, metrics.SUCCESS_5),
    "console_note": "t in model diagonals; * rotations that map a model onto itself are no errors",
    "metrics": INSTANCE_METRICS,
    "kind": lambda run: "views of models",
    "topic": "alignment",
    "subject": "views of models",
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

SPEC = Spec(
    options=KeypointNetOptions,
    plan=plan,
    plots=partial(cumulative_curves, curves=_CURVES, of="of views"),
    **ON_INSTANCES,
)
