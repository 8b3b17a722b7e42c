"""From minima of the joint estimate to its result."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.fitting.fit import LEAST_LIKELIHOOD
from cadalign.fitting.joint.agreement import summaries_of
from cadalign.fitting.joint.contributions import Basis
from cadalign.fitting.joint.deviations import pose_and_lengths
from cadalign.fitting.joint.model import Model
from cadalign.fitting.joint.prior import ShapePrior
from cadalign.fitting.joint.result import AlignAlternative, AlignResult
from cadalign.fitting.joint.view import View
from cadalign.fitting.joint.warnings import warnings_of
from cadalign.fitting.result import FitStats
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import vector_from_rotation
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.joint.covariance import joint_covariance
from cadalign.solvers.joint.evidence import Evidence, State, points_of

_SAME = 9.0  # squared distance of rotations, in the best one's deviations, of equal estimates


class Minimum(NamedTuple):
    """An estimate under one component of the prior; ``score`` is -2 log of its probability."""

    component: int
    inliers: BoolArray
    evidence: Evidence
    state: State
    cost: float
    score: float


class _Estimate(NamedTuple):
    """A minimum in the terms of the result, points and ``lengths`` of the box with its corners."""

    points: FloatArray
    scale: FloatArray
    poses: tuple[Alignment, ...]
    lengths: FloatArray
    covariance: FloatArray
    of_points: FloatArray
    of_seen: FloatArray
    likelihood: float


def assemble(
    model: Model | ShapeModel,
    prior: ShapePrior,
    views: Sequence[View],
    minima: Sequence[Minimum],
    stats: FitStats,
) -> AlignResult:
    """The result of minima, the likeliest first.

    Its covariance is the second moment, about the best estimate, of the mixture of Gaussians that
    the likely minima are, each with the shape's deviations widened by the inflation.
    """
    likelihoods = [float(np.exp((minima[0].score - each.score) / 2)) for each in minima]
    likely = [
        _estimate(_widened(each, prior.inflation), likelihood, len(prior.ids))
        for each, likelihood in zip(minima, likelihoods, strict=True)
        if likelihood >= LEAST_LIKELIHOOD
    ]
    best, minimum = likely[0], minima[0]
    steps = [_step(best, each) for each in likely]
    covariance, of_points, of_seen = _moments(likely, steps)
    residuals = []
    for view, pose in zip(views, best.poses, strict=True):
        rows = prior.rows_of(view.keypoint_ids, "ids")
        seen = view.camera.project(pose.apply(best.points[rows]))
        residuals.append(seen - cast(FloatArray, view.points_2d))
    of_mean = prior.lengths
    stretch = np.where(of_mean > 0, best.lengths / np.where(of_mean > 0, of_mean, 1.0), 1.0)
    information = np.linalg.pinv(best.covariance[:3, :3]) if len(likely) > 1 else np.zeros((3, 3))
    alternatives = tuple(
        AlignAlternative(each.poses[0], each.points[:-2], each.points[-2:], each.likelihood)
        for each, step in zip(likely[1:], steps[1:], strict=True)
        if float(step[:3] @ information @ step[:3]) > _SAME
    )
    return AlignResult(
        alignment=best.poses[0],
        ids=prior.ids,
        points_3d=best.points[:-2],
        bounds=best.points[-2:],
        poses=best.poses,
        residuals=tuple(residuals),
        inliers=_inliers(prior, views, minimum),
        covariance=covariance,
        points_covariance=of_points[:-2],
        points_cam_covariance=of_seen[:-2],
        stretch=stretch,
        component=minimum.component,
        model=model,
        alternatives=alternatives,
        warnings=warnings_of(minimum.evidence, minimum.state, minimum.cost, best.poses, covariance),
        stats=stats,
        evidence=summaries_of(minimum.evidence, minimum.state, [view.camera for view in views]),
        rig_from_model=_in_rig(views, minimum, best.scale),
        basis=Basis(minimum.evidence, minimum.state),
    )


def _widened(minimum: Minimum, factor: float) -> Minimum:
    """The same points under a prior of wider deviations."""
    if factor == 1:
        return minimum
    shape, state = minimum.evidence.shape, minimum.state
    wide = shape._replace(modes=factor * shape.modes, spread=factor * shape.spread)
    return minimum._replace(
        evidence=minimum.evidence._replace(shape=wide),
        state=state._replace(coefficients=state.coefficients / factor),
    )


def _estimate(minimum: Minimum, likelihood: float, keypoints: int) -> _Estimate:
    scale = np.exp(minimum.state.log_scales)
    rows = np.r_[:keypoints, -2:0]  # without what stands between keypoints and box
    stretched = points_of(minimum.evidence.shape, minimum.state)[rows]
    sighted = np.unique(minimum.evidence.sightings.point)
    seen = stretched[sighted[sighted < keypoints]]
    if len(minimum.evidence.shape.modes):  # a box whose corners were estimated holds what is seen
        stretched[-2] = np.minimum(stretched[-2], seen.min(axis=0, initial=np.inf))
        stretched[-1] = np.maximum(stretched[-1], seen.max(axis=0, initial=-np.inf))
    unknowns, of_points, of_seen = joint_covariance(minimum.evidence, minimum.state)
    return _Estimate(
        stretched / scale,
        scale,
        _poses(minimum, scale),
        stretched[-1] - stretched[-2],
        pose_and_lengths(minimum.evidence, minimum.state, unknowns),
        of_points[rows],
        of_seen[rows],
        likelihood,
    )


def _in_rig(views: Sequence[View], minimum: Minimum, scale: FloatArray) -> Alignment | None:
    """The alignment in the frame that the views share."""
    if views[0].cam_from_rig is None:
        return None
    pose = minimum.state.poses[0]
    return Alignment(pose[:9].reshape(3, 3), pose[9:], scale)


def _moments(
    likely: Sequence[_Estimate], steps: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Second moments (9, 9) and twice (m + 2, 3, 3) of a mixture of estimates about the first.

    ``steps`` lead from the first to each.
    """
    best = likely[0]
    share = 1.0 / sum(each.likelihood for each in likely)
    covariance = share * best.covariance
    of_points, of_seen = share * best.of_points, share * best.of_seen
    for each, step in zip(likely[1:], steps[1:], strict=True):
        weight = share * each.likelihood
        covariance += weight * (each.covariance + step[:, None] * step)
        moved = each.points * each.scale - best.points * best.scale
        of_points += weight * (each.of_points + moved[:, :, None] * moved[:, None, :])
        moved = each.poses[0].apply(each.points) - best.poses[0].apply(best.points)
        of_seen += weight * (each.of_seen + moved[:, :, None] * moved[:, None, :])
    return covariance, of_points, of_seen


def _step(best: _Estimate, other: _Estimate) -> FloatArray:
    """Rotation vector, translation and log lengths (9,) that lead from one estimate to another."""
    first, second = best.poses[0], other.poses[0]
    logs = np.zeros(3)
    safe = (best.lengths > 0) & (other.lengths > 0)
    logs[safe] = np.log(other.lengths[safe] / best.lengths[safe])
    turn = vector_from_rotation(second.rotation @ first.rotation.T)
    return np.concatenate([turn, second.translation - first.translation, logs])


def _inliers(prior: ShapePrior, views: Sequence[View], minimum: Minimum) -> tuple[BoolArray, ...]:
    """The inliers of every view, in its own order of keypoints."""
    names = np.concatenate([prior.rows_of(view.keypoint_ids, "ids") for view in views])
    kept = np.empty(len(names), dtype=bool)
    kept[np.argsort(names, kind="stable")] = minimum.inliers
    ends = np.cumsum([len(view.keypoint_ids) for view in views])
    return tuple(np.split(kept, ends[:-1]))


def _poses(minimum: Minimum, scale: FloatArray) -> tuple[Alignment, ...]:
    """Alignments in every view's camera."""
    rig = minimum.evidence.rig
    poses = []
    for camera, p in zip(rig.cam_from_rig, rig.pose, strict=True):
        pose = minimum.state.poses[p]
        rotation = camera[:9].reshape(3, 3)
        turned = rotation @ pose[:9].reshape(3, 3)
        shift = rotation @ pose[9:] + camera[9:]
        poses.append(Alignment(turned, shift, scale, is_valid=True))
    return tuple(poses)
