"""Views of annotated models: tasks, instances, errors and pictures of the experiment."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Protocol

import numpy as np

from cadalign.datasets import KeypointNet
from cadalign.errors import CadalignError, DataError
from cadalign.evaluation.benchmark import (
    VIEW_NAMES,
    Benchmark,
    Case,
    Pair,
    Setting,
    Tasks,
    attempt,
    write_picture,
)
from cadalign.evaluation.experiments.keypointnet import COLUMNS, KeypointNetOptions
from cadalign.evaluation.instances.hull import KeypointHull
from cadalign.evaluation.instances.instance import (
    Instance,
    KeypointTask,
    load_scene,
    make_hull_instances,
    make_instance,
    mesh_of,
)
from cadalign.evaluation.instances.record import (
    RECORD_COLUMNS,
    AlignedShape,
    align_instance,
    pose_of,
    record_row,
)
from cadalign.evaluation.methods.method import SHAPE, Method, MethodInput
from cadalign.evaluation.metrics.errors import estimate_errors, overlap_up_to_scale
from cadalign.evaluation.metrics.table import BOX_IOU_UP_TO_SCALE
from cadalign.evaluation.outcome import FAILED, Outcome, reason_of
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Columns, Row
from cadalign.evaluation.runs.work import fingerprint
from cadalign.evaluation.shape_files import NO_SHAPES, ShapeFiles
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box


class TaskOptions(Protocol):
    """Options that say which tasks there are."""

    @property
    def visibility(self) -> str: ...

    @property
    def views_per_model(self) -> int: ...

    @property
    def max_models(self) -> int | None: ...


class KeypointTasks(Tasks[KeypointTask]):
    """All views of all models of a dataset in the order of their names."""

    def __init__(self, dataset: KeypointNet, options: TaskOptions) -> None:
        self.dataset, self._visibility = dataset, options.visibility
        self._views = options.views_per_model
        self.keys = [
            key
            for category in dataset.categories
            for key in sorted(dataset.ids(category))[: options.max_models]
        ]
        if not self.keys:
            raise DataError("there are no models to evaluate", where=str(dataset.root))
        self._first = lru_cache(maxsize=4)(self._first_view)

    def __len__(self) -> int:
        return len(self.keys) * self._views

    def task(self, index: int) -> KeypointTask:
        """A view of a model."""
        place, view = divmod(index, self._views)
        first = self._first(place)
        return first if view == 0 else replace(first, view=view)

    def _first_view(self, place: int) -> KeypointTask:
        return KeypointTask.of_model(self.dataset, *self.keys[place], visibility=self._visibility)

    def fingerprint(self) -> str:
        """Hash of the annotations: a run must not go on with others."""
        parts: list[Any] = []
        for key in self.keys:
            parts.append("".join(f"{name}\0" for name in key))
            try:
                model = self.dataset[key]
            except CadalignError as error:
                parts.append(str(error))
                continue
            rotations = [rotation.keypoints for rotation in model.symmetries.rotations]
            parts += [model.keypoints.xyz, repr((model.symmetries.reflections, rotations))]
            parts.append("mesh" if mesh_of(model, self._visibility) else "")
        return fingerprint(*parts)


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
        hull = KeypointHull(rng.uniform(-0.3, 0.3, (12, 3)))
        return [KeypointTask("warm-up", "", hull=hull, ids=np.arange(12))]

    def cases(self, tasks: Sequence[KeypointTask]) -> list[Case]:
        start, found = time.perf_counter(), []
        instances = self._instances(tasks)
        share = (time.perf_counter() - start) / max(len(tasks), 1)
        for task, instance in zip(tasks, instances, strict=True):
            (case,) = self.failed(task)
            if isinstance(instance, Exception):
                found.append(replace(case, error=instance, seconds=share))
            else:
                view = KeypointView(task, instance, self.options.sigma, self.shapes)
                found.append(Case(case.names, _facts(task, instance), view, without=case.without))
        return found

    def failed(self, task: KeypointTask) -> list[Case]:
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
                instances.append(attempt(partial(_with_mesh, task, **how)))
        return instances

    def given(self, view: KeypointView) -> MethodInput:
        found = view.instance
        return MethodInput(
            found.points_3d,
            found.points_2d,
            found.camera,
            view.sigma,
            bounds=found.bounds,
            gt=found.gt,
        )

    def measure(self, method: Method, pairs: Sequence[Pair]) -> list[Row | Exception]:
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
        view: KeypointView = case.instance
        first = outcomes[0]
        if self.drawn_in is not None and first.is_ok:
            problem = attempt(_draw, self.drawn_in, view, pose_of(estimates[0]))
            if problem is not None:
                failed = replace(first, status=FAILED, reason=reason_of(problem), values=case.facts)
                outcomes = [failed, *outcomes[1:]]
        return outcomes, record_row(view.instance, outcomes, estimates)


def keypointnet_benchmark(
    options: KeypointNetOptions, drawn_in: RunFolder | None = None, shapes: ShapeFiles = NO_SHAPES
) -> Benchmark:
    """The methods of the options on views of models, and that of learned shapes where there are."""
    setting = KeypointViews(options, drawn_in, shapes)
    found = Benchmark.chosen(setting, options.methods, metrics=options.metrics)
    batched = frozenset(each.name for each in found.methods if not each.has_statistics)
    of_shapes = (Method(SHAPE, _aligned),) if shapes.paths else ()
    return replace(found, batched=batched, methods=(*found.methods, *of_shapes))


def _aligned(view: KeypointView) -> AlignedShape:
    """The estimate from the learned shape of the model's category."""
    task = view.task
    shape = view.shapes.shape(task.category)
    assert shape is not None
    own = task.ids, task.hull.xyz
    return align_instance(shape, view.instance, *own, sigma=view.sigma)


def _draw(folder: RunFolder, view: KeypointView, estimate: Alignment) -> None:
    # Only here: runs on annotations alone are not to load the renderer.
    from cadalign.evaluation.instances.pictures import draw_instance

    if view.instance.scene is not None:
        names = (view.task.category, view.task.model_id, view.task.view)
        write_picture(draw_instance, folder, view.instance, estimate, *names)


# Views of one model come one after another.
_scene_of = lru_cache(maxsize=1)(load_scene)


def _with_mesh(task: KeypointTask, **how: Any) -> Instance:
    """The instance of a model with a mesh."""
    assert task.model is not None
    return make_instance(task.model, scene=_scene_of(task.model), view_index=task.view, **how)


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
