"""From likely estimates of all evidence to their result, by whatever search they were found.

Together they are a mixture of Gaussians; of those that are equal under the model's symmetry one
stands for all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, is_number
from cadalign.errors import DegenerateError
from cadalign.estimation.estimates import (
    curvature_of_rotations,
    mean_state,
    pose_and_border,
    pose_and_lengths,
    poses_of,
    widen_box,
    with_box,
)
from cadalign.estimation.fitted import Alternative, FitStats
from cadalign.estimation.focal import prior_of_camera
from cadalign.estimation.image_checks import outside_image
from cadalign.estimation.pack import evidence_of
from cadalign.estimation.prior import camera_like, is_exact, widened, with_known_shape
from cadalign.estimation.problem import Problem
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import Posterior, ViewResult
from cadalign.estimation.search import Minimum
from cadalign.estimation.solve import LEAST_LIKELIHOOD
from cadalign.estimation.symmetry import (
    SAME_SQUARES,
    carried,
    is_same,
    stretched_axes,
    without_free_turns,
)
from cadalign.estimation.uncertainty.contradictions import warnings_of
from cadalign.estimation.uncertainty.evidence import summaries_of
from cadalign.estimation.uncertainty.misfit import unexplained
from cadalign.estimation.uncertainty.shape_posterior import ShapeTails
from cadalign.estimation.uncertainty.summary import (
    EvidenceSummary,
    another_pose,
    uncertainty_of,
    weaknesses,
)
from cadalign.estimation.view import View
from cadalign.estimation.warning import EstimateWarning, Warnings
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera, turned_alignment, turned_covariance
from cadalign.geometry.rotations import nearest_rotation, vector_from_rotation
from cadalign.geometry.symmetry import Symmetry
from cadalign.geometry.symmetry_group import group_of
from cadalign.shapes.parts import inflation_with
from cadalign.solvers.joint.covariance import joint_covariance
from cadalign.solvers.joint.evidence import points_of
from cadalign.solvers.joint.search import refine_joint

_Held = tuple[bool, bool, bool]
_ITERATIONS = 50
_EXPLAINED_KINDS = ("contradiction", "misfit", "outlier", "unit", "noise")
_ALONG_AXES = 1e-6  # of a rotation's entries, that are 0 or 1 where it takes axes to axes


class Estimate(NamedTuple):
    """An estimate: points, the box's corners last, ``lengths`` of the box, covariances.

    Poses, covariances (9, 9) and cameras are those of every view that takes part, in the frames of
    the cameras that were given; ``likelihood`` is relative to the best.
    The optimum is the one of the least cost, which a shape without latent unknowns has.
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
    is_optimum: bool = False


def result_of(
    problem: Problem,
    estimates: Sequence[Estimate],
    *,
    inliers: Sequence[BoolArray],
    is_curved: bool,
    warnings: Warnings,
    evidence: tuple[EvidenceSummary, ...],
    **of_result: Any,
) -> Result:
    """The result of likely estimates, the best first.

    Its covariance is the second moment, about the best estimate, of the mixture of Gaussians that
    the likely ones are.

    The rotations' covariances lack `curvature_of_rotations` where the estimate ``is_curved``;
    ``warnings`` are those beside the ones about uncertainties and alternatives, and ``of_result``
    further fields of `cadalign.Result`.
    """
    prior, views, numbers = problem.prior, problem.given, problem.numbers
    best = estimates[0]
    moments = [_moments(estimates, place) for place in range(len(numbers))]
    covariances = [covariance for covariance, _ in moments]
    if is_curved:
        for covariance in covariances:
            covariance[:3, :3] += curvature_of_rotations(covariance[:3, :3])
    is_far = moments[0][1] > SAME_SQUARES
    others = [each for each, far in zip(estimates, is_far, strict=True) if far]
    alternatives = tuple(
        Alternative(
            each.poses[0], each.likelihood, each.cameras[0], each.points[:-2], each.points[-2:]
        )
        for each, far in zip(estimates, is_far, strict=True)
        if far or (each.is_optimum and each is not best)
    )
    pose, points = best.poses[0], best.points[:-2]
    of_points, of_seen = _moments_of_points(estimates)
    posterior = Posterior.stated(
        covariances[0],
        fisher_covariance=best.covariances[0],
        points_covariance=of_points[:-2],
        points_cam_covariance=of_seen[:-2],
        warnings=(
            *(
                warning
                for view in problem.views
                for warning in outside_image(
                    view.pixels,
                    view.camera,
                    agree=not warnings,
                    view=view.number,
                    where=f"views[{view.number}]: " if len(views) > 1 else "",
                )
            ),
            *weaknesses(pose, uncertainty_of(covariances[0]), best.lengths),
            *warnings,
            *another_pose(
                pose,
                [(each.poses[0], each.likelihood) for each in others],
                covariances[0],
                prior.degrees_of_freedom,
                near=sum(
                    each.likelihood
                    for each, far in zip(estimates[1:], is_far[1:], strict=True)
                    if not far
                ),
            ),
            *(
                EstimateWarning(
                    "left-out",
                    f"views[{number}] is left out: its {len(view.keypoint_ids)} keypoints do not "
                    "determine its pose",
                    number,
                )
                for number, view in enumerate(views)
                if number not in numbers
            ),
        ),
        evidence=evidence,
        degrees_of_freedom=prior.degrees_of_freedom,
    )
    of_views = []
    for number, view in enumerate(views):
        rows, observed = prior.rows_of(view.keypoint_ids, "ids"), view.pixels
        if number in numbers:
            place = numbers.index(number)
            camera, alignment, kept = best.cameras[place], best.poses[place], inliers[place]
            own = Posterior.stated(covariances[place]) if number else posterior
        else:
            camera, alignment = _pose_beside(problem, number, best)
            kept, own = np.zeros(len(rows), dtype=bool), Posterior()
        residuals = camera.project(alignment.apply(points[rows])) - observed
        of_views.append(
            ViewResult(camera, alignment, view.keypoint_ids, observed, residuals, kept, own)
        )
    has_length = prior.lengths > 0
    return Result(
        views=tuple(of_views),
        ids=prior.ids,
        points_3d=points,
        method="align",
        posterior=posterior,
        alternatives=alternatives,
        model=problem.model,
        own_bounds=best.points[-2:],
        own_stretch=np.where(
            has_length, best.lengths / np.where(has_length, prior.lengths, 1), 1.0
        ),
        **of_result,
    )


def _pose_beside(problem: Problem, number: int, best: Estimate) -> tuple[Camera, Alignment]:
    """Camera and pose of a view that takes no part: near the first view's, where its keypoints fit.

    The pose is one of those that explain its keypoints.
    """
    view, facing = problem.given[number], problem.views[number].camera
    cameras = [problem.given[k].camera for k in problem.numbers]
    camera = camera_like(view.camera, dict(zip(cameras, best.cameras, strict=True)))
    if not len(view.keypoint_ids) and view.up is None:
        return camera, best.poses[0]
    alone = View(
        facing if camera.is_wide else camera,
        view.points_2d,
        ids=view.ids,
        sigma=view.sigma,
        up=view.up,
        up_sigma_deg=view.up_sigma_deg,
    )
    turns = [problem.turns[number]]
    evidence = with_known_shape(evidence_of(problem.prior, [alone], turns=turns), best.points)
    state = mean_state(evidence, best.poses[0].packed[None, :12], np.log(best.scale))
    _, _, state = refine_joint(evidence, _ITERATIONS, state)
    pose = state.poses[0]
    return camera, Alignment(pose[:9].reshape(3, 3), pose[9:], best.scale)


def result_of_minima(
    problem: Problem,
    minima: Sequence[Minimum],
    stats: FitStats,
    *,
    has_warnings: bool = True,
) -> Result:
    """The result of minima, of which the likely ones count, with a widened prior of the shape.

    Warnings about contradictions take time.

    Raises DegenerateError if the evidence determines none of them.
    """
    prior, views, model = problem.prior, problem.views, problem.model
    minima = [each for each in minima if np.isfinite(each.score)]
    if not minima:
        raise _undetermined_error()
    minimum = minima[0]
    inflation = prior.inflation
    if all(view.mask is None for view in views):  # a contour is worth as much as many keypoints
        given = len(minimum.evidence.sightings.point)
        inflation = inflation_with(given, inflation, prior.few_keypoints)
    likely: Sequence[Estimate] = ()
    optimum = min(minima, key=lambda each: each.cost) if is_exact(minimum.evidence) else minimum
    for each in minima:
        likelihood = float(np.exp((minimum.score - each.score) / 2))
        if likelihood >= LEAST_LIKELIHOOD or each is optimum:
            evidence, state = widened(each.evidence, each.state, inflation)
            wide = each._replace(evidence=evidence, state=state)
            estimate = _estimate(wide, likelihood, problem)._replace(is_optimum=each is optimum)
            if all(np.isfinite(own).all() for own in estimate.covariances):
                likely = [*likely, estimate]
            elif not likely:
                raise _undetermined_error()
    symmetry, known_axis = getattr(model, "symmetry", None), getattr(model, "known_axis", None)
    x, y, z = (minimum.evidence.scales.free == 0).tolist()
    held = x, y, z
    likely = _one_of_equals(likely, symmetry, held)
    best, in_rig = likely[0], None
    if views[0].cam_from_rig is not None:
        camera, pose = np.asarray(problem.given[0].cam_from_rig), best.poses[0]
        rotation = camera[:3, :3]
        turned = nearest_rotation(rotation.T @ pose.rotation)
        in_rig = Alignment(turned, rotation.T @ (pose.translation - camera[:3, 3]), best.scale)
    tails = ShapeTails(inflation, prior.degrees_of_freedom)
    numbers = [view.number for view in views]
    seen_by = minimum.lenses.cameras_at(minimum.state.log_focals)
    warnings: Warnings = ()
    if has_warnings:
        warnings = warnings_of(minimum.evidence, minimum.state, minimum.cost, tails, numbers)
    if problem.lacks_sigma:
        pixels = [view.pixels for view in views if view.sigma is None]
        warnings = (*unexplained(problem.noise, pixels), *warnings)
    return result_of(
        problem,
        likely,
        inliers=_inliers(problem, minimum),
        is_curved=symmetry is None and not is_exact(minimum.evidence),
        warnings=tuple(warnings),
        evidence=tuple(
            each if each.view is None else replace(each, view=numbers[each.view])
            for each in summaries_of(minimum.evidence, minimum.state, seen_by)
        ),
        cost=minimum.cost,
        stats=stats,
        component=minimum.component,
        sigma=problem.noise if problem.lacks_sigma else common_sigma(views),
        known_axis=known_axis if known_axis and held["xyz".index(known_axis)] else None,
        stretched_axes=stretched_axes(held),
        symmetry=symmetry,
        rig_from_model=in_rig,
        focal="estimate" if minimum.lenses.count else "known",
        focal_prior=prior_of_camera(minimum.lenses.prior, views[0].camera),
    )


def with_mistake(result: Result, mistake: EstimateWarning) -> Result:
    """The result with a mistake in the data in the place of the warnings that it explains."""
    others = [each for each in result.warnings if each.kind not in _EXPLAINED_KINDS]
    return replace(result, posterior=result.posterior.stating(warnings=(mistake, *others)))


def common_sigma(views: Sequence[View]) -> float | None:
    """The standard deviation of all keypoints [px]; None where they do not share one."""
    given = [view.sigma for view in views if len(view.keypoint_ids)]
    first, *others = given or [None]
    is_one = is_number(first) and all(is_number(each) and each == first for each in others)
    return float(cast(float, first)) if is_one else None


def _undetermined_error() -> DegenerateError:
    what = "the evidence does not determine pose and shape"
    return DegenerateError(what, where="views", fix="give more keypoints, or a size")


def _estimate(minimum: Minimum, likelihood: float, problem: Problem) -> Estimate:
    prior, evidence, state = problem.prior, minimum.evidence, minimum.state
    keypoints = len(prior.ids)
    evidence, state = with_box(evidence, state, prior)
    scale = np.exp(state.log_scales)
    rows = np.r_[:keypoints, -2:0]  # without what stands between keypoints and box
    stretched = points_of(evidence.shape, state)[rows]
    if len(evidence.shape.modes):  # a box whose corners were estimated holds what is seen
        sighted = np.unique(evidence.sightings.point)
        widen_box(stretched, sighted[sighted < keypoints])
    found, poses = joint_covariance(evidence, state), poses_of(evidence, state)
    cameras = minimum.lenses.cameras_at(state.log_focals)
    estimate = Estimate(
        stretched / scale,
        scale,
        tuple(poses[number] for number in problem.numbers),
        stretched[-1] - stretched[-2],
        tuple(
            pose_and_lengths(
                evidence, state, pose_and_border(found, int(evidence.rig.pose[number])), number
            )
            for number in problem.numbers
        ),
        found.points[rows],
        found.seen[rows],
        likelihood,
        tuple(cameras[number] for number in problem.numbers),
    )
    return as_given(estimate, problem)


def as_given(estimate: Estimate, problem: Problem) -> Estimate:
    """An estimate in the frames of turned lenses as that in the frames that were given."""
    numbers = problem.numbers
    turns = [problem.turns[number] for number in numbers]
    first = turns[0]
    if all(problem.views[n].camera == problem.given[n].camera for n in numbers):
        return estimate
    wide = [problem.given[number].camera for number in numbers]
    return estimate._replace(
        poses=tuple(map(turned_alignment, estimate.poses, turns)),
        covariances=tuple(map(turned_covariance, estimate.covariances, turns)),
        of_seen=first @ estimate.of_seen @ first.T,
        cameras=tuple(
            given if given.is_wide else own
            for given, own in zip(wide, estimate.cameras, strict=True)
        ),
    )


def _inliers(problem: Problem, minimum: Minimum) -> list[BoolArray]:
    """The inliers of every view that takes part, in its own order of keypoints."""
    views = [problem.views[number] for number in problem.numbers]
    names = np.concatenate([problem.prior.rows_of(view.keypoint_ids, "ids") for view in views])
    kept = np.empty(len(names), dtype=bool)
    kept[np.argsort(names, kind="stable")] = minimum.inliers
    ends = np.cumsum([len(view.keypoint_ids) for view in views])
    return np.split(kept, ends[:-1])


def _moments(estimates: Sequence[Estimate], view: int) -> tuple[FloatArray, FloatArray]:
    """Second moments of estimates about the first, in a view's camera, and distances (L,).

    These are squared distances of the rotations from the first one's, in its standard deviations;
    infinite where it has none.
    """
    best, *others = estimates
    total, distances = best.likelihood * best.covariances[view], np.zeros(len(estimates))
    try:
        root = np.linalg.inv(np.linalg.cholesky(best.covariances[view][:3, :3]))
    except np.linalg.LinAlgError:
        root = np.full((3, 3), np.nan)
    for k, each in enumerate(others, start=1):
        step = _step(best, each, view)
        total += each.likelihood * (each.covariances[view] + step[:, None] * step)
        distance = np.square(root @ step[:3]).sum()
        distances[k] = distance if np.isfinite(distance) else np.inf
    return total / sum(each.likelihood for each in estimates), distances


def _step(first: Estimate, second: Estimate, view: int) -> FloatArray:
    """Rotation vector, translation, log lengths and log focal length between estimates."""
    start, end = first.poses[view], second.poses[view]
    before = [*first.lengths.tolist(), first.cameras[view].fx]
    after = [*second.lengths.tolist(), second.cameras[view].fx]
    turn = vector_from_rotation(end.rotation @ start.rotation.T)
    logs = [math.log(b / a) if a > 0 < b else 0.0 for a, b in zip(before, after, strict=True)]
    step = [*turn, *(end.translation - start.translation), *logs]
    return np.array(step[: len(first.covariances[view])])


def _moments_of_points(estimates: Sequence[Estimate]) -> tuple[FloatArray, FloatArray]:
    """Second moments (m, 3, 3) of points about the first estimate, in model and first camera."""
    best = estimates[0]
    if len(estimates) == 1:
        return best.of_points, best.of_seen
    weights = np.array([each.likelihood for each in estimates])
    weights /= weights.sum()

    def total(covariances: list[FloatArray], places: list[FloatArray]) -> FloatArray:
        gaps = np.array(places) - places[0]
        squares = gaps[..., None] * gaps[..., None, :]
        return np.asarray(np.tensordot(weights, np.array(covariances) + squares, axes=1))

    return (
        total([e.of_points for e in estimates], [e.points * e.scale for e in estimates]),
        total([e.of_seen for e in estimates], [e.poses[0].apply(e.points) for e in estimates]),
    )


def _one_of_equals(
    likely: Sequence[Estimate], symmetry: Symmetry | None, held: _Held
) -> Sequence[Estimate]:
    """Estimates in their canonical form, without those that are equal to the first.

    ``held`` are the axes whose scale is.
    """
    if symmetry is None or group_of(symmetry).is_trivial:
        return likely
    group = group_of(symmetry)
    best, *others = (_canonical(each, symmetry, held) for each in likely)
    covariance = best.covariances[0]
    return [
        best,
        *(each for each in others if not is_same(group, best.poses[0], each.poses[0], covariance)),
    ]


def _canonical(estimate: Estimate, symmetry: Symmetry, held: _Held) -> Estimate:
    """The canonical one of all equal estimates, without standard deviations that mean nothing."""
    best = group_of(symmetry).canonical(estimate.poses[0], held=held)
    turn, shift, scale = best.motion[:3, :3], best.motion[:3, 3], best.alignment.scale
    poses: list[Alignment] = []
    covariances = []
    for given, covariance in zip(estimate.poses, estimate.covariances, strict=True):
        pose = Alignment(given.rotation @ turn, given.translation + given.linear @ shift, scale)
        equal = replace(best, alignment=pose if poses else best.alignment)
        poses.append(equal.alignment)
        covariances.append(without_free_turns(carried(covariance, given, equal), equal))
    points = best.relabelled(estimate.points)
    entries = np.abs(turn)
    if (np.minimum(entries, 1 - entries) > _ALONG_AXES).any():
        points[-2:] = estimate.points[-2:]  # a box that leaves the axes stays as the symmetric is
    else:
        points[-2:] = np.sort(points[-2:], axis=0)
    return estimate._replace(
        points=points,
        scale=scale,
        poses=tuple(poses),
        lengths=(points[-1] - points[-2]) * scale,
        covariances=tuple(covariances),
        of_points=turn.T @ estimate.of_points @ turn,
    )
