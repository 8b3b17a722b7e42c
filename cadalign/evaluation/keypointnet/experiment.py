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
from cadalign.errors import CadalignError, DataError
from cadalign.estimation.fit import fit, fit_batch
from cadalign.estimation.result import Result
from cadalign.evaluation.accuracy.cramer_rao import limit_estimate
from cadalign.evaluation.accuracy.methods import LIMIT, SHAPE, fit_options, has_statistics
from cadalign.evaluation.instances.aligned import AlignedShape, align_instance
from cadalign.evaluation.instances.errors import POSE_ERRORS, estimate_errors
from cadalign.evaluation.instances.hull import KeypointHull
from cadalign.evaluation.instances.instance import (
    Instance,
    load_scene,
    make_hull_instances,
    make_instance,
)
from cadalign.evaluation.instances.record import RECORD_COLUMNS, Estimate, pose_of, record_row
from cadalign.evaluation.instances.symmetry import InstanceSymmetry
from cadalign.evaluation.keypointnet.options import KeypointNetOptions
from cadalign.evaluation.keypointnet.shapes import NO_SHAPES, ShapeFiles
from cadalign.evaluation.keypointnet.tasks import KeypointTask
from cadalign.evaluation.metrics import BOX_IOU_UP_TO_SCALE
from cadalign.evaluation.outcome import FAILED, Outcome, overlap_up_to_scale, reason_of
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Columns, Row
from cadalign.evaluation.runs.work import AbortError, Rows
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box

_NAMES: Columns = (("category", str), ("model_id", str), ("view", int), ("method", str))
COLUMNS: Columns = (
    *_NAMES,
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
_Usable = tuple[KeypointTask, Instance]


@dataclass(frozen=True)
class KeypointNetExperiment:
    """Evaluates methods on views of annotated models.

    The first method's alignment of every instance with a mesh is drawn in the folder ``drawn_in``,
    if one is given; its folders for pictures must exist.
    """

    # A method's share of the seconds that its chunk took.
    timing_columns = (*_NAMES, ("seconds", float))
    record_columns = RECORD_COLUMNS

    options: KeypointNetOptions
    drawn_in: RunFolder | None
    shapes: ShapeFiles = NO_SHAPES

    @property
    def columns(self) -> Columns:
        """The columns of the result table."""
        return (*COLUMNS, (BOX_IOU_UP_TO_SCALE.key, float)) if self.shapes.paths else COLUMNS

    def methods_for(self, category: str) -> tuple[str, ...]:
        """The methods for the models of a category, that of its learned shape the last."""
        known = category in dict(self.shapes.paths)
        return (*self.options.methods, SHAPE) if known else self.options.methods

    def warm_up(self) -> None:
        """Compile solvers and metrics."""
        rng = np.random.default_rng(0)
        task = KeypointTask(
            category="warm-up",
            model_id="",
            view=0,
            hull=KeypointHull(rng.uniform(-0.3, 0.3, (12, 3))),
            semantic_ids=np.arange(12),
            symmetry=InstanceSymmetry(np.zeros(3), np.eye(3)[None]),
            model=None,
        )
        self.evaluate([task])

    def evaluate(self, tasks: Sequence[KeypointTask]) -> Rows:
        """A row for every task and method, and a record for every instance."""
        start = time.perf_counter()
        instances = self._instances(tasks)
        # The first method's rows bear the time of making the instances.
        share = (time.perf_counter() - start) / len(tasks)
        answers_of: list[list[tuple[Outcome, Estimate]]] = [[] for _ in tasks]
        for method in (*self.options.methods, SHAPE):
            places = [
                k for k, task in enumerate(tasks) if method in self.methods_for(task.category)
            ]
            if not places:
                continue
            extra = share if method == self.options.methods[0] else 0.0
            chosen = [tasks[k] for k in places], [instances[k] for k in places]
            answers = self._evaluate_method(method, *chosen, extra=extra)
            for k, answer in zip(places, answers, strict=True):
                answers_of[k].append(answer)
        outcomes, records = [], []
        for instance, answers in zip(instances, answers_of, strict=True):
            found = [outcome for outcome, _ in answers]
            outcomes += found
            if isinstance(instance, Instance):
                records.append(record_row(instance, found, [estimate for _, estimate in answers]))
        return Rows.of(outcomes, records)

    def failure(self, task: KeypointTask, reason: str) -> Rows:
        """A failed row for every method."""
        known = _known(task)
        methods = self.methods_for(task.category)
        return Rows.of(Outcome.failure(reason, task.names(each), **known) for each in methods)

    def _instances(self, tasks: Sequence[KeypointTask]) -> list[Instance | Exception]:
        """The instance of every task, or why there is none."""
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

    def _evaluate_method(
        self,
        method: str,
        tasks: Sequence[KeypointTask],
        instances: Sequence[Instance | Exception],
        *,
        extra: float,
    ) -> list[tuple[Outcome, Estimate]]:
        """One method's outcome, and the estimate it is of, for every task.

        ``extra`` is the time [s] that each has taken before.
        """
        start = time.perf_counter()
        usable = [
            (task, instance)
            for task, instance in zip(tasks, instances, strict=True)
            if isinstance(instance, Instance)
        ]
        if method == SHAPE:
            estimates = [self._aligned(*pair) for pair in usable]
        else:
            estimates = self._estimates(method, [instance for _, instance in usable])
        drawn = self.drawn_in is not None and method == self.options.methods[0]
        answers = iter(zip(self._results(usable, estimates, drawn=drawn), estimates, strict=True))
        seconds = (time.perf_counter() - start) / max(len(usable), 1) + extra
        outcomes: list[tuple[Outcome, Estimate]] = []
        for task, instance in zip(tasks, instances, strict=True):
            names = task.names(method)
            if isinstance(instance, Exception):
                outcome = Outcome.without_instance(instance, names, **_known(task))
                outcome = replace(outcome, seconds=extra or None)
                outcomes.append((outcome, DataError(outcome.reason)))
                continue
            result, estimate = next(answers)
            facts = _facts(task, instance)
            if isinstance(result, Exception):
                outcome = Outcome(names, facts, FAILED, reason_of(result), seconds)
            else:
                outcome = Outcome(names, facts | result, seconds=seconds)
            outcomes.append((outcome, estimate))
        return outcomes

    def _estimates(self, method: str, instances: Sequence[Instance]) -> list[Estimate]:
        """A method's estimate of every instance."""
        if method == LIMIT or has_statistics(method):
            return [self._estimate(method, instance) for instance in instances]
        if not instances:
            return []
        batch = fit_batch(
            [instance.points_3d for instance in instances],
            [instance.points_2d for instance in instances],
            [instance.camera for instance in instances],
            **fit_options(method, sigma=self.options.noise_px or 1.0, ransac=None),
        )
        return [batch.errors.get(b) or batch.alignment(b) for b in range(len(batch))]

    def _estimate(self, method: str, instance: Instance) -> Estimate:
        """The estimate of the bound, or of a method that tells more than an alignment."""
        given = instance.points_3d, instance.points_2d, instance.camera
        try:
            if method == LIMIT:
                return limit_estimate(*given, instance.gt)
            noise = self.options.noise_px or 1.0
            return fit(*given, **fit_options(method, sigma=noise, ransac=None))
        except CadalignError as error:
            return error

    def _aligned(self, task: KeypointTask, instance: Instance) -> Estimate:
        """The estimate from the learned shape of the model's category."""
        shape = self.shapes.shape(task.category)
        assert shape is not None
        sigma = self.options.noise_px or 1.0
        try:
            own = task.semantic_ids, task.hull.xyz
            return align_instance(shape, instance, *own, sigma=sigma)
        except CadalignError as error:
            return error

    def _results(
        self, usable: Sequence[_Usable], estimates: Sequence[Estimate], *, drawn: bool
    ) -> list[Row | Exception]:
        """Metrics by column of each estimate, or why there are none; pictures, if ``drawn``."""
        results: dict[int, Row | Exception] = {}
        found: dict[int, Result | AlignedShape | Alignment] = {}
        for k, ((task, instance), estimate) in enumerate(zip(usable, estimates, strict=True)):
            if isinstance(estimate, CadalignError):
                results[k] = estimate
            elif drawn and (problem := self._draw(task, instance, pose_of(estimate))):
                results[k] = problem
            else:
                found[k] = estimate
        rows = estimate_errors(
            [pose_of(estimate) for estimate in found.values()],
            [usable[k][1] for k in found],
            [usable[k][0].symmetry for k in found],
        )
        for (k, estimate), row in zip(found.items(), rows, strict=True):
            results[k] = row
            if isinstance(row, Exception):
                continue
            if isinstance(estimate, AlignedShape):
                row["rms_px"] = estimate.rms
            if self.shapes.paths:  # it takes longer than most methods
                row[BOX_IOU_UP_TO_SCALE.key] = _overlap_up_to_scale(usable[k][1], estimate)
        return [results[k] for k in range(len(usable))]

    def _draw(
        self, task: KeypointTask, instance: Instance, estimate: Alignment
    ) -> Exception | None:
        """Draw an estimate; the reason if that fails."""
        from cadalign.evaluation.instances.drawing import draw_instance

        if self.drawn_in is None or instance.scene is None:
            return None
        names = {"category": task.category, "model_id": task.model_id}
        try:
            draw_instance(self.drawn_in, instance, estimate, view=task.view, **names)
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


def _overlap_up_to_scale(
    instance: Instance, estimate: Result | AlignedShape | Alignment
) -> float | None:
    box = Box.from_model(instance.bounds, pose_of(estimate))
    return overlap_up_to_scale(est=box, gt=instance.gt_box)


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


def _known(task: KeypointTask) -> Row:
    """The facts where there is no instance."""
    return {"visibility": "", "symmetry": "" if task.problem else str(task.symmetry)}
