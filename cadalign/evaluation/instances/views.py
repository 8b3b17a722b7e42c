"""Views of annotated models: tasks, instances, errors and pictures of the experiment."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

from cadalign.datasets import KeypointNet
from cadalign.errors import DataError
from cadalign.evaluation.benchmark import (
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
    scene_of,
)
from cadalign.evaluation.instances.record import (
    RECORD_COLUMNS,
    pose_of,
    record_of,
)
from cadalign.evaluation.methods import Method, MethodInput
from cadalign.evaluation.metrics.errors import estimate_errors
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.work import Outcome, Row, fingerprint_of_files

logger = logging.getLogger("cadalign")

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
        return fingerprint_of_files(self.dataset.files)


@dataclass(frozen=True)
class KeypointViews(Setting):
    """Views of annotated models: the setting of the KeypointNet experiment.

    The first method's alignment of every instance with a mesh is drawn in the folder ``drawn_in``,
    if one is given; its folders for pictures must exist.
    """

    columns = COLUMNS
    record_columns = RECORD_COLUMNS

    options: KeypointNetOptions
    drawn_in: RunFolder | None

    def cases(self, tasks: Sequence[KeypointTask]) -> list[Case]:
        return [
            replace(self.failed(task)[0], error=instance)
            if isinstance(instance, Exception)
            else self._case(task, instance)
            for task, instance in zip(tasks, self._instances(tasks), strict=True)
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

    def failed(self, task: KeypointTask) -> list[Case]:
        facts = {"visibility": "", "symmetry": "" if task.problem else str(task.symmetry)}
        return [Case(task.names, facts)]

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


def keypointnet_benchmark(
    options: KeypointNetOptions, drawn_in: RunFolder | None = None
) -> Benchmark:
    """The methods of the options on views of models."""
    found = Benchmark.chosen(
        KeypointViews(options, drawn_in), options.methods, metrics=options.metrics
    )
    batched = frozenset(each.name for each in found.methods if not each.has_statistics)
    return replace(found, batched=batched)


def _draw(folder: RunFolder, view: KeypointView, estimate: Any) -> None:
    # Only here: runs on annotations alone are not to load the renderer.
    from cadalign.evaluation.instances.pictures import draw_instance

    task, instance = view
    write_picture(draw_instance, folder, instance, estimate, *task.names.values())


def _with_mesh(task: KeypointTask, **how: Any) -> Instance:
    assert task.model is not None
    return make_instance(task.model, scene=scene_of(task.model), view_index=task.view, **how)
