"""From minima of the joint estimate to its result."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import DegenerateError
from cadalign.estimation.estimates import (
    Estimate,
    curvature_of_rotations,
    is_exact,
    is_other,
    moments_of_estimates,
    one_of_equals,
    pose_and_border,
    pose_and_lengths,
    stretch_of,
    widened,
    with_box,
)
from cadalign.estimation.model import Model
from cadalign.estimation.prior import ShapePrior
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import Alternative, FitStats, ViewResult
from cadalign.estimation.search import Minimum
from cadalign.estimation.solve import LEAST_LIKELIHOOD
from cadalign.estimation.symmetry import stretched_axes
from cadalign.estimation.uncertainty.evidence import Basis, summaries_of
from cadalign.estimation.uncertainty.stated import Stated
from cadalign.estimation.uncertainty.warnings import another_pose, warnings_of
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import nearest_rotation
from cadalign.shapes.inflation import inflation_with
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.joint.covariance import joint_covariance
from cadalign.solvers.joint.evidence import points_of


def assemble(
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
    likely = one_of_equals(likely, symmetry, held)
    best = likely[0]
    moments = moments_of_estimates(likely)
    covariances = [moments.covariance]
    covariances += [
        moments_of_estimates(likely, view).covariance for view in range(1, len(best.poses))
    ]
    if symmetry is None and not is_exact(minimum.evidence):
        for covariance in covariances:
            covariance[:3, :3] += curvature_of_rotations(covariance[:3, :3])
    alternatives = tuple(
        Alternative(
            each.poses[0], each.likelihood, each.cameras[0], each.points[:-2], each.points[-2:]
        )
        for k, each in enumerate(likely)
        if is_other(moments, k)
    )
    statistics = Stated(
        covariances[0],
        best.covariance,
        moments.of_points[:-2],
        moments.of_seen[:-2],
        warnings=(
            *warnings_of(
                minimum.evidence, minimum.state, minimum.cost, best.poses, moments.covariance
            ),
            *another_pose(best.poses[0], alternatives),
        ),
        evidence=summaries_of(minimum.evidence, minimum.state, best.cameras),
        degrees_of_freedom=prior.degrees_of_freedom,
        basis=Basis(*widened(minimum.evidence, minimum.state, prior.inflation)),
    )
    of_views: list[ViewResult] = []
    inliers_of = _inliers(prior, views, minimum)
    kept = zip(views, best.cameras, best.poses, covariances, inliers_of, strict=True)
    for view, camera, pose, covariance, inliers in kept:
        rows = prior.rows_of(view.keypoint_ids, "ids")
        observed = cast(FloatArray, view.points_2d)
        residuals = camera.project(pose.apply(best.points[rows])) - observed
        stated = Stated(covariance) if of_views else statistics
        of_views.append(
            ViewResult(camera, pose, view.keypoint_ids, observed, residuals, inliers, stated)
        )
    known_axis = getattr(model, "known_axis", None)
    return Result(
        views=tuple(of_views),
        ids=prior.ids,
        points_3d=best.points[:-2],
        method="align",
        statistics=statistics,
        known_axis=known_axis if known_axis and held["xyz".index(known_axis)] else None,
        stretched_axes=stretched_axes(held),
        cost=minimum.cost,
        alternatives=alternatives,
        stats=stats,
        symmetry=symmetry,
        model=model,
        component=minimum.component,
        rig_from_model=_in_rig(views, minimum, best),
        own_bounds=best.points[-2:],
        focal="estimate" if minimum.lenses.count else "known",
        focal_prior=minimum.lenses.prior,
        own_stretch=stretch_of(best.lengths, prior.lengths),
    )


def _widened(minimum: Minimum, factor: float) -> Minimum:
    """The same points under a prior of wider deviations."""
    evidence, state = widened(minimum.evidence, minimum.state, factor)
    return minimum._replace(evidence=evidence, state=state)


def _estimate(minimum: Minimum, likelihood: float, prior: ShapePrior) -> Estimate:
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
    return Estimate(
        stretched / scale,
        scale,
        _poses(minimum, scale),
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


def _in_rig(views: Sequence[View], minimum: Minimum, best: Estimate) -> Alignment | None:
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
