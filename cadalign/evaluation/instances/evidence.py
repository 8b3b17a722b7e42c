"""Keypoints with further evidence: methods, errors and their bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DataError
from cadalign.estimation.align import align
from cadalign.estimation.estimates import pose_and_border, pose_and_lengths
from cadalign.estimation.model import Model
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.evaluation.benchmark import VIEW_NAMES, Benchmark, Case, Setting
from cadalign.evaluation.experiments.evidence import (
    BOUNDS,
    COLUMNS,
    COMBINED,
    DAMAGED,
    DEPTH,
    GRAVITY,
    LENGTH,
    MASK,
    METHODS,
    VIEWS_FREE,
    VIEWS_KNOWN,
    EvidenceRunOptions,
)
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA, KeypointTask, example_view
from cadalign.evaluation.instances.scene import ObjectScene, Shot, make_scene, truth_in
from cadalign.evaluation.methods.method import Method, MethodInput
from cadalign.evaluation.metrics.cramer_rao import cramer_rao_bound
from cadalign.evaluation.metrics.errors import alignment_errors, overlap
from cadalign.evaluation.runs.tables import Row
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.io.evidence import Size
from cadalign.seeding import instance_rng
from cadalign.solvers.constants import LINEAR
from cadalign.solvers.joint.covariance import joint_covariance

_DRAWS = 1000
EVERYTHING = "all"
"""The method that gives evidence of each kind."""
_LEAST_FREE = 3  # keypoints of a view that moved in an unknown way


@dataclass(frozen=True, eq=False)
class Given:
    """Arguments of `align`, and the shots that they are of."""

    views: tuple[View, ...]
    shots: tuple[Shot, ...]
    size: Size | None


@dataclass(frozen=True, eq=False)
class EvidenceEstimate:
    """An estimate, and what it was made from, unless a registered function made it."""

    alignment: Alignment
    result: Result | None = None
    given: Given | None = None


def align_with(method: str, scene: ObjectScene) -> EvidenceEstimate:
    """Align the scene's model with the evidence that a method gives."""
    given = evidence_for(method, scene)
    result = align(scene.model, given.views, size=given.size)
    return EvidenceEstimate(result.alignment, result, given)


OWN_METHODS = {name: Method(name, partial(align_with, name)) for name in METHODS}
"""The experiment's methods by name: each is `align` with some evidence."""


def evidence_for(method: str, scene: ObjectScene) -> Given:
    """The views and the size that a method gives."""
    options = scene.options
    kinds = COMBINED.get(method, (method,))
    count = next((VIEWS_KNOWN[kind] for kind in kinds if kind in VIEWS_KNOWN), 1)
    shots = scene.shots[:count]
    if method in VIEWS_FREE:
        shots = tuple(
            shot
            for number, shot in enumerate(scene.shots[: VIEWS_FREE[method]])
            if number == 0 or len(shot.rows) >= _LEAST_FREE
        )
    views = tuple(
        View(
            KEYPOINT_CAMERA,
            shot.points_2d,
            ids=shot.rows.tolist(),
            sigma=options.sigma,
            cam_from_rig=shot.cam_from_first if count > 1 else None,
            **(_of_first(kinds, scene) if number == 0 else {}),
        )
        for number, shot in enumerate(shots)
    )
    size = Size(height=scene.height, sigma=options.length_sigma) if LENGTH in kinds else None
    return Given(views, shots, size)


def bound_of(result: Result, given: Given, scene: ObjectScene) -> FloatArray:
    """The Cramer-Rao bound (9, 9) of an estimate from such evidence, as `Result.covariance`.

    Contours have the measured standard deviation.
    """
    basis = result.statistics.basis
    if basis is None:
        (view,), (shot,) = given.views, given.shots
        points = np.asarray(scene.model.points_3d)[shot.rows]
        assert view.sigma is not None
        return cramer_rao_bound(points, view.camera, scene.gt, sigma=view.sigma, focal="known")
    evidence, state = basis.evidence, basis.state
    loss = np.full_like(evidence.sightings.loss, LINEAR)
    evidence = evidence._replace(sightings=evidence.sightings._replace(loss=loss))
    truths = [truth_in(shot, scene.gt) for shot in given.shots[: len(state.poses)]]
    poses = [np.concatenate([each.rotation.ravel(), each.translation]) for each in truths]
    true_state = state._replace(poses=np.array(poses), log_scales=np.log(scene.gt.scale))
    unknowns = pose_and_border(joint_covariance(evidence, true_state), 0)
    return pose_and_lengths(evidence, true_state, unknowns)


def _of_first(kinds: tuple[str, ...], scene: ObjectScene) -> dict[str, Any]:
    """Fields of the first view beyond its keypoints."""
    shot, options = scene.shots[0], scene.options
    fields: dict[str, Any] = {}
    if DEPTH in kinds:
        fields |= {"depth": shot.depths, "depth_sigma": options.depth_sigma}
    if GRAVITY in kinds:
        fields |= {"up": shot.up, "up_sigma_deg": options.up_sigma_deg}
    for kind in kinds:
        if kind == MASK or kind in DAMAGED:
            fields["mask"] = scene.mask(DAMAGED.get(kind, "exact"))
    return fields


@dataclass(frozen=True)
class EvidenceScenes(Setting):
    """Views of annotated models with meshes: the setting of the experiment."""

    names = VIEW_NAMES
    columns = COLUMNS

    options: EvidenceRunOptions

    def warm_up(self) -> Sequence[KeypointTask]:
        """Compile the kernels."""
        points, pixels, pose = example_view()
        for up in (None, [0.0, 1.0, 0.0]):
            align(Model(points_3d=points), View(KEYPOINT_CAMERA, pixels, up=up))
        box = Box.from_model([points.min(axis=0), points.max(axis=0)], pose)
        overlap(est=box, gt=box)
        return ()

    def case(self, task: KeypointTask) -> Case:
        if task.problem:
            raise DataError(task.problem)
        assert task.model is not None
        return Case(task.names, instance=make_scene(task.model, task.view, self.options))

    def given(self, scene: ObjectScene) -> MethodInput:
        shot = scene.shots[0]
        return MethodInput(
            np.asarray(scene.model.points_3d)[shot.rows],
            shot.points_2d,
            KEYPOINT_CAMERA,
            self.options.sigma,
            bounds=np.asarray(scene.model.bounds),
            gt=scene.gt,
            make_views=lambda: (scene.model, evidence_for(EVERYTHING, scene).views),
        )

    def answered(
        self, method: Method, scene: ObjectScene, answer: Alignment | Result
    ) -> EvidenceEstimate:
        # The first view alone was given, for which no bound is known.
        if isinstance(answer, Alignment):
            return EvidenceEstimate(answer)
        return EvidenceEstimate(answer.alignment, answer)

    def row(self, method: Method, scene: ObjectScene, estimate: EvidenceEstimate) -> Row:
        result, given = estimate.result, estimate.given
        values = _errors(estimate.alignment, scene)
        if given is None or result is None:
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
    setting = EvidenceScenes(options)
    return Benchmark.chosen(setting, options.methods, OWN_METHODS, metrics=options.metrics)


def _errors(est: Alignment, scene: ObjectScene) -> Row:
    gt = scene.gt
    bounds = np.asarray(scene.model.bounds)
    boxes = {"est": Box.from_model(bounds, est), "gt": Box.from_model(bounds, gt)}
    return {**alignment_errors(est=est, gt=gt, length=scene.diagonal), "box_iou": overlap(**boxes)}
