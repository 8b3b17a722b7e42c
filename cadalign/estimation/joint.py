"""From minima of the joint estimate to its result.

All likely estimates together are a mixture of Gaussians; of those that are equal under the model's
symmetry one stands for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import DegenerateError
from cadalign.estimation.assemble import result_of_evidence
from cadalign.estimation.estimates import (
    curvature_of_rotations,
    pose_and_border,
    pose_and_lengths,
    poses_of,
    with_box,
)
from cadalign.estimation.model import Model
from cadalign.estimation.prior import ShapePrior, is_exact, widened
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import Alternative, FitStats
from cadalign.estimation.search import Minimum
from cadalign.estimation.solve import LEAST_LIKELIHOOD
from cadalign.estimation.symmetry import carried, is_same, stretched_axes, without_free_turns
from cadalign.estimation.uncertainty.contradictions import warnings_of
from cadalign.estimation.uncertainty.evidence import Basis, summaries_of
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import nearest_rotation
from cadalign.geometry.symmetry import Symmetry
from cadalign.geometry.symmetry_group import Equal, group_of
from cadalign.shapes.inflation import inflation_with
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.joint.covariance import joint_covariance
from cadalign.solvers.joint.evidence import points_of
from cadalign.solvers.marginal.moments import Likely, Moments, moments_of

_Held = tuple[bool, bool, bool]

_ALONG_AXES = 1e-6  # of a rotation's entries, that are 0 or 1 where it takes axes to axes


class _Estimate(NamedTuple):
    """An estimate: points, the box's corners last, ``lengths`` of the box, covariances.

    Poses and covariances (9, 9) are those in every view.
    """

    points: FloatArray
    scale: FloatArray
    poses: tuple[Alignment, ...]
    lengths: FloatArray
    covariances: tuple[FloatArray, ...]
    of_points: FloatArray
    of_seen: FloatArray
    likelihood: float
    cameras: tuple[Camera, ...]

    @property
    def covariance(self) -> FloatArray:
        """In the first view."""
        return self.covariances[0]


def result_of_minima(
    model: Model | ShapeModel,
    prior: ShapePrior,
    views: Sequence[View],
    minima: Sequence[Minimum],
    stats: FitStats,
) -> Result:
    """The result of minima, the likeliest first.

    Its covariance is the second moment, about the best estimate, of the mixture of Gaussians that
    the likely minima are, each with the shape's deviations widened by the inflation.

    Raises
    ------
    DegenerateError
        If the evidence determines none of them.
    """
    minima = [each for each in minima if np.isfinite(each.score)]
    if not minima:
        what = "the evidence does not determine pose and shape"
        raise DegenerateError(what, where="views", fix="give more keypoints, or a size")
    likelihoods = [float(np.exp((minima[0].score - each.score) / 2)) for each in minima]
    inflation = prior.inflation
    if all(view.mask is None for view in views):  # a contour tells as much as many keypoints
        given = len(minima[0].evidence.sightings.point)
        inflation = inflation_with(given, inflation, prior.few_keypoints)
    likely = [
        _estimate(_widened(each, inflation), likelihood, prior)
        for each, likelihood in zip(minima, likelihoods, strict=True)
        if likelihood >= LEAST_LIKELIHOOD
    ]
    minimum = minima[0]
    symmetry = model.symmetry if isinstance(model, Model) else None
    x, y, z = (minimum.evidence.scales.free == 0).tolist()
    held = x, y, z
    likely = _one_of_equals(likely, symmetry, held)
    best = likely[0]
    moments = _moments(likely)
    covariances = [moments.covariance]
    covariances += [_moments(likely, view).covariance for view in range(1, len(best.poses))]
    if symmetry is None and not is_exact(minimum.evidence):
        for covariance in covariances:
            covariance[:3, :3] += curvature_of_rotations(covariance[:3, :3])
    known_axis = getattr(model, "known_axis", None)
    return result_of_evidence(
        model,
        prior,
        views,
        [
            Alternative(
                each.poses[0], each.likelihood, each.cameras[0], each.points[:-2], each.points[-2:]
            )
            for each in likely
        ],
        moments,
        poses=best.poses,
        cameras=best.cameras,
        inliers=_inliers(prior, views, minimum),
        covariances=covariances,
        lengths=best.lengths,
        statements={
            "fisher_covariance": best.covariance,
            "warnings": warnings_of(
                minimum.evidence, minimum.state, minimum.cost, best.poses[0], moments.covariance
            ),
            "evidence": summaries_of(minimum.evidence, minimum.state, best.cameras),
            "basis": Basis(*widened(minimum.evidence, minimum.state, prior.inflation)),
        },
        known_axis=known_axis if known_axis and held["xyz".index(known_axis)] else None,
        stretched_axes=stretched_axes(held),
        cost=minimum.cost,
        stats=stats,
        symmetry=symmetry,
        component=minimum.component,
        rig_from_model=_in_rig(views, minimum, best),
        focal="estimate" if minimum.lenses.count else "known",
        focal_prior=minimum.lenses.prior,
    )


def _widened(minimum: Minimum, factor: float) -> Minimum:
    """The same points under a prior of wider deviations."""
    evidence, state = widened(minimum.evidence, minimum.state, factor)
    return minimum._replace(evidence=evidence, state=state)


def _estimate(minimum: Minimum, likelihood: float, prior: ShapePrior) -> _Estimate:
    keypoints = len(prior.ids)
    if prior.box_margins is not None:
        evidence, state = with_box(minimum.evidence, minimum.state, keypoints, prior.box_margins)
        minimum = minimum._replace(evidence=evidence, state=state)
    scale = np.exp(minimum.state.log_scales)
    rows = np.r_[:keypoints, -2:0]  # without what stands between keypoints and box
    stretched = points_of(minimum.evidence.shape, minimum.state)[rows]
    sighted = np.unique(minimum.evidence.sightings.point)
    seen = stretched[sighted[sighted < keypoints]]
    if len(minimum.evidence.shape.modes):  # a box whose corners were estimated holds what is seen
        stretched[-2] = np.minimum(stretched[-2], seen.min(axis=0, initial=np.inf))
        stretched[-1] = np.maximum(stretched[-1], seen.max(axis=0, initial=-np.inf))
    found = joint_covariance(minimum.evidence, minimum.state)
    return _Estimate(
        stretched / scale,
        scale,
        tuple(poses_of(minimum.evidence, minimum.state)),
        stretched[-1] - stretched[-2],
        tuple(
            pose_and_lengths(
                minimum.evidence, minimum.state, pose_and_border(found, int(pose)), view
            )
            for view, pose in enumerate(minimum.evidence.rig.pose)
        ),
        found.points[rows],
        found.seen[rows],
        likelihood,
        tuple(minimum.lenses.cameras_at(minimum.state.log_focals)),
    )


def _in_rig(views: Sequence[View], minimum: Minimum, best: _Estimate) -> Alignment | None:
    """The alignment in the frame that the views share."""
    if views[0].cam_from_rig is None:
        return None
    camera = minimum.evidence.rig.cam_from_rig[0]
    rotation, shift = camera[:9].reshape(3, 3), camera[9:]
    pose = best.poses[0]
    turned = nearest_rotation(rotation.T @ pose.rotation)
    return Alignment(turned, rotation.T @ (pose.translation - shift), best.scale)


def _inliers(prior: ShapePrior, views: Sequence[View], minimum: Minimum) -> tuple[BoolArray, ...]:
    """The inliers of every view, in its own order of keypoints."""
    names = np.concatenate([prior.rows_of(view.keypoint_ids, "ids") for view in views])
    kept = np.empty(len(names), dtype=bool)
    kept[np.argsort(names, kind="stable")] = minimum.inliers
    ends = np.cumsum([len(view.keypoint_ids) for view in views])
    return tuple(np.split(kept, ends[:-1]))


def _moments(estimates: Sequence[_Estimate], view: int = 0) -> Moments:
    """Second moments of estimates about the first, in a view's camera; of points in the first."""
    poses = [
        np.concatenate([each.poses[view].rotation.ravel(), each.poses[view].translation])
        for each in estimates
    ]
    return moments_of(
        Likely(
            np.array(poses),
            np.array([each.points * each.scale for each in estimates]),
            np.array([_lengths_and_focal(each, view) for each in estimates]),
            np.array([each.covariances[view] for each in estimates]),
            np.array([each.of_points for each in estimates]),
            np.array([each.of_seen for each in estimates]),
            np.array([each.likelihood for each in estimates]),
        )
    )


def _lengths_and_focal(estimate: _Estimate, view: int) -> FloatArray:
    """Lengths (3,) of the box and, where its covariance has it, the focal length of a view."""
    focal = [estimate.cameras[view].fx]
    return np.append(estimate.lengths, focal[: len(estimate.covariances[view]) - 9])


def _one_of_equals(
    likely: Sequence[_Estimate], symmetry: Symmetry | None, held: _Held
) -> list[_Estimate]:
    """Estimates in their canonical form, without those that are equal to the first.

    ``held`` are the axes whose scale is.
    """
    if symmetry is None or group_of(symmetry).is_trivial:
        return list(likely)
    group = group_of(symmetry)
    found = [_canonical(each, symmetry, held) for each in likely]
    best = found[0]
    return [best] + [
        each
        for each in found[1:]
        if not is_same(group, best.poses[0], each.poses[0], best.covariance)
    ]


def _canonical(estimate: _Estimate, symmetry: Symmetry, held: _Held) -> _Estimate:
    """The canonical one of all equal estimates, without deviations that mean nothing."""
    best = group_of(symmetry).canonical(estimate.poses[0], held=held)
    turn = best.motion[:3, :3]
    poses = (best.alignment, *(_turned(pose, best) for pose in estimate.poses[1:]))
    covariances = []
    for given, pose, covariance in zip(estimate.poses, poses, estimate.covariances, strict=True):
        equal = replace(best, alignment=pose)
        covariances.append(without_free_turns(carried(covariance, given, equal), equal))
    points = best.relabelled(estimate.points)
    points[-2:] = _turned_box(estimate.points[-2:], best)
    return estimate._replace(
        points=points,
        scale=best.alignment.scale,
        poses=poses,
        lengths=(points[-1] - points[-2]) * best.alignment.scale,
        covariances=tuple(covariances),
        of_points=turn.T @ estimate.of_points @ turn,
    )


def _turned(pose: Alignment, best: Equal) -> Alignment:
    """An alignment in another view after the symmetry's motion."""
    shift = pose.translation + pose.linear @ best.motion[:3, 3]
    return Alignment(pose.rotation @ best.motion[:3, :3], shift, best.alignment.scale)


def _turned_box(corners: FloatArray, best: Equal) -> FloatArray:
    """Corners (2, 3) of the object's box; a box that leaves the axes stays as the symmetric is."""
    entries = np.abs(best.motion[:3, :3])
    if (np.minimum(entries, 1 - entries) > _ALONG_AXES).any():
        return corners
    return np.sort(best.relabelled(corners), axis=0)
