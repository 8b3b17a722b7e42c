"""Errors of methods on views of annotated models.

Columns of the result table, one row per view and method: what names the row (``category``,
``model_id``, ``view``, ``method``), ``status`` and ``reason``, and then

visibility
    Rule by which keypoints count as seen, ``rays`` or ``hull``; empty if it failed before.
keypoints
    Number of keypoints that the method was given.
stretch_y, stretch_z
    Factors that the model was stretched by; the true scales are one over these.
rotation_error_deg
    [degrees]
translation_error
    [diagonals of the model's bounding box]
translation_error_up_to_scale
    The same after the estimate was scaled about the camera centre, of which one image does not tell
    the distance; empty in earlier runs.
scale_y_error, scale_z_error
    Relative errors, fractions.
box_iou
    Of the stretched model's true and predicted box; empty for a model without volume.
rms_px
    Of the residuals [px].
symmetry
    The model's: ``none``, ``circle``, or the number of rotations that map it onto itself.
sym_rotation_error_deg, sym_translation_error, sym_box_iou
    The same errors from the nearest truth that looks the same; see
    `cadalign.evaluation.instances.symmetry`. Errors of the scale do not depend on it.
box_iou_up_to_scale
    Of runs with learned shapes only: after the estimate was scaled about the camera centre.

The metrics of failed rows are empty. Rows of instances that no view shows enough keypoints of have
the status ``skipped``; they count in no share and no median.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from cadalign.datasets import AnnotatedModel
from cadalign.errors import DataError
from cadalign.estimation.result import Result
from cadalign.evaluation.benchmark import VIEW_NAMES, Benchmark, Case, Pair, Setting
from cadalign.evaluation.instances.aligned import AlignedShape, align_instance
from cadalign.evaluation.instances.hull import KeypointHull
from cadalign.evaluation.instances.instance import (
    Instance,
    load_scene,
    make_hull_instances,
    make_instance,
)
from cadalign.evaluation.instances.record import RECORD_COLUMNS, pose_of, record_row
from cadalign.evaluation.instances.symmetry import InstanceSymmetry
from cadalign.evaluation.keypointnet.options import KeypointNetOptions
from cadalign.evaluation.keypointnet.tasks import KeypointTask
from cadalign.evaluation.methods.fitted import SHAPE
from cadalign.evaluation.methods.method import Method, MethodInput
from cadalign.evaluation.methods.registry import choose_methods
from cadalign.evaluation.metrics.errors import POSE_ERRORS, estimate_errors, overlap_up_to_scale
from cadalign.evaluation.metrics.registry import Compared, choose_metrics
from cadalign.evaluation.metrics.table import BOX_IOU_UP_TO_SCALE
from cadalign.evaluation.outcome import FAILED, Outcome, reason_of
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Columns, Row
from cadalign.evaluation.runs.work import AbortError
from cadalign.evaluation.shape_files import NO_SHAPES, ShapeFiles
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box

COLUMNS: Columns = (
    *VIEW_NAMES,
    *(("status", str), ("reason", str), ("visibility", str), ("keypoints", int)),
    *((name, float) for name in ("stretch_y", "stretch_z", "rotation_error_deg")),
    *((name, float) for name in ("translation_error", "scale_y_error", "scale_z_error")),
    *(("box_iou", float), ("rms_px", float), ("symmetry", str)),
    *((f"sym_{name}", float) for name in POSE_ERRORS),
    ("translation_error_up_to_scale", float),
)
"""Columns of every run."""
REQUIRED_COLUMNS: Columns = COLUMNS[:-1]
"""Those that all runs have; earlier ones lack the last."""


@dataclass(frozen=True, eq=False)
class KeypointView:
    """A view of a model as an instance: its task, what it shows, and the shapes that are known."""

    task: KeypointTask
    instance: Instance
    sigma: float
    shapes: ShapeFiles


@dataclass(frozen=True)
class KeypointViews(Setting):
    """Views of annotated models: the setting of the KeypointNet experiment.

    The first method's alignment of every instance with a mesh is drawn in the folder ``drawn_in``,
    if one is given; its folders for pictures must exist.
    """

    names = VIEW_NAMES
    record_columns = RECORD_COLUMNS

    options: KeypointNetOptions
    drawn_in: RunFolder | None
    shapes: ShapeFiles = NO_SHAPES

    @property
    def columns(self) -> Columns:
        """The columns of the result table."""
        return (*COLUMNS, (BOX_IOU_UP_TO_SCALE.key, float)) if self.shapes.paths else COLUMNS

    def warm_up(self) -> Sequence[KeypointTask]:
        """A task whose evaluation compiles solvers and metrics."""
        rng = np.random.default_rng(0)
        return [
            KeypointTask(
                category="warm-up",
                model_id="",
                view=0,
                hull=KeypointHull(rng.uniform(-0.3, 0.3, (12, 3))),
                semantic_ids=np.arange(12),
                symmetry=InstanceSymmetry(np.zeros(3), np.eye(3)[None]),
                model=None,
            )
        ]

    def cases(self, tasks: Sequence[KeypointTask]) -> list[Case]:
        """The instance of every task, or why there is none."""
        sigma = self.options.noise_px or 1.0
        start, found = time.perf_counter(), []
        instances = self._instances(tasks)
        share = (time.perf_counter() - start) / max(len(tasks), 1)
        for task, instance in zip(tasks, instances, strict=True):
            (case,) = self.failed(task)
            if isinstance(instance, Exception):
                found.append(replace(case, error=instance, seconds=share))
            else:
                view = KeypointView(task, instance, sigma, self.shapes)
                found.append(Case(case.names, _facts(task, instance), view, without=case.without))
        return found

    def failed(self, task: KeypointTask) -> list[Case]:
        """The case of a task without an instance."""
        facts = {"visibility": "", "symmetry": "" if task.problem else str(task.symmetry)}
        has_shape = task.category in dict(self.shapes.paths)
        return [Case(task.names, facts, without=() if has_shape else (SHAPE,))]

    def _instances(self, tasks: Sequence[KeypointTask]) -> list[Instance | Exception]:
        names = ("noise_px", "min_visible", "seed")
        how = {name: getattr(self.options, name) for name in names}
        plain = [task for task in tasks if not task.problem and task.model is None]
        of_hulls = iter(make_hull_instances(plain, **how))
        instances: list[Instance | Exception] = []
        for task in tasks:
            if task.problem:
                instances.append(DataError(task.problem))
            elif task.model is None:
                instances.append(next(of_hulls))
            else:
                instances.append(_with_mesh(task, task.model, **how))
        return instances

    def given(self, view: KeypointView) -> MethodInput:
        """The visible keypoints of the stretched model."""
        found = view.instance
        return MethodInput(
            found.points_3d,
            found.points_2d,
            found.camera,
            view.sigma,
            bounds=found.bounds,
            gt=found.gt,
        )

    def compared(self, view: KeypointView, estimate: Alignment | Result | AlignedShape) -> Compared:
        """The estimated and the true alignment."""
        result = estimate if isinstance(estimate, Result) else None
        return Compared(pose_of(estimate), view.instance.gt, result)

    def measure(self, method: Method, pairs: Sequence[Pair]) -> list[Row | Exception]:
        """Metrics by column of each estimate."""
        rows: list[Row | Exception] = [
            *estimate_errors(
                [pose_of(estimate) for _, estimate in pairs],
                [view.instance for view, _ in pairs],
                [view.task.symmetry for view, _ in pairs],
            )
        ]
        for (view, estimate), row in zip(pairs, rows, strict=True):
            if isinstance(row, Exception):
                continue
            if isinstance(estimate, AlignedShape):
                row["rms_px"] = estimate.rms
            if self.shapes.paths:  # it takes longer than most methods
                box = Box.from_model(view.instance.bounds, pose_of(estimate))
                overlap = overlap_up_to_scale(est=box, gt=view.instance.gt_box)
                row[BOX_IOU_UP_TO_SCALE.key] = overlap
        return rows

    def finish(
        self, case: Case, outcomes: list[Outcome], estimates: list[Any]
    ) -> tuple[list[Outcome], Row | None]:
        """Draw the first method's estimate; a failure is one of its row."""
        view: KeypointView = case.instance
        first = outcomes[0]
        if self.drawn_in is not None and first.is_ok:
            problem = _draw(self.drawn_in, view, pose_of(estimates[0]))
            if problem is not None:
                failed = replace(first, status=FAILED, reason=reason_of(problem), values=case.facts)
                outcomes = [failed, *outcomes[1:]]
        return outcomes, record_row(view.instance, outcomes, estimates)


def keypointnet_benchmark(
    options: KeypointNetOptions, drawn_in: RunFolder | None = None, shapes: ShapeFiles = NO_SHAPES
) -> Benchmark:
    """The methods of the options on views of models, and that of learned shapes where there are."""
    methods = choose_methods(options.methods)
    batched = frozenset(each.name for each in methods if not each.has_statistics)
    if shapes.paths:
        methods = (*methods, Method(SHAPE, _aligned))
    setting = KeypointViews(options, drawn_in, shapes)
    metrics = choose_metrics(options.metrics, setting.columns)
    return Benchmark(setting, methods, batched, metrics=metrics)


def _aligned(view: KeypointView) -> AlignedShape:
    """The estimate from the learned shape of the model's category."""
    task = view.task
    shape = view.shapes.shape(task.category)
    assert shape is not None
    own = task.semantic_ids, task.hull.xyz
    return align_instance(shape, view.instance, *own, sigma=view.sigma)


def _draw(folder: RunFolder, view: KeypointView, estimate: Alignment) -> Exception | None:
    """Draw an estimate; the reason if that fails."""
    from cadalign.evaluation.instances.drawing import draw_instance

    if view.instance.scene is None:
        return None
    task = view.task
    names = {"category": task.category, "model_id": task.model_id}
    try:
        draw_instance(folder, view.instance, estimate, view=task.view, **names)
    except (OSError, DataError) as error:
        raise AbortError(
            f"the overlay cannot be written: {error}",
            fix="free some space, and start the same command again: the run goes on",
        ) from None
    except Exception as error:
        return error
    return None


# Views of one model come one after another.
_scene_of = lru_cache(maxsize=1)(load_scene)


def _with_mesh(task: KeypointTask, model: AnnotatedModel, **how: Any) -> Instance | Exception:
    """The instance of a model with a mesh, or why there is none."""
    try:
        return make_instance(model, scene=_scene_of(model), view_index=task.view, **how)
    except Exception as error:
        return error


def _facts(task: KeypointTask, instance: Instance) -> Row:
    """Columns that do not depend on the estimate."""
    _, stretch_y, stretch_z = (1 / instance.gt.scale).tolist()
    return {
        "visibility": instance.visibility,
        "keypoints": len(instance.points_3d),
        "stretch_y": stretch_y,
        "stretch_z": stretch_z,
        "symmetry": str(task.symmetry),
    }
