"""Views of annotated models: tasks, instances, errors and pictures of the experiment."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from cadalign.datasets import KeypointNet
from cadalign.errors import CadalignError, DataError
from cadalign.estimation.view import View
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
from cadalign.evaluation.instances.instance import (
    Instance,
    KeypointTask,
    make_hull_instances,
    make_instance,
    mesh_of,
    scene_of,
)
from cadalign.evaluation.instances.record import (
    RECORD_COLUMNS,
    AlignedShape,
    aligned_shape,
    pose_of,
    record_of,
)
from cadalign.evaluation.methods import SHAPE, Method, MethodInput
from cadalign.evaluation.metrics import BOX_IOU_UP_TO_SCALE
from cadalign.evaluation.metrics.errors import estimate_errors, overlap_up_to_scale
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.work import FAILED, Columns, Outcome, Row, fingerprint, reason_of
from cadalign.evaluation.shape_files import NO_SHAPES, ShapeFiles
from cadalign.geometry.alignment import Box

KeypointView = tuple[KeypointTask, Instance]
"""A view of a model as an instance of the benchmark: its task, and what it shows."""


class KeypointTasks(Tasks[KeypointTask]):
    """All views of all models of a dataset in the order of their names.

    ``options`` are an experiment's, with ``visibility``, ``views_per_model`` and ``max_models``.
    """

    def __init__(self, dataset: KeypointNet, options: Any) -> None:
        self.dataset, self._visibility = dataset, options.visibility
        self._views: int = options.views_per_model
        self.keys = [
            key
            for category in dataset.categories
            for key in sorted(dataset.ids(category))[: options.max_models]
        ]
        if not self.keys:
            raise DataError("there are no models to evaluate", where=str(dataset.root))
        self._first = lru_cache(maxsize=4)(
            lambda key: KeypointTask.of_model(dataset, *key, visibility=options.visibility)
        )

    def __len__(self) -> int:
        return len(self.keys) * self._views

    def task(self, index: int) -> KeypointTask:
        """A view of a model."""
        place, view = divmod(index, self._views)
        first = self._first(self.keys[place])
        return first if view == 0 else replace(first, view=view)

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

    def cases(self, tasks: Sequence[KeypointTask]) -> list[Case]:
        start = time.perf_counter()
        instances = self._instances(tasks)
        share = (time.perf_counter() - start) / max(len(tasks), 1)
        return [
            replace(self.failed(task)[0], error=instance, seconds=share)
            if isinstance(instance, Exception)
            else self._case(task, instance)
            for task, instance in zip(tasks, instances, strict=True)
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
        return Case(task.names, facts, (task, instance), without=self._without(task))

    def failed(self, task: KeypointTask) -> list[Case]:
        facts = {"visibility": "", "symmetry": "" if task.problem else str(task.symmetry)}
        return [Case(task.names, facts, without=self._without(task))]

    def _without(self, task: KeypointTask) -> tuple[str, ...]:
        return () if task.category in dict(self.shapes.paths) else (SHAPE,)

    def _instances(self, tasks: Sequence[KeypointTask]) -> list[Instance | Exception]:
        how = self.options.drawn
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
        _, found = view
        keypoints = found.points_3d, found.points_2d, found.camera
        return MethodInput(*keypoints, self.options.sigma, bounds=found.bounds, gt=found.gt)

    def measure(self, method: Method, pairs: Sequence[Pair]) -> list[Row | Exception]:
        poses = [pose_of(estimate) for _, estimate in pairs]
        tasks, instances = zip(*(view for view, _ in pairs), strict=True)
        symmetries = [task.symmetry for task in tasks]
        rows: list[Row | Exception] = [*estimate_errors(poses, instances, symmetries)]
        for (_, estimate), instance, pose, row in zip(pairs, instances, poses, rows, strict=True):
            if isinstance(row, Exception):
                continue
            if isinstance(estimate, AlignedShape):
                row["rms_px"] = estimate.rms
            if self.shapes.paths:  # it takes longer than most methods
                box = Box.from_model(instance.bounds, pose)
                row[BOX_IOU_UP_TO_SCALE.key] = overlap_up_to_scale(est=box, gt=instance.gt_box)
        return rows

    def finish(
        self, case: Case, outcomes: list[Outcome], estimates: list[Any]
    ) -> tuple[list[Outcome], Row | None]:
        _, instance = case.instance
        first = outcomes[0]
        if self.drawn_in is not None and first.is_ok and instance.scene is not None:
            problem = attempt(_draw, self.drawn_in, case.instance, pose_of(estimates[0]))
            if problem is not None:
                failed = replace(first, status=FAILED, reason=reason_of(problem), values=case.facts)
                outcomes = [failed, *outcomes[1:]]
        names = ("camera", "gt", "bounds", "points_3d", "points_2d", "ids")
        parts = {name: getattr(instance, name) for name in names}
        return outcomes, record_of(outcomes, estimates, **parts)


def keypointnet_benchmark(
    options: KeypointNetOptions, drawn_in: RunFolder | None = None, shapes: ShapeFiles = NO_SHAPES
) -> Benchmark:
    """The methods of the options on views of models, and that of learned shapes where there are."""
    setting = KeypointViews(options, drawn_in, shapes)
    found = Benchmark.chosen(setting, options.methods, metrics=options.metrics)
    batched = frozenset(each.name for each in found.methods if not each.has_statistics)
    aligned = partial(_aligned, shapes=shapes, sigma=options.sigma)
    of_shapes = (Method(SHAPE, aligned),) if shapes.paths else ()
    return replace(found, batched=batched, methods=(*found.methods, *of_shapes))


def _aligned(view: KeypointView, *, shapes: ShapeFiles, sigma: float) -> AlignedShape:
    """The estimate from the learned shape of the model's category, of the keypoints that it has."""
    # Only here: its kernels take time to import, and most runs do without.
    from cadalign.estimation.align import align

    task, instance = view
    shape = shapes.shape(task.category)
    known = np.isin(instance.ids, shape.ids)
    ids, pixels = instance.ids[known].tolist(), instance.points_2d[known]
    result = align(shape, View(instance.camera, pixels, ids=ids, sigma=sigma))
    shared = np.isin(task.ids, shape.ids)
    rows = shape.rows(task.ids[shared].tolist())
    return aligned_shape(
        result,
        rows,
        task.hull.xyz[shared] / instance.gt.scale,
        # Outliers included, as of the other methods.
        rms=float(np.sqrt((result.residuals**2).sum(axis=1).mean())),
        sigma=sigma,
        model_bounds=instance.bounds,
        spans_points=instance.scene is None and len(rows) > 0,
    )


def _draw(folder: RunFolder, view: KeypointView, estimate: Any) -> None:
    # Only here: runs on annotations alone are not to load the renderer.
    from cadalign.evaluation.instances.pictures import draw_instance

    task, instance = view
    write_picture(draw_instance, folder, instance, estimate, *task.names.values())


def _with_mesh(task: KeypointTask, **how: Any) -> Instance:
    assert task.model is not None
    return make_instance(task.model, scene=scene_of(task.model), view_index=task.view, **how)
