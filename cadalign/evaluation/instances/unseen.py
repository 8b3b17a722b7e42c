"""Unseen objects, not stretched copies of known models: tasks, methods, errors and records."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from cadalign.arrays import FloatArray, IntArray, instance_rng
from cadalign.datasets import KeypointNet
from cadalign.errors import DataError
from cadalign.estimation.align import align
from cadalign.estimation.model import Model
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.evaluation.benchmark import Benchmark, Case, Setting
from cadalign.evaluation.experiments.keypointnet import KeypointTasks
from cadalign.evaluation.experiments.unseen import COLUMNS, METHODS, UnseenOptions, learned_shape
from cadalign.evaluation.instances.instance import (
    KEYPOINT_CAMERA,
    KeypointTask,
    sample_hull_view,
)
from cadalign.evaluation.instances.record import (
    RECORD_COLUMNS,
    AlignedShape,
    aligned_shape,
    record_of,
)
from cadalign.evaluation.methods import LIMIT, SHAPE, Method, MethodInput
from cadalign.evaluation.metrics.errors import (
    limit_estimate,
    overlap,
    probability_level,
)
from cadalign.evaluation.runs.work import Outcome, Row
from cadalign.geometry.alignment import Alignment, Box, extent
from cadalign.geometry.rotations import vector_from_rotation
from cadalign.metrics import (
    rotation_error,
    translation_error,
    translation_error_up_to_scale,
)
from cadalign.shapes.model import ShapeModel

# Maps logs of lengths to log(y / x) and log(z / x), which do not depend on size.
_RATIOS = np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])


def unseen_tasks(dataset: KeypointNet, options: UnseenOptions) -> KeypointTasks:
    """All views of all objects of a split, sorted by name."""
    objects = dataset.subset(categories=options.categories, split=options.split)
    return KeypointTasks(objects, options)


@dataclass(frozen=True, eq=False)
class UnseenObject:
    """View of an object with the true scale 1, and the shapes learned from other objects."""

    task: KeypointTask  # names and keypoints of the object
    options: UnseenOptions
    gt: Alignment  # the pose
    rows: IntArray  # (n,), rows of the observed keypoints among all keypoints of the object
    points_2d: FloatArray  # (n, 2), the observed keypoints [px], with noise
    learned: Path = Path()  # folder of the shape models by category

    @property
    def xyz(self) -> FloatArray:
        """All keypoints of the object, (k, 3) float."""
        return self.task.hull.xyz

    @property
    def ids(self) -> IntArray:
        """Semantic ids of the observed keypoints, (n,) int."""
        return self.task.ids[self.rows]

    @property
    def shape(self) -> ShapeModel:
        """The shape model of the category."""
        return learned_shape(self.learned, self.task.category)

    def view_of(self, model: Model | ShapeModel) -> View:
        """The view with the observed keypoints that a model has."""
        shared = np.isin(self.ids, np.array(model.ids, dtype=np.int64))
        ids, pixels = self.ids[shared].tolist(), self.points_2d[shared]
        return View(KEYPOINT_CAMERA, pixels, ids=ids, sigma=self.options.sigma)


def observe_object(task: KeypointTask, options: UnseenOptions) -> UnseenObject:
    """Draw a view of an object, a selection of keypoints, and their noise.

    Views are drawn by `sample_hull_view`; hidden keypoints may be selected, too. View, order of
    keypoints and unit noise depend only on (seed, category, model id, view), not on the noise level
    or the number of keypoints.
    """
    if task.problem:
        raise DataError(task.problem)
    names = (task.category, task.model_id, str(task.view))
    xyz = task.hull.xyz
    count = len(xyz)
    rng = instance_rng(options.seed, *names)
    gt, _ = sample_hull_view(task.hull, rng=rng, min_visible=0)
    rng = instance_rng(options.seed, *names, "keypoints")
    order, noise = rng.permutation(count), rng.standard_normal((count, 2))
    rows = np.sort(order[: options.keypoints])
    points = KEYPOINT_CAMERA.project(gt.apply(xyz[rows])) + options.noise_px * noise[rows]
    return UnseenObject(task, options, gt, rows, points)


# Methods ------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ShapeEstimate:
    """Estimated pose and shape of an object."""

    alignment: Alignment
    bounds: FloatArray  # (2, 3), lowest and highest coordinates before the stretch
    ids: IntArray  # (m,)
    points_3d: FloatArray  # (m, 3), keypoints before the stretch
    result: Result | None = None  # None for methods without covariances

    @classmethod
    def from_result(cls, result: Result) -> ShapeEstimate:
        """Make the estimate of a result, whose keypoints have semantic ids."""
        ids = np.array(result.ids, dtype=np.int64)
        return cls(result.alignment, result.bounds, ids, result.points_3d, result)


def solve_object(seen: UnseenObject, *, method: str) -> ShapeEstimate:
    """Estimate an object by a method's name; see `UnseenOptions.methods`."""
    model: Model | ShapeModel = seen.shape
    if method == LIMIT:
        points, pixels = seen.xyz[seen.rows], seen.points_2d
        alignment = limit_estimate(points, pixels, KEYPOINT_CAMERA, seen.gt)
        return ShapeEstimate(alignment, seen.task.hull.bounds, seen.task.ids, seen.xyz)
    if method == "exact":
        model = Model(points_3d=seen.xyz, ids=seen.task.ids.tolist())
    elif method != SHAPE:
        mean, stretch = seen.shape.mean, "none" if method == "mean-rigid" else None
        ids, bounds = seen.shape.ids, mean[-2:]
        model = Model(points_3d=mean[:-2], ids=ids, bounds=bounds, stretch=stretch)
    return ShapeEstimate.from_result(align(model, seen.view_of(model)))


def unseen_benchmark(learned: Path, options: UnseenOptions) -> Benchmark:
    """The benchmark of the chosen methods on unseen objects."""
    own = {name: Method(name, partial(solve_object, method=name)) for name in METHODS}
    setting = UnseenObjects(learned, options)
    return Benchmark.from_methods(setting, options.methods, own, metrics=options.metrics)


# Errors -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class UnseenObjects(Setting):
    """Instances of the experiment: objects with shapes learned from other objects."""

    columns = COLUMNS
    record_columns = RECORD_COLUMNS

    learned: Path
    options: UnseenOptions

    def case(self, task: KeypointTask) -> Case:
        seen = observe_object(task, self.options)
        facts = {"keypoints": len(seen.points_2d)}
        return Case(task.names, facts, replace(seen, learned=self.learned))

    def method_input(self, seen: UnseenObject) -> MethodInput:
        shape = seen.shape
        known = np.isin(seen.ids, shape.ids)
        points = shape.mean[shape.rows(seen.ids[known].tolist())]
        return MethodInput(
            points,
            seen.points_2d[known],
            KEYPOINT_CAMERA,
            self.options.sigma,
            bounds=shape.mean[-2:],
            gt=seen.gt,
        )

    def estimate_of(
        self, method: Method, seen: UnseenObject, answer: Alignment | Result
    ) -> ShapeEstimate:
        shape = seen.shape
        if isinstance(answer, Result) and tuple(answer.ids) == tuple(shape.ids):
            return ShapeEstimate.from_result(answer)
        found = answer if isinstance(answer, Alignment) else answer.alignment
        ids = np.array(shape.ids, dtype=np.int64)
        return ShapeEstimate(found, shape.mean[-2:], ids, shape.mean[:-2])

    def row(self, method: Method, seen: UnseenObject, estimate: ShapeEstimate) -> Row:
        return object_errors(estimate, seen)

    def finish(self, case: Case, outcomes: list[Outcome], estimates: list[Any]) -> str:
        """The record has the box of the object's keypoints."""
        seen: UnseenObject = case.instance
        return record_of(
            outcomes,
            [e if isinstance(e, Exception) else _describe(e, seen) for e in estimates],
            camera=KEYPOINT_CAMERA,
            gt=seen.gt,
            bounds=seen.task.hull.bounds,
            points_3d=seen.xyz[seen.rows],
            points_2d=seen.points_2d,
            ids=seen.ids,
        )


def object_errors(found: ShapeEstimate, seen: UnseenObject) -> Row:
    """Errors of an estimate, and the levels of its regions that hold the truth."""
    est, gt = found.alignment, seen.gt
    known, rows = _shared(found, seen)
    own = found.points_3d[rows]
    box = Box.from_model(extent(own), est)
    gt_box = Box.from_model(seen.task.hull.bounds, gt)
    centre = Alignment(est.rotation, box.center, np.ones(3))
    gt_centre = Alignment(gt.rotation, gt_box.center, np.ones(3))
    values: Row = {
        "rotation_error_deg": rotation_error(est=est, gt=gt),
        "translation_error": translation_error(est=centre, gt=gt_centre),
        "translation_error_up_to_scale": translation_error_up_to_scale(est=centre, gt=gt_centre),
        "box_iou": overlap(est=box, gt=gt_box),
        "box_iou_up_to_scale": overlap(est=box, gt=gt_box, up_to_scale=True),
        "keypoint_error": _distance_up_to_scale(est.apply(own), gt.apply(seen.xyz[known])),
    }
    if found.result is not None:
        values |= _coverage(found.result, seen, known, rows)
    return values


def _shared(found: ShapeEstimate, seen: UnseenObject) -> tuple[IntArray, IntArray]:
    """Rows of the shared keypoints in the object and in the estimate."""
    row_of = {name: row for row, name in enumerate(found.ids.tolist())}
    ids = seen.task.ids.tolist()
    known = np.flatnonzero([name in row_of for name in ids])
    return known, np.array([row_of[ids[place]] for place in known.tolist()], dtype=np.int64)


def _distance_up_to_scale(est: FloatArray, gt: FloatArray) -> float:
    """Root mean square distance of points (n, 3) after scaling the estimate about the origin."""
    factor = (est * gt).sum() / (est * est).sum()
    return float(np.sqrt(((factor * est - gt) ** 2).sum(axis=1).mean()))


def _coverage(result: Result, seen: UnseenObject, known: IntArray, rows: IntArray) -> Row:
    """Levels of the stated regions that hold the truth, by column; see `probability_level`.

    ``known`` and ``rows`` are the rows of the shared keypoints in the object and in the model.
    """
    est = result.alignment
    turn = vector_from_rotation(est.rotation @ seen.gt.rotation.T)
    covariance = cast(FloatArray, result.covariance)
    of_points = cast(FloatArray, result.points_covariance)
    lengths = np.ptp(result.bounds, axis=0) * est.scale
    true_lengths = np.ptp(seen.task.hull.bounds, axis=0)
    level, freedom = None, result.degrees_of_freedom
    if (lengths > 0).all() and (true_lengths > 0).all():
        ratios = _RATIOS @ np.log(lengths / true_lengths)
        spread = _RATIOS @ covariance[6:, 6:] @ _RATIOS.T
        level = probability_level(ratios, spread, freedom)
    gaps = result.points_3d[rows] * est.scale - seen.xyz[known]
    found = map(partial(probability_level, degrees_of_freedom=freedom), gaps, of_points[rows])
    levels = np.array([each for each in found if each is not None])
    within_68, within_95 = (
        float((levels <= nominal).mean()) if len(levels) else None for nominal in (0.68, 0.95)
    )
    return {
        "rotation_level": probability_level(turn, covariance[:3, :3], freedom),
        "stretch_level": level,
        "keypoints_within_68": within_68,
        "keypoints_within_95": within_95,
    }


def _describe(found: ShapeEstimate, seen: UnseenObject) -> AlignedShape:
    known, rows = _shared(found, seen)
    return aligned_shape(
        found,
        rows,
        seen.xyz[known],
        model_bounds=seen.task.hull.bounds,
        spans_points=True,
        sigma=seen.options.sigma,
        result=found.result,
    )
