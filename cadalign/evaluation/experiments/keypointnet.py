"""Experiment on views of KeypointNet's annotated models."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from cadalign.arrays import BoolArray
from cadalign.datasets import KeypointNet
from cadalign.errors import DataError, InputError
from cadalign.evaluation import metrics
from cadalign.evaluation.benchmark import (
    VIEW_NAMES,
    Benchmark,
    Case,
    Pair,
    Setting,
    attempt,
    write_picture,
)
from cadalign.evaluation.instances.instance import (
    Instance,
    KeypointTask,
    make_hull_instances,
    make_instance,
    scene_of,
)
from cadalign.evaluation.instances.record import RECORD_COLUMNS, record_of
from cadalign.evaluation.methods import LIMIT, Method, MethodInput, pose_of
from cadalign.evaluation.metrics import INSTANCE_METRICS
from cadalign.evaluation.metrics.errors import estimate_errors
from cadalign.evaluation.options import ViewOptions
from cadalign.evaluation.plots import cumulative_curves
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import Columns, Outcome, Plan, Row, fingerprint_of_files
from cadalign.evaluation.summary import Summary, mean, medians, share, summarize

if TYPE_CHECKING:
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Cells, Run


@dataclass(frozen=True)
class KeypointNetOptions(ViewOptions):
    """Evaluate methods on views of KeypointNet's models.

    Each view shows the original model. Methods get its visible keypoints with noise, and the model
    stretched by random factors from 0.5 to 2 along y and z. The run's folder gets results.parquet
    with a row per model, view and method, summary.csv, figures, report.html and, with --render
    overlay, pictures. An interrupted run continues when the same command is started again.
    """

    experiment = "keypointnet"

    _: KW_ONLY
    split: str | None = None
    """Split of the dataset, such as test; all models by default."""
    min_visible: int = 6
    """Minimum number of visible keypoints per view; random views are drawn until one has them."""
    methods: tuple[str, ...] = ("optimal", "aepnp", "aepnp-paper", "epnp", "limit")
    """Methods of `cadalign fit`; optimal-huber, optimal-cauchy (robust losses); ransac-optimal,
    ransac-ap4p, ransac-aepnp, ransac-aepnp-refined (RANSAC); limit (the Cramer-Rao bound); or
    functions, as module:function."""
    visibility: Literal["auto", "hull"] = "auto"
    """How visible keypoints are found. auto: by casting rays at the mesh, or as with hull for
    models without a mesh. hull: from the convex hull of the keypoints."""
    render: Literal["none", "overlay"] = "none"
    """overlay: draw the first method's result for every model with a mesh; none: no pictures."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_methods()
        self.check_least(min_visible=1)
        self.check_known(visibility=("auto", "hull"), render=("none", "overlay"))


COLUMNS: Columns = (
    *(*VIEW_NAMES, ("status", str), ("reason", str), ("visibility", str), ("keypoints", int)),
    *((name, float) for name in ("stretch_y", "stretch_z", "rotation_error_deg")),
    *((name, float) for name in ("translation_error", "scale_y_error", "scale_z_error")),
    *(("box_iou", float), ("rms_px", float), ("symmetry", str)),
    *(("sym_rotation_error_deg", float), ("sym_translation_error", float)),
    *(("sym_box_iou", float), ("translation_error_up_to_scale", float)),
)
"""Columns of the result table; see docs/formats/runs.md."""

logger = logging.getLogger("cadalign")

KeypointView = tuple[KeypointTask, Instance]
"""An instance of the benchmark: a task and the view of its model."""


class KeypointTasks(Sequence[KeypointTask]):
    """All views of all models of a dataset, sorted by name and made on demand.

    ``options`` have ``visibility``, ``views_per_model`` and ``max_models``.
    """

    def __init__(self, dataset: KeypointNet, options: Any) -> None:
        self.dataset, self._views = dataset, int(options.views_per_model)
        self.keys = [
            key
            for category in dataset.categories
            for key in sorted(dataset.ids(category))[: options.max_models]
        ]
        if not self.keys:
            raise DataError("there are no models to evaluate", where=str(dataset.root))
        self._first = lru_cache(maxsize=4)(
            lambda key: KeypointTask.from_model(dataset, *key, hull=options.visibility == "hull")
        )

    def __len__(self) -> int:
        return len(self.keys) * self._views

    def __getitem__(self, index: Any) -> Any:
        places = range(len(self))[index]
        return list(map(self._task, places)) if isinstance(places, range) else self._task(places)

    def _task(self, index: int) -> KeypointTask:
        place, view = divmod(index, self._views)
        first = self._first(self.keys[place])
        return first if view == 0 else replace(first, view=view)

    def fingerprint(self) -> str:
        """Hash of the annotations, so that a run cannot continue with others."""
        return fingerprint_of_files(self.dataset.files)


@dataclass(frozen=True)
class KeypointViews(Setting):
    """Instances of the experiment: views of annotated models.

    If ``drawn_in`` is given, its folders for pictures must exist; they get a picture of the first
    method's alignment for every instance with a mesh.
    """

    columns = COLUMNS
    record_columns = RECORD_COLUMNS

    options: KeypointNetOptions
    drawn_in: RunFolder | None

    def cases(self, tasks: Sequence[KeypointTask]) -> list[Case]:
        return [
            replace(self.failed_case(task), error=instance)
            if isinstance(instance, Exception)
            else self._case(task, instance)
            for task, instance in zip(tasks, self.instances(tasks), strict=True)
        ]

    def _case(self, task: KeypointTask, instance: Instance) -> Case:
        _, stretch_y, stretch_z = (1 / instance.gt.scale).tolist()
        facts = {
            "visibility": instance.visibility,
            "keypoints": len(instance.points_3d),
            "stretch_y": stretch_y,
            "stretch_z": stretch_z,
            "symmetry": str(task.symmetry),
        }
        return Case(task.names, facts, (task, instance))

    def failed_case(self, task: KeypointTask) -> Case:
        return Case(task.names, {} if task.problem else {"symmetry": str(task.symmetry)})

    def instances(self, tasks: Sequence[KeypointTask]) -> list[Instance | Exception]:
        """The view of each task's model, or an error."""
        names = ("noise_px", "min_visible", "seed")
        how = {name: getattr(self.options, name) for name in names}
        plain = [task for task in tasks if not task.problem and task.model is None]
        of_hulls = iter(make_hull_instances(plain, **how))

        def made(task: KeypointTask) -> Instance | Exception:
            if task.problem:
                return DataError(task.problem)
            return (
                next(of_hulls) if task.model is None else attempt(partial(_mesh_view, task, **how))
            )

        return list(map(made, tasks))

    def method_input(self, view: KeypointView) -> MethodInput:
        _, found = view
        keypoints = found.points_3d, found.points_2d, found.camera
        return MethodInput(*keypoints, self.options.sigma, bounds=found.bounds, gt=found.gt)

    def measure(self, method: Method, pairs: Sequence[Pair]) -> list[Row | Exception]:
        poses = [pose_of(estimate) for _, estimate in pairs]
        tasks, instances = zip(*(view for view, _ in pairs), strict=True)
        return [*estimate_errors(poses, instances, [task.symmetry for task in tasks])]

    def finish(self, case: Case, outcomes: list[Outcome], estimates: list[Any]) -> str:
        _, instance = case.instance
        if self.drawn_in is not None and outcomes[0].is_ok and instance.scene is not None:
            problem = attempt(_draw, self.drawn_in, case.instance, pose_of(estimates[0]))
            if problem is not None:
                logger.warning("%s: not drawn: %s", case.names["model_id"], problem)
        names = ("camera", "gt", "bounds", "points_3d", "points_2d", "ids")
        parts = {name: getattr(instance, name) for name in names}
        return record_of(outcomes, estimates, **parts)


def _draw(folder: RunFolder, view: KeypointView, estimate: Any) -> None:
    # Imported here: runs without meshes must not load the renderer.
    from cadalign.evaluation.instances.pictures import draw_instance

    task, instance = view
    write_picture(draw_instance, folder, instance, estimate, *task.names.values())


def _mesh_view(task: KeypointTask, **how: Any) -> Instance:
    assert task.model is not None
    return make_instance(task.model, scene=scene_of(task.model), view_index=task.view, **how)


def keypointnet_benchmark(
    options: KeypointNetOptions, drawn_in: RunFolder | None = None
) -> Benchmark:
    """The benchmark of the chosen methods on views of models."""
    setting = KeypointViews(options, drawn_in)
    found = Benchmark.from_methods(setting, options.methods, metrics=options.metrics)
    batched = frozenset(each.name for each in found.methods if not each.has_statistics)
    return replace(found, batched=batched)


# Summary ------------------------------------------------------------------------------------------

TABLE = (
    *(metrics.KEYPOINTS, metrics.ROTATION, metrics.TRANSLATION),
    *(metrics.SCALE_Y, metrics.SCALE_Z, metrics.BOX_IOU),
)
"""Columns of medians, not symmetry-aware."""
_COUNTS = (metrics.INSTANCES, metrics.FAILED, metrics.SKIPPED)


def _is_success(solved: Cells) -> BoolArray:
    """Mask (n,) of rows within 5 degrees and 5 %, up to the model's symmetry."""
    within: BoolArray = solved["sym_rotation_error_deg"].astype(float) <= 5.0
    for key in ("sym_translation_error", "scale_y_error", "scale_z_error"):
        within &= solved[key].astype(float) <= 0.05
    return within


_STATISTICS = {
    "keypoints": mean("keypoints"),
    **medians(*(metric for metric in INSTANCE_METRICS if metric is not metrics.RMS)),
    "success_5deg_5pct": share(_is_success),
}


def summarize_views(run: Run) -> list[Summary]:
    """One summary per category and method, with the ratio of the rotation error to the bound's."""
    found = summarize(run, _STATISTICS)
    key = metrics.ROTATION.key
    bounds = {each.group: each[key] for each in found if each.method == LIMIT}
    ratios = [each[key] / (bounds.get(each.group, 0) or np.nan) for each in found]
    return [
        replace(each, values=each.values | {"over_limit": ratio})
        for each, ratio in zip(found, ratios, strict=True)
    ]


_CURVES = (
    (metrics.SYM_ROTATION, np.linspace(0, 20.0, 41)),
    (metrics.SYM_TRANSLATION, np.linspace(0, 0.2, 41)),
    (metrics.SCALE_Y, np.linspace(0, 0.2, 41)),
)


# Every chunk is written to files, so small chunks slow large runs. The last number is in views.
_CHUNK, _CHUNK_DRAWN, _LARGE_CHUNK, _LARGE = 64, 8, 256, 5_000


def plan(options: KeypointNetOptions, folder: RunFolder) -> Plan[KeypointTask]:
    """Plan a run over the views of a dataset's models."""
    dataset = KeypointNet(options.root, shapenet_root=options.shapenet).subset(
        categories=options.categories, split=options.split
    )
    tasks = KeypointTasks(dataset, options)
    drawn = options.render == "overlay"
    meshes = set(dataset.subset(with_mesh=True).ids()) if drawn else set()
    if drawn and (options.visibility == "hull" or meshes.isdisjoint(tasks.keys)):
        raise InputError(
            f"no mesh of the {len(tasks.keys)} models is used, so there is nothing to draw",
            where="render",
            fix="give ShapeNet's folder (shapenet), leave out visibility hull, or render none",
        )
    benchmark = keypointnet_benchmark(options, folder.made_for_pictures() if drawn else None)
    chunk = _CHUNK_DRAWN if drawn else _CHUNK if len(tasks) < _LARGE else _LARGE_CHUNK
    return benchmark.plan(options, tasks, chunk=chunk, annotations=tasks.fingerprint())


SPEC = Spec(
    options=KeypointNetOptions,
    plan=plan,
    plots=partial(cumulative_curves, curves=_CURVES, of="of views"),
    columns=(
        *(*_COUNTS, *TABLE, metrics.TRANSLATION_UP_TO_SCALE, metrics.SYM_ROTATION),
        *(metrics.SUCCESS_5, metrics.OVER_BOUND),
    ),
    results=COLUMNS,
    summarize=summarize_views,
    console=(*_COUNTS, *TABLE, metrics.SYM_ROTATION, metrics.SUCCESS_5),
    console_note="t in model diagonals; * up to the symmetry of the model",
    metrics=INSTANCE_METRICS,
    kind=lambda run: "views of models",
    topic="alignment",
    subject="views of models",
    about=(
        "Each picture shows the original model. Methods get its visible keypoints with noise, and "
        "the model stretched by unknown factors along y and z. Green is the truth, red the "
        "estimate."
    ),
    note=(
        "Medians over the instances that did not fail. Rates include failures, but not skipped "
        "instances, of which no view shows enough keypoints. Symmetry-aware errors (sym.) are "
        "relative to the nearest pose that looks like the true one. The rate within 5 deg, 5 % "
        "counts instances with a symmetry-aware rotation error of at most 5 degrees, a "
        "symmetry-aware translation error of at most 5 % of the model's diagonal, and scale errors "
        "of at most 5 %."
    ),
)
