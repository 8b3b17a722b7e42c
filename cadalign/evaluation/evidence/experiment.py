"""Errors of alignments from keypoints and further evidence, and their bounds.

Columns of the result table, one row per view and method: what names the row (``category``,
``model_id``, ``view``, ``method``), ``status`` and ``reason``, and then

keypoints
    Number of keypoints that were given, those of all views.
rotation_error_deg
    [degrees]
translation_error
    [diagonals of the object's bounding box]
scale_y_error, scale_z_error
    Relative errors, fractions.
box_iou
    Of the object's true and estimated box; empty for a model without volume.
rotation_bound_deg, translation_bound, scale_y_bound, scale_z_bound
    Medians of the same errors of an ideal estimator, whose covariance is the instance's Cramer-Rao
    bound.
over_limit
    The rotation error over its bound: 1 in the median for an ideal estimator.
warnings
    Number of warnings.

The metrics of failed rows are empty.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DataError
from cadalign.estimation.align import align
from cadalign.estimation.model import Model
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.evaluation.evidence.methods import bound_of, evidence_for
from cadalign.evaluation.evidence.options import EvidenceRunOptions
from cadalign.evaluation.evidence.scene import ObjectScene, make_scene
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.keypointnet.tasks import KeypointTask
from cadalign.evaluation.outcome import Outcome, alignment_errors, overlap, reason_of
from cadalign.evaluation.runs.tables import Columns, Row
from cadalign.evaluation.runs.work import Rows
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.seeding import instance_rng

_NAMES: Columns = (("category", str), ("model_id", str), ("view", int), ("method", str))
_ERRORS = ("rotation_error_deg", "translation_error", "scale_y_error", "scale_z_error")
BOUNDS = ("rotation_bound_deg", "translation_bound", "scale_y_bound", "scale_z_bound")
COLUMNS: Columns = (
    *(*_NAMES, ("status", str), ("reason", str), ("keypoints", int)),
    *((name, float) for name in (*_ERRORS, "box_iou", *BOUNDS, "over_limit")),
    ("warnings", int),
)
_DRAWS = 1000


@dataclass(frozen=True)
class EvidenceExperiment:
    """Evaluates kinds of evidence on views of annotated models with meshes."""

    columns = COLUMNS
    timing_columns = (*_NAMES, ("seconds", float))

    options: EvidenceRunOptions

    def warm_up(self) -> None:
        """Compile the kernels."""
        points = np.random.default_rng(0).uniform(-0.3, 0.3, (9, 3))
        pose = Alignment(np.eye(3), np.array([0.0, 0.0, 2.0]), np.ones(3))
        pixels = KEYPOINT_CAMERA.project(pose.apply(points))
        for up in (None, [0.0, 1.0, 0.0]):
            align(Model(points_3d=points), View(KEYPOINT_CAMERA, pixels, up=up))
        box = Box.from_model([points.min(axis=0), points.max(axis=0)], pose)
        overlap(est=box, gt=box)

    def evaluate(self, tasks: Sequence[KeypointTask]) -> Rows:
        """A row for every task and method."""
        return Rows.of(outcome for task in tasks for outcome in self._outcomes(task))

    def failure(self, task: KeypointTask, reason: str) -> Rows:
        """A failed row for every method."""
        return Rows.of(Outcome.failure(reason, task.names(name)) for name in self.options.methods)

    def _outcomes(self, task: KeypointTask) -> list[Outcome]:
        try:
            if task.problem:
                raise DataError(task.problem)
            assert task.model is not None
            scene = make_scene(task.model, task.view, self.options)
        except Exception as error:
            methods = self.options.methods
            return [Outcome.without_instance(error, task.names(name)) for name in methods]
        return [self._outcome(task, scene, method) for method in self.options.methods]

    def _outcome(self, task: KeypointTask, scene: ObjectScene, method: str) -> Outcome:
        names = task.names(method)
        try:
            given = evidence_for(method, scene, self.options)
            facts = {"keypoints": sum(len(shot.rows) for shot in given.shots)}
            start = time.perf_counter()
            result = align(scene.model, given.views, size=given.size)
            seconds = time.perf_counter() - start
            values = facts | _errors(result, scene)
            bounds = self._bounds(bound_of(result, given, scene), scene)
            over = values["rotation_error_deg"] / bounds["rotation_bound_deg"]
            values |= {**bounds, "over_limit": over, "warnings": len(result.warnings)}
        except Exception as error:
            return Outcome.failure(reason_of(error), names)
        return Outcome(names, values, seconds=seconds)

    def _bounds(self, bound: FloatArray, scene: ObjectScene) -> Row:
        """Median errors of a Gaussian with the bound as its covariance."""
        rng = instance_rng(self.options.seed, *scene.names, "bound")
        drawn = rng.multivariate_normal(np.zeros(9), bound, size=_DRAWS, method="eigh")
        values = (
            np.degrees(np.linalg.norm(drawn[:, :3], axis=1)),
            np.linalg.norm(drawn[:, 3:6], axis=1) / scene.diagonal,
            np.abs(np.expm1(drawn[:, 7])),
            np.abs(np.expm1(drawn[:, 8])),
        )
        return dict(zip(BOUNDS, (float(np.median(each)) for each in values), strict=True))


def _errors(result: Result, scene: ObjectScene) -> Row:
    est, gt = result.alignment, scene.gt
    bounds = np.asarray(scene.model.bounds)
    boxes = {"est": Box.from_model(bounds, est), "gt": Box.from_model(bounds, gt)}
    return {
        **alignment_errors(est=est, gt=gt, length=scene.diagonal),
        "box_iou": overlap(**boxes),
    }
