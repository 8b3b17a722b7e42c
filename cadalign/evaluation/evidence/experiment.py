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

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DataError
from cadalign.estimation.align import align
from cadalign.estimation.model import Model
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.evaluation.benchmark import VIEW_NAMES, Benchmark, Case, Pair, Setting, attempt
from cadalign.evaluation.evidence.options import EvidenceRunOptions
from cadalign.evaluation.evidence.scene import (
    EVERYTHING,
    OWN_METHODS,
    EvidenceEstimate,
    EvidenceInstance,
    ObjectScene,
    bound_of,
    evidence_for,
    make_scene,
)
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.keypointnet.tasks import KeypointTask
from cadalign.evaluation.methods.method import Method, MethodInput
from cadalign.evaluation.methods.registry import choose_methods
from cadalign.evaluation.metrics.errors import alignment_errors, overlap
from cadalign.evaluation.metrics.registry import Compared, choose_metrics
from cadalign.evaluation.runs.tables import Columns, Row
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.seeding import instance_rng

_ERRORS = ("rotation_error_deg", "translation_error", "scale_y_error", "scale_z_error")
BOUNDS = ("rotation_bound_deg", "translation_bound", "scale_y_bound", "scale_z_bound")
COLUMNS: Columns = (
    *(*VIEW_NAMES, ("status", str), ("reason", str), ("keypoints", int)),
    *((name, float) for name in (*_ERRORS, "box_iou", *BOUNDS, "over_limit")),
    ("warnings", int),
)
_DRAWS = 1000


@dataclass(frozen=True)
class EvidenceScenes(Setting):
    """Views of annotated models with meshes: the setting of the experiment."""

    names = VIEW_NAMES
    columns = COLUMNS

    options: EvidenceRunOptions

    def warm_up(self) -> Sequence[KeypointTask]:
        """Compile the kernels."""
        points = np.random.default_rng(0).uniform(-0.3, 0.3, (9, 3))
        pose = Alignment(np.eye(3), np.array([0.0, 0.0, 2.0]), np.ones(3))
        pixels = KEYPOINT_CAMERA.project(pose.apply(points))
        for up in (None, [0.0, 1.0, 0.0]):
            align(Model(points_3d=points), View(KEYPOINT_CAMERA, pixels, up=up))
        box = Box.from_model([points.min(axis=0), points.max(axis=0)], pose)
        overlap(est=box, gt=box)
        return ()

    def cases(self, tasks: Sequence[KeypointTask]) -> list[Case]:
        """The scene of every view, or why there is none."""
        return [self._case(task) for task in tasks]

    def failed(self, task: KeypointTask) -> list[Case]:
        """The case of a view without a scene."""
        return [Case(task.names)]

    def _case(self, task: KeypointTask) -> Case:
        if task.problem:
            return Case(task.names, error=DataError(task.problem))
        assert task.model is not None
        scene = attempt(make_scene, task.model, task.view, self.options)
        if isinstance(scene, Exception):
            return Case(task.names, error=scene)
        return Case(task.names, instance=EvidenceInstance(scene, self.options))

    def given(self, instance: EvidenceInstance) -> MethodInput:
        """The first view's keypoints; for functions of views, two views with all evidence."""
        scene, shot = instance.scene, instance.scene.shots[0]
        return MethodInput(
            np.asarray(scene.model.points_3d)[shot.rows],
            shot.points_2d,
            KEYPOINT_CAMERA,
            self.options.noise_px or 1.0,
            bounds=np.asarray(scene.model.bounds),
            make_views=lambda: (scene.model, evidence_for(EVERYTHING, instance).views),
        )

    def answered(
        self, method: Method, instance: EvidenceInstance, answer: Alignment | Result
    ) -> EvidenceEstimate:
        """The answer beside the first view, whose bound is not known."""
        return EvidenceEstimate(answer, None)

    def compared(self, instance: EvidenceInstance, estimate: EvidenceEstimate) -> Compared:
        """The estimated and the true alignment."""
        result = estimate.answer if isinstance(estimate.answer, Result) else None
        return Compared(estimate.alignment, instance.scene.gt, result)

    def measure(self, method: Method, pairs: Sequence[Pair]) -> list[Row | Exception]:
        """Errors, and their bounds, by column."""
        return [attempt(self._row, instance.scene, estimate) for instance, estimate in pairs]

    def _row(self, scene: ObjectScene, estimate: EvidenceEstimate) -> Row:
        result, given = estimate.answer, estimate.given
        values = _errors(estimate.alignment, scene)
        if given is None or isinstance(result, Alignment):
            return values
        values["keypoints"] = sum(len(shot.rows) for shot in given.shots)
        bounds = self._bounds(bound_of(result, given, scene), scene)
        over = values["rotation_error_deg"] / bounds["rotation_bound_deg"]
        return values | {**bounds, "over_limit": over, "warnings": len(result.warnings)}

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


def evidence_benchmark(options: EvidenceRunOptions) -> Benchmark:
    """The kinds of evidence of the options on views of models."""
    methods = choose_methods(options.methods, OWN_METHODS)
    metrics = choose_metrics(options.metrics, COLUMNS)
    return Benchmark(EvidenceScenes(options), methods, metrics=metrics)


def _errors(est: Alignment, scene: ObjectScene) -> Row:
    gt = scene.gt
    bounds = np.asarray(scene.model.bounds)
    boxes = {"est": Box.from_model(bounds, est), "gt": Box.from_model(bounds, gt)}
    return {
        **alignment_errors(est=est, gt=gt, length=scene.diagonal),
        "box_iou": overlap(**boxes),
    }
