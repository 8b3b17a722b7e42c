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
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from cadalign.errors import CadalignError, DataError
from cadalign.evaluation.accuracy.cramer_rao import limit_estimate
from cadalign.evaluation.accuracy.methods import LIMIT, SHAPE, fit_options, has_statistics
from cadalign.evaluation.instances.aligned import AlignedShape, align_instance
from cadalign.evaluation.instances.hull import KeypointHull
from cadalign.evaluation.instances.instance import (
    Instance,
    load_scene,
    make_hull_instance,
    make_instance,
)
from cadalign.evaluation.instances.record import RECORD_COLUMNS, Estimate, pose_of, record_row
from cadalign.evaluation.instances.symmetry import SymmetryGroup
from cadalign.evaluation.keypointnet.options import KeypointNetOptions
from cadalign.evaluation.keypointnet.shapes import NO_SHAPES, ShapeFiles
from cadalign.evaluation.keypointnet.tasks import KeypointTask
from cadalign.evaluation.metrics import BOX_IOU_UP_TO_SCALE
from cadalign.evaluation.outcome import (
    Outcome,
    alignment_errors,
    overlap,
    overlap_up_to_scale,
    reason_of,
)
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Columns, Row
from cadalign.evaluation.runs.work import AbortError, Rows
from cadalign.fitting.fit import fit, fit_batch
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.metrics import translation_error_up_to_scale
from cadalign.geometry.projection import perspective

_NAMES: Columns = (("category", str), ("model_id", str), ("view", int), ("method", str))
_POSE_ERRORS = ("rotation_error_deg", "translation_error", "box_iou")
COLUMNS: Columns = (
    *_NAMES,
    *(("status", str), ("reason", str), ("visibility", str), ("keypoints", int)),
    *((name, float) for name in ("stretch_y", "stretch_z", "rotation_error_deg")),
    *((name, float) for name in ("translation_error", "scale_y_error", "scale_z_error")),
    *(("box_iou", float), ("rms_px", float), ("symmetry", str)),
    *((f"sym_{name}", float) for name in _POSE_ERRORS),
    ("translation_error_up_to_scale", float),
)
"""Columns of every run."""
REQUIRED_COLUMNS: Columns = COLUMNS[:-1]
"""Those that all runs have; earlier ones lack the last."""


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
            symmetry=SymmetryGroup(np.zeros(3), np.eye(3)[None]),
            model=None,
        )
        self.evaluate([task])

    def evaluate(self, tasks: Sequence[KeypointTask]) -> Rows:
        """A row for every task and method, and a record for every instance."""
        instances: list[Instance | Exception] = []
        extra = []
        for task in tasks:
            start = time.perf_counter()
            try:
                instances.append(self._instance(task))
            except Exception as error:
                instances.append(error)
            extra.append(time.perf_counter() - start)
        answers_of: list[list[tuple[Outcome, Estimate]]] = [[] for _ in tasks]
        for method in (*self.options.methods, SHAPE):
            places = [
                k for k, task in enumerate(tasks) if method in self.methods_for(task.category)
            ]
            chosen = [tasks[k] for k in places], [instances[k] for k in places]
            for k, answer in zip(places, self._evaluate_method(method, *chosen), strict=True):
                answers_of[k].append(answer)
        outcomes, records = [], []
        for k, (instance, answers) in enumerate(zip(instances, answers_of, strict=True)):
            found = [outcome for outcome, _ in answers]
            # The first method's row bears the time of making the instance.
            outcomes += [found[0].after(extra[k]), *found[1:]]
            if isinstance(instance, Instance):
                records.append(record_row(instance, found, [estimate for _, estimate in answers]))
        return Rows.of(outcomes, records)

    def failure(self, task: KeypointTask, reason: str) -> Rows:
        """A failed row for every method."""
        methods = self.methods_for(task.category)
        return Rows.of(_failure(task, method, reason) for method in methods)

    def _instance(self, task: KeypointTask) -> Instance:
        if task.problem:
            raise DataError(task.problem)
        names = ("noise_px", "min_visible", "seed")
        how = {name: getattr(self.options, name) for name in names} | {"view_index": task.view}
        if task.model is not None:
            return make_instance(task.model, scene=_scene_of(task.model), **how)
        model = (task.category, task.model_id)
        return make_hull_instance(task.hull, task.semantic_ids, names=model, **how)

    def _evaluate_method(
        self, method: str, tasks: Sequence[KeypointTask], instances: Sequence[Instance | Exception]
    ) -> list[tuple[Outcome, Estimate]]:
        """One method's outcome, and the estimate it is of, for every task."""
        pairs = zip(tasks, instances, strict=True)
        usable = [(task, each) for task, each in pairs if isinstance(each, Instance)]
        start = time.perf_counter()
        if method == SHAPE:
            estimates = iter([self._aligned(task, instance) for task, instance in usable])
        else:
            estimates = iter(self._estimates(method, [instance for _, instance in usable]))
        share = (time.perf_counter() - start) / max(len(usable), 1)
        answers: list[tuple[Outcome, Estimate]] = []
        for task, instance in zip(tasks, instances, strict=True):
            if isinstance(instance, Exception):
                outcome = Outcome.without_instance(instance, task.names(method), **_known(task))
                answers.append((outcome, DataError(outcome.reason)))
                continue
            start = time.perf_counter()
            estimate = next(estimates)
            try:
                outcome = self._outcome(task, instance, method, estimate)
            except AbortError:
                raise
            except Exception as error:
                outcome = _failure(task, method, reason_of(error), instance)
            answers.append((outcome.after(share + time.perf_counter() - start), estimate))
        return answers

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

    def _outcome(
        self, task: KeypointTask, instance: Instance, method: str, estimate: Estimate
    ) -> Outcome:
        if isinstance(estimate, CadalignError):
            return _failure(task, method, str(estimate), instance)
        alignment = pose_of(estimate)
        is_first = method == self.options.methods[0]
        if self.drawn_in is not None and instance.scene is not None and is_first:
            _draw(self.drawn_in, task, instance, alignment)
        metrics = _errors(alignment, instance, instance.gt, instance.gt_box)
        truth = task.symmetry.nearest_truth(est=alignment, gt=instance.gt)
        aware = metrics
        if truth is not instance.gt:
            aware = _errors(alignment, instance, truth, Box.from_model(instance.bounds, truth))
        return Outcome(
            task.names(method),
            {
                **_facts(task, instance),
                **metrics,
                "rms_px": estimate.rms
                if isinstance(estimate, AlignedShape)
                else _rms(instance, alignment),
                "translation_error_up_to_scale": translation_error_up_to_scale(
                    est=alignment, gt=instance.gt
                )
                / instance.diagonal,
                **{f"sym_{name}": aware[name] for name in _POSE_ERRORS},
                **self._overlap_up_to_scale(instance, alignment),
            },
        )

    def _overlap_up_to_scale(self, instance: Instance, est: Alignment) -> Row:
        """The box IoU up to scale by column, which takes longer than most methods."""
        if not self.shapes.paths:
            return {}
        box = Box.from_model(instance.bounds, est)
        return {BOX_IOU_UP_TO_SCALE.key: overlap_up_to_scale(est=box, gt=instance.gt_box)}


# Views of one model come one after another.
_scene_of = lru_cache(maxsize=1)(load_scene)


def _errors(
    est: Alignment, instance: Instance, gt: Alignment, gt_box: Box
) -> dict[str, float | None]:
    """Errors of an estimate by column, from one of the truths that look the same."""
    box = Box.from_model(instance.bounds, est)
    return {
        **alignment_errors(est=est, gt=gt, length=instance.diagonal),
        "box_iou": overlap(est=box, gt=gt_box),
    }


def _rms(instance: Instance, est: Alignment) -> float:
    """Root mean square residual [px]; also of the bound's estimates behind the camera."""
    points = (instance.points_3d @ est.linear.T) + est.translation
    pixels = instance.camera.pixels_from_normalized(perspective(points))
    return float(np.sqrt(((pixels - instance.points_2d) ** 2).sum(axis=1).mean()))


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


def _failure(
    task: KeypointTask, method: str, reason: str, instance: Instance | None = None
) -> Outcome:
    known = _known(task) if instance is None else _facts(task, instance)
    return Outcome.failure(reason, task.names(method), **known)


def _draw(folder: RunFolder, task: KeypointTask, instance: Instance, estimate: Alignment) -> None:
    from cadalign.evaluation.instances.drawing import draw_instance

    names = {"category": task.category, "model_id": task.model_id}
    try:
        draw_instance(folder, instance, estimate, view=task.view, **names)
    except (OSError, DataError) as error:
        raise AbortError(
            f"the overlay cannot be written: {error}",
            fix="free some space, and start the same command again: the run goes on",
        ) from None
