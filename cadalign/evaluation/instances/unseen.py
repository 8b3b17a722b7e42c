"""Unseen objects, which are no stretched copy of any model: tasks, errors and records."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.datasets import KeypointNet
from cadalign.errors import CadalignError, DataError
from cadalign.estimation.align import align
from cadalign.estimation.model import Model
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.evaluation.benchmark import VIEW_NAMES, Benchmark, Case, Setting
from cadalign.evaluation.experiments.unseen import COLUMNS, UnseenOptions
from cadalign.evaluation.instances.hull import KeypointHull, sample_hull_view
from cadalign.evaluation.instances.instance import (
    KEYPOINT_CAMERA,
    KeypointTask,
    example_view,
)
from cadalign.evaluation.instances.pictures import write_preview
from cadalign.evaluation.instances.record import (
    RECORD_COLUMNS,
    AlignedShape,
    Warp,
    placed_in_model,
    record_of,
    record_stem,
    shape_of_result,
)
from cadalign.evaluation.instances.views import KeypointTasks
from cadalign.evaluation.methods.method import Method, MethodInput
from cadalign.evaluation.methods.unseen import (
    OWN_METHODS,
    ShapeEstimate,
    UnseenInstance,
    UnseenObject,
)
from cadalign.evaluation.metrics.errors import overlap, overlap_up_to_scale
from cadalign.evaluation.outcome import Outcome
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Row
from cadalign.evaluation.runs.work import fingerprint
from cadalign.evaluation.shape_files import LearnedFiles
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.metrics import (
    rotation_error,
    translation_error,
    translation_error_up_to_scale,
)
from cadalign.geometry.rotations import vector_from_rotation
from cadalign.io.files import writing
from cadalign.seeding import instance_rng
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.tails import probability_within

logger = logging.getLogger("cadalign")

# Smallest share of a covariance's largest eigenvalue that counts as variance.
_NO_VARIANCE = 1e-12
# Free of the size: log(y / x) and log(z / x).
_RATIOS = np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])


class UnseenTasks(KeypointTasks):
    """All views of all objects of a split in the order of their names."""

    def __init__(self, dataset: KeypointNet, options: UnseenOptions) -> None:
        objects = dataset.subset(categories=options.categories, split=options.split)
        if not objects.ids():
            raise DataError(f"no objects in the split {options.split}", where=str(dataset.root))
        super().__init__(objects, options)

    @property
    def categories(self) -> tuple[str, ...]:
        """The categories that have objects, sorted."""
        return tuple(sorted({category for category, _ in self.keys}))

    def fingerprint(self) -> str:
        """Hash of the annotations."""
        parts: list[Any] = []
        for place in range(0, len(self), len(self) // len(self.keys)):
            task = self.task(place)
            parts.append(f"{task.category}\0{task.model_id}\0{task.problem}")
            parts += [task.hull.xyz, task.ids]
        return fingerprint(*parts)


def observe_object(task: KeypointTask, options: UnseenOptions) -> UnseenObject:
    """Draw a view of an object, the keypoints that are given, their noise and outliers.

    Views are those of `sample_hull_view`; hidden keypoints may be given, too. Everything random
    follows from (seed, category, model id, view): view, order of keypoints and unit noise are the
    same whatever the noise and the number of keypoints.
    """
    if task.problem:
        raise DataError(task.problem)
    names = (task.category, task.model_id, str(task.view))
    xyz = task.hull.xyz
    count = len(xyz)
    gt, _ = sample_hull_view(
        task.hull, KEYPOINT_CAMERA, rng=instance_rng(options.seed, *names), min_visible=0
    )
    rng = instance_rng(options.seed, *names, "keypoints")
    order, noise = rng.permutation(count), rng.standard_normal((count, 2))
    elsewhere = rng.uniform(0, (KEYPOINT_CAMERA.width, KEYPOINT_CAMERA.height), (count, 2))
    given = order[: options.keypoints]
    rows = np.sort(given)
    is_outlier = np.isin(rows, given[: round(options.outliers * len(given))])
    clean = KEYPOINT_CAMERA.project(gt.apply(xyz[rows]))
    points = clean + options.noise_px * noise[rows]
    points[is_outlier] = elsewhere[rows][is_outlier]
    return UnseenObject(task, gt, rows, points, is_outlier)


def probability_level(
    error: FloatArray, covariance: FloatArray, degrees_of_freedom: float | None = None
) -> float | None:
    """Probability of the smallest ellipsoid about the estimate that holds the truth.

    ``error`` (k,) is estimate minus truth, ``covariance`` (k, k) as the estimator states it, where
    directions without variance are held to be known; with ``degrees_of_freedom`` errors follow a t
    distribution, without a Gaussian. The level is uniform over [0, 1] where the covariance is that
    of the errors, 1 if the error has a part in a direction without variance, and None if there is
    no variance at all.

    Examples
    --------
    >>> round(probability_level(np.array([1.0]), np.array([[1.0]])), 4)
    0.6827
    >>> probability_level(np.zeros(2), np.zeros((2, 2))) is None
    True
    """
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    free = values > _NO_VARIANCE * max(float(values[-1]), 0.0)
    if not np.isfinite(values).all() or not free.any():
        return None
    parts = vectors.T @ error
    if (parts[~free] ** 2 > 1e-6 * values[-1]).any():
        return 1.0
    square = float((parts[free] ** 2 / values[free]).sum())
    return float(probability_within(square, int(free.sum()), degrees_of_freedom))


@dataclass(frozen=True)
class UnseenObjects(Setting):
    """Objects with what was learned from others: the setting of the experiment."""

    names = VIEW_NAMES
    columns = COLUMNS
    record_columns = RECORD_COLUMNS

    learned: LearnedFiles
    options: UnseenOptions
    previews: RunFolder | None = None  # of the objects' meshes

    def warm_up(self) -> Sequence[KeypointTask]:
        """Compile the kernels."""
        (points, pixels, pose), ids = example_view(), np.arange(9)
        task = KeypointTask("", "", hull=KeypointHull(points), ids=ids)
        seen = UnseenObject(task, pose, ids, pixels, np.zeros(9, dtype=bool))
        view = View(KEYPOINT_CAMERA, pixels)
        for model in (Model(points_3d=points), ShapeModel.from_basis(points, [points], [0.1])):
            _coverage(align(model, view), seen, ids, ids)
        box = Box.from_model(task.hull.bounds, pose)
        overlap_up_to_scale(est=box, gt=box)
        return ()

    def case(self, task: KeypointTask) -> Case:
        seen = observe_object(task, self.options)
        facts = {"keypoints": len(seen.points_2d)}
        o = self.options
        own = UnseenInstance(seen, self.learned, o.seed, o.noise_px, o.sigma, o.outliers)
        return Case(task.names, facts, own)

    def given(self, instance: UnseenInstance) -> MethodInput:
        shape, seen = instance.shape, instance.seen
        known = np.isin(seen.ids, shape.ids)
        rows = shape.rows(seen.ids[known].tolist())
        return MethodInput(
            shape.mean[rows],
            seen.points_2d[known],
            KEYPOINT_CAMERA,
            instance.sigma,
            bounds=shape.mean[-2:],
            gt=seen.gt,
            make_views=lambda: (shape, [instance.view_of(shape)]),
        )

    def answered(
        self, method: Method, instance: UnseenInstance, answer: Alignment | Result
    ) -> ShapeEstimate:
        shape = instance.shape
        ids = np.array(shape.ids, dtype=np.int64)
        if isinstance(answer, Result) and tuple(answer.ids) == tuple(shape.ids):
            return ShapeEstimate(answer.alignment, answer.bounds, ids, answer.points_3d, answer)
        found = answer if isinstance(answer, Alignment) else answer.alignment
        return ShapeEstimate(found, shape.mean[-2:], ids, shape.mean[:-2])

    def row(self, method: Method, instance: UnseenInstance, estimate: ShapeEstimate) -> Row:
        return _errors(estimate, instance.seen)

    def finish(
        self, case: Case, outcomes: list[Outcome], estimates: list[Any]
    ) -> tuple[list[Outcome], Row]:
        instance: UnseenInstance = case.instance
        if self.previews is not None and instance.seen.task.view == 0:
            keep_preview(self.previews, self.options.root, instance.seen.task)
        return outcomes, _record(instance, outcomes, estimates)


def unseen_benchmark(
    learned: LearnedFiles, options: UnseenOptions, previews: RunFolder | None = None
) -> Benchmark:
    """The methods of the options on unseen objects."""
    setting = UnseenObjects(learned, options, previews)
    return Benchmark.chosen(setting, options.methods, OWN_METHODS, metrics=options.metrics)


def _errors(found: ShapeEstimate, seen: UnseenObject) -> Row:
    est, gt = found.alignment, seen.gt
    known, rows = _shared(found, seen)
    own = found.points_3d[rows]
    box = Box.from_model([own.min(axis=0), own.max(axis=0)], est)
    gt_box = Box.from_model(seen.task.hull.bounds, gt)
    boxes = {"est": box, "gt": gt_box}
    centre = Alignment(est.rotation, box.center, np.ones(3))
    gt_centre = Alignment(gt.rotation, gt_box.center, np.ones(3))
    values: Row = {
        "rotation_error_deg": rotation_error(est=est, gt=gt),
        "best_rotation_error_deg": min(rotation_error(est=one, gt=gt) for one in found.poses),
        "translation_error": translation_error(est=centre, gt=gt_centre),
        "translation_error_up_to_scale": translation_error_up_to_scale(est=centre, gt=gt_centre),
        "box_iou": overlap(**boxes),
        "box_iou_up_to_scale": overlap_up_to_scale(**boxes),
        "stated_box_iou_up_to_scale": overlap_up_to_scale(
            est=Box.from_model(found.bounds, est), gt=gt_box
        ),
        "keypoint_error": _distance_up_to_scale(est.apply(own), gt.apply(seen.xyz[known])),
    }
    if found.result is not None:
        values |= _coverage(found.result, seen, known, rows)
    return values


def _distance_up_to_scale(est: FloatArray, gt: FloatArray) -> float:
    """Root mean square distance of points (n, 3), the estimated ones scaled about the origin."""
    factor = (est * gt).sum() / (est * est).sum()
    return float(np.sqrt(((factor * est - gt) ** 2).sum(axis=1).mean()))


def _coverage(result: Result, seen: UnseenObject, known: IntArray, rows: IntArray) -> Row:
    """Place of the truth in the stated probabilities; metrics by column.

    ``known`` are the rows of the object's keypoints that the model has, ``rows`` those of the
    model's keypoints that they are.
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
    levels = [
        found
        for gap, own in zip(gaps, of_points[rows], strict=True)
        if (found := probability_level(gap, own, freedom)) is not None
    ]
    return {
        "rotation_level": probability_level(turn, covariance[:3, :3], freedom),
        "stretch_level": level,
        "keypoints_within_68": _share(levels, 0.68),
        "keypoints_within_95": _share(levels, 0.95),
    }


def _share(levels: Sequence[float], nominal: float) -> float | None:
    """Share of the levels that are at most the nominal one; None of none."""
    return float((np.array(levels) <= nominal).mean()) if levels else None


def keep_preview(folder: RunFolder, root: Path, task: KeypointTask) -> None:
    """Write the preview of an object's mesh to a run's folder; nothing without a readable mesh."""
    model = _dataset(root)[task.category, task.model_id]
    if model.mesh_path is None:
        return
    try:
        mesh = model.load_mesh()
    except DataError as error:
        logger.warning("no preview of the mesh: %s", error)
        return
    with writing(folder.previews):
        folder.previews.mkdir(exist_ok=True)
    write_preview(folder.previews / f"{record_stem(task.category, task.model_id)}.json", mesh)


_dataset = lru_cache(maxsize=1)(KeypointNet)


def _record(
    instance: UnseenInstance,
    outcomes: Sequence[Outcome],
    estimates: Sequence[ShapeEstimate | CadalignError],
) -> Row:
    """The record of a view of an object, whose box is that of its keypoints."""
    seen, sigma = instance.seen, instance.sigma
    return record_of(
        camera=KEYPOINT_CAMERA,
        gt=seen.gt,
        stretch=1 / seen.gt.scale,
        bounds=seen.task.hull.bounds,
        points_3d=seen.xyz[seen.rows],
        points_2d=seen.points_2d,
        ids=seen.ids,
        outcomes=outcomes,
        estimates=[
            each if isinstance(each, CadalignError) else _aligned(each, seen, sigma)
            for each in estimates
        ],
    )


def _shared(found: ShapeEstimate, seen: UnseenObject) -> tuple[IntArray, IntArray]:
    """Rows of the object's keypoints that an estimate has, and their rows in it."""
    row_of = {name: row for row, name in enumerate(found.ids.tolist())}
    ids = seen.task.ids.tolist()
    known = np.flatnonzero([name in row_of for name in ids])
    return known, np.array([row_of[ids[place]] for place in known.tolist()], dtype=np.int64)


def _aligned(found: ShapeEstimate, seen: UnseenObject, sigma: float) -> AlignedShape:
    """An estimate in terms of the object, of which it has some keypoints."""
    known, rows = _shared(found, seen)
    how: dict[str, Any] = {"model_bounds": seen.task.hull.bounds, "spans_points": True}
    source = seen.xyz[known]
    alignment, warp = placed_in_model(found, rows, source, **how)
    rms = _rms(alignment, warp, seen, known)
    if found.result is None:
        return AlignedShape(alignment, warp, rms, sigma)
    return shape_of_result(found.result, rows, source, rms=rms, sigma=sigma, **how)


def _rms(alignment: Alignment, warp: Warp, seen: UnseenObject, known: IntArray) -> float:
    """Root mean square residual [px] of the given keypoints that the method has."""
    given = np.isin(seen.rows, known)
    places = warp.target[np.searchsorted(known, seen.rows[given])]
    in_camera = alignment.apply(places)
    ahead = in_camera[:, 2] > 0
    if not ahead.any():
        return float("nan")
    residuals = KEYPOINT_CAMERA.project(in_camera[ahead]) - seen.points_2d[given][ahead]
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))
