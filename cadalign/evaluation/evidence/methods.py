"""The evidence that each method gives to `align`, and the bound of its estimate."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.align import align
from cadalign.estimation.estimates import pose_and_border, pose_and_lengths
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.evaluation.accuracy.cramer_rao import cramer_rao_bound
from cadalign.evaluation.evidence.options import (
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
from cadalign.evaluation.evidence.scene import ObjectScene, Shot
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.methods.method import Method
from cadalign.geometry.alignment import Alignment
from cadalign.io.evidence import Size
from cadalign.solvers.constants import LINEAR
from cadalign.solvers.joint.covariance import joint_covariance

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
class EvidenceInstance:
    """A scene, and the accuracy of its evidence."""

    scene: ObjectScene
    options: EvidenceRunOptions


@dataclass(frozen=True, eq=False)
class EvidenceEstimate:
    """An estimate, and what it was made from, unless a registered function made it."""

    answer: Alignment | Result
    given: Given | None

    @property
    def alignment(self) -> Alignment:
        """The estimated alignment."""
        return self.answer if isinstance(self.answer, Alignment) else self.answer.alignment


def align_with(method: str, instance: EvidenceInstance) -> EvidenceEstimate:
    """Align the scene's model with the evidence that a method gives."""
    given = evidence_for(method, instance)
    return EvidenceEstimate(align(instance.scene.model, given.views, size=given.size), given)


OWN_METHODS = {name: Method(name, partial(align_with, name)) for name in METHODS}
"""The experiment's methods by name: each is `align` with some evidence."""


def evidence_for(method: str, instance: EvidenceInstance) -> Given:
    """The views and the size that a method gives."""
    scene, options = instance.scene, instance.options
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
            sigma=options.noise_px or 1.0,
            cam_from_rig=shot.cam_from_first if count > 1 else None,
            **(_of_first(kinds, scene, options) if number == 0 else {}),
        )
        for number, shot in enumerate(shots)
    )
    size = Size(height=scene.height, sigma=options.length_sigma) if LENGTH in kinds else None
    return Given(views, shots, size)


def bound_of(result: Result, given: Given, scene: ObjectScene) -> FloatArray:
    """The Cramer-Rao bound (9, 9) of an estimate from such evidence, as `Result.covariance`.

    Contours have the deviation that was measured.
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


def truth_in(shot: Shot, gt: Alignment) -> Alignment:
    """The truth in the camera of a shot."""
    rotation, shift = shot.cam_from_first[:3, :3], shot.cam_from_first[:3, 3]
    return Alignment(rotation @ gt.rotation, rotation @ gt.translation + shift, gt.scale)


def _of_first(
    kinds: tuple[str, ...], scene: ObjectScene, options: EvidenceRunOptions
) -> dict[str, Any]:
    """Fields of the first view beyond its keypoints."""
    shot = scene.shots[0]
    fields: dict[str, Any] = {}
    if DEPTH in kinds:
        fields |= {"depth": shot.depths, "depth_sigma": options.depth_sigma}
    if GRAVITY in kinds:
        fields |= {"up": shot.up, "up_sigma_deg": options.up_sigma_deg}
    for kind in kinds:
        if kind == MASK or kind in DAMAGED:
            fields["mask"] = scene.mask(DAMAGED.get(kind, "exact"))
    return fields
