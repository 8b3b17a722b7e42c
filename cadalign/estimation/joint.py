"""Last stage of an estimate: combine likely estimates to a result.

The estimates form a mixture of Gaussians; equivalent ones under the model's symmetry count once.
`fit_jointly` returns `FittedKeypoints` instead, for `cadalign.fit`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, is_number
from cadalign.errors import DegenerateError
from cadalign.estimation.estimates import (
    Estimate,
    canonical_estimates,
    curvature_of_rotations,
    enlarge_boxes,
    estimate_box,
    pose_and_lengths,
    poses_of,
    second_moments,
    steps_between,
    undo_turns,
)
from cadalign.estimation.model import Model
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.prior import camera_like, is_exact, redundancy_of, widen_prior
from cadalign.estimation.problem import Problem, compile_problem
from cadalign.estimation.problems import Problems, no_alignment_error, too_few_error
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import (
    LEAST_LIKELIHOOD,
    NO_NOTES,
    Alternative,
    EstimateWarning,
    EvidenceSummary,
    FitStats,
    FittedKeypoints,
    OutlineNotes,
    Posterior,
    ViewResult,
    Warnings,
    alternatives_of,
    create_unchecked,
    keypoint_summary,
)
from cadalign.estimation.search import Minimum, search
from cadalign.estimation.symmetry import SAME_SQUARES, stretched_axes
from cadalign.estimation.uncertainty.doubts import (
    noise_doubts,
    order_warnings,
    outside_image,
    pose_doubts,
    rejections,
    stretch_doubts,
)
from cadalign.estimation.uncertainty.residuals import summaries_of
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment, describe_plane
from cadalign.geometry.rotations import nearest_rotation
from cadalign.io.focal import prior_of_camera
from cadalign.shapes.parts import inflation_with
from cadalign.solvers.joint.covariance import joint_covariance, pose_and_border
from cadalign.solvers.joint.evidence import points_of


def result_of(
    problem: Problem,
    estimates: Sequence[Estimate],
    *,
    inliers: Sequence[BoolArray],
    is_curved: bool,
    evidence: Sequence[EvidenceSummary] = (),
    redundancy: int,
    score: float | None = None,
    notes: OutlineNotes = NO_NOTES,
    **of_result: Any,
) -> Result:
    """The result of likely estimates, the best first.

    Its covariance is the second moment of their mixture about the best estimate, plus
    `curvature_of_rotations` if it ``is_curved``; ``of_result`` are further fields.
    """
    prior, views, numbers = problem.prior, problem.given, problem.numbers
    best = estimates[0]
    steps = [steps_between(estimates, place) for place in range(len(numbers))]
    covariances = [
        second_moments(estimates, [each.covariances[place] for each in estimates], own)
        for place, own in enumerate(steps)
    ]
    if is_curved:
        for covariance in covariances:
            covariance[:3, :3] += curvature_of_rotations(covariance[:3, :3])
    turns, of_turns = steps[0][:, :3], best.covariances[0][:3, :3]
    squares = (turns @ np.linalg.pinv(of_turns, hermitian=True) * turns).sum(axis=1)
    is_far = squares > SAME_SQUARES
    judged = list(zip(estimates, is_far, strict=True))
    others = [(each.poses[0], each.likelihood) for each, far in judged if far]
    alternatives = tuple(
        Alternative(
            each.poses[0], each.likelihood, each.cameras[0], each.points[:-2], each.points[-2:]
        )
        for each, far in judged
        if far or (each.is_optimum and each is not best)
    )
    pose, points = best.poses[0], best.points[:-2]
    places = np.array([each.points * each.scale for each in estimates])
    seen = np.array([each.poses[0].apply(each.points) for each in estimates])
    of_points = second_moments(estimates, [each.points_covariance for each in estimates], places)
    of_seen = second_moments(estimates, [each.points_cam_covariance for each in estimates], seen)
    of_views, summaries = [], list(evidence)
    known = dict(zip((views[k].camera for k in numbers), best.cameras, strict=True))
    for number, view in enumerate(views):
        rows, observed = prior.rows_of(view.keypoint_ids, "ids"), view.pixels
        # A view without evidence gets an arbitrary pose.
        camera, alignment, own = camera_like(view.camera, known), best.poses[0], Posterior()
        kept = np.zeros(len(rows), dtype=bool)
        if number in numbers:
            place = numbers.index(number)
            camera, alignment, kept = best.cameras[place], best.poses[place], inliers[place]
            own = Posterior(covariances[place])
        residuals = camera.project(alignment.apply(points[rows])) - observed
        of_views.append(
            ViewResult(camera, alignment, view.keypoint_ids, observed, residuals, kept, own)
        )
        if kept.any():
            sigma = problem.noise if view.sigma is None else view.sigma
            summaries.append(keypoint_summary(number, residuals, kept, sigma))
    summaries.sort(key=lambda each: (each.view is None, each.view, each.kind != "keypoints"))
    posterior = Posterior(
        covariances[0],
        fisher_covariance=best.covariances[0],
        points_covariance=of_points[:-2],
        points_cam_covariance=of_seen[:-2],
        warnings=(
            *pose_doubts(
                pose,
                others,
                covariances[0],
                prior.degrees_of_freedom,
                near=sum(each.likelihood for each, far in judged[1:] if not far),
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
            *notes.warnings,
        ),
        evidence=(*summaries, *notes.evidence),
        degrees_of_freedom=prior.degrees_of_freedom,
        redundancy=redundancy,
        score=score,
    )
    of_views[0] = replace(of_views[0], posterior=posterior)
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
        sigma=problem.noise if problem.lacks_sigma else common_sigma(problem.views),
        **of_result,
    )


def result_of_minima(
    problem: Problem,
    minima: Sequence[Minimum],
    stats: FitStats,
    *,
    notes: OutlineNotes = NO_NOTES,
) -> Result:
    """The result of minima at the calibrated prior; raises DegenerateError if undetermined."""
    prior, views, model = problem.prior, problem.views, problem.model
    minima = [each for each in minima if np.isfinite(each.score)]
    if not minima:
        raise _undetermined_error()
    minimum = minima[0]
    inflation = prior.inflation
    if all(view.mask is None for view in views):  # a contour counts as many keypoints
        given = len(minimum.evidence.sightings.point)
        inflation = inflation_with(given, inflation, prior.few_keypoints)
    likely: Sequence[Estimate] = ()
    optimum = min(minima, key=lambda each: each.cost) if is_exact(minimum.evidence) else minimum
    for each in minima:
        likelihood = float(np.exp((minimum.score - each.score) / 2))
        if likelihood >= LEAST_LIKELIHOOD or each is optimum:
            evidence, state = widen_prior(each.evidence, each.state, inflation)
            wide = each._replace(evidence=evidence, state=state)
            estimate = _estimate_at(wide, likelihood, problem)._replace(is_optimum=each is optimum)
            if all(np.isfinite(own).all() for own in estimate.covariances):
                likely = [*likely, estimate]
            elif not likely:
                raise _undetermined_error()
    symmetry = getattr(model, "symmetry", None)
    x, y, z = (minimum.evidence.scales.free == 0).tolist()
    held = x, y, z
    likely = canonical_estimates(likely, symmetry, held)
    best, in_rig = likely[0], None
    if views[0].cam_from_rig is not None:
        camera, pose = np.asarray(problem.given[0].cam_from_rig), best.poses[0]
        rotation = camera[:3, :3]
        turned = nearest_rotation(rotation.T @ pose.rotation)
        in_rig = Alignment(turned, rotation.T @ (pose.translation - camera[:3, 3]), best.scale)

    return result_of(
        problem,
        likely,
        inliers=_inliers(problem, minimum),
        is_curved=symmetry is None and not is_exact(minimum.evidence),
        notes=notes,
        evidence=summaries_of(minimum.evidence, minimum.state),
        redundancy=redundancy_of(minimum.evidence),
        cost=minimum.cost,
        score=minimum.score,
        stats=stats,
        component=minimum.component,
        stretched_axes=stretched_axes(held),
        symmetry=symmetry,
        rig_from_model=in_rig,
        focal="estimate" if minimum.lenses.count else "known",
        focal_prior=prior_of_camera(minimum.lenses.prior, views[0].camera),
    )


class DiagnosedPosterior(Posterior):
    """A posterior that runs the diagnosis when its warnings are first read."""

    stated: Warnings
    causes: Callable[[], Warnings]

    @cached_property
    def warnings(self) -> Warnings:
        return (*self.causes(), *self.stated)

    def __getstate__(self) -> dict[str, Any]:
        """The fields to pickle, with computed warnings."""
        own = vars(self) | {"warnings": self.warnings}
        return {name: own[name] for name in own if name != "causes"}


def add_diagnosis(
    result: Result,
    diagnosis: Callable[[], EstimateWarning | None],
    views: Sequence[View],
    ransac: RansacOptions | None,
) -> Result:
    """Add the diagnosis, and warnings about noise and positions of keypoints, to a result."""
    causes = partial(_causes, result, diagnosis, views, ransac)
    known = vars(result.posterior) | {"causes": causes, "stated": result.warnings}
    known.pop("warnings")
    return replace(result, posterior=create_unchecked(DiagnosedPosterior, known))


def _causes(
    result: Result,
    diagnosis: Callable[[], EstimateWarning | None],
    views: Sequence[View],
    ransac: RansacOptions | None,
) -> Warnings:
    cause, sigma = diagnosis(), result.sigma
    causes: Warnings = ()
    lacking = [view.pixels for view in views if view.sigma is None and len(view.keypoint_ids)]
    if lacking and sigma is not None and not (cause and cause.kind == "mistake"):
        causes = noise_doubts(sigma, lacking)
    placed = tuple(
        warning
        for view in views
        for warning in outside_image(
            view.pixels,
            view.camera,
            cause=cause or next(iter(causes), None),
            sigma=view.sigma,
            view=view.number,
            where=f"views[{view.number}]: " if len(views) > 1 else "",
        )
    )
    found = (*causes, *order_warnings(placed, cause))
    if cause is None and result.std is not None and isinstance(result.model, Model):
        found += stretch_doubts(result.alignment, result.std, result.model.fit_options())
    if ransac is None or (cause is not None and cause.kind == "mistake"):
        return found
    return found + rejections(result.residuals, result.inliers, ransac, common_sigma(views))


def common_sigma(views: Sequence[View]) -> float | None:
    """The standard deviation [px] that all keypoints share; None if they share none."""
    given = [view.sigma for view in views if len(view.keypoint_ids)]
    first, *others = given or [None]
    is_one = is_number(first) and all(is_number(each) and each == first for each in others)
    return float(cast(float, first)) if is_one else None


def _undetermined_error() -> DegenerateError:
    what = "the evidence does not determine pose and shape"
    return DegenerateError(what, where="views", fix="give more keypoints, or a size")


def _estimate_at(minimum: Minimum, likelihood: float, problem: Problem) -> Estimate:
    prior, evidence, state = problem.prior, minimum.evidence, minimum.state
    keypoints = len(prior.ids)
    evidence, state = estimate_box(evidence, state, prior)
    scale = np.exp(state.log_scales)
    rows = np.r_[:keypoints, -2:0]  # without points of outlines
    stretched = points_of(evidence.shape, state)[rows]
    if len(evidence.shape.modes):  # an estimated box contains the seen keypoints
        sighted = np.unique(evidence.sightings.point)
        stretched = enlarge_boxes(stretched, sighted[sighted < keypoints])
    found, poses = joint_covariance(evidence, state), poses_of(evidence, state)
    cameras = minimum.lenses.cameras_at(state.log_focals)
    estimate = Estimate(
        stretched / scale,
        scale,
        tuple(poses[number] for number in problem.numbers),
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
    return undo_turns(estimate, problem)


def _inliers(problem: Problem, minimum: Minimum) -> list[BoolArray]:
    """The inliers of each view that takes part, in the view's order of keypoints."""
    views = [problem.views[number] for number in problem.numbers]
    names = np.concatenate([problem.prior.rows_of(view.keypoint_ids, "ids") for view in views])
    kept = np.empty(len(names), dtype=bool)
    kept[np.argsort(names, kind="stable")] = minimum.inliers
    ends = np.cumsum([len(view.keypoint_ids) for view in views])
    return np.split(kept, ends[:-1])


def fit_jointly(
    problems: Problems,
    options: FitOptions,
    ransac: RansacOptions | None,
    scores: npt.ArrayLike | None,
    start: float,
) -> FittedKeypoints:
    """Fit one problem with the joint solver; the time starts at ``start`` [s].

    Raises DegenerateError if no minimum is determined; NoConsensusError as `search`.
    """
    points, pixels = problems.points_3d.copy(), problems.points_2d
    if len(points) < options.min_points:
        raise too_few_error(len(points), options)
    model = Model(points_3d=points, stretch=options.stretch, stretch_sigma=options.stretch_sigma)
    view = View(problems.camera, pixels, sigma=options.sigma, scores=scores)
    compiled = compile_problem(model, [view], None, [None], options, ransac)
    problem, minima, iterations, hypotheses = search(compiled, [[None]])
    if ransac is None:  # sorted by cost alone, without the volume
        minima = sorted((each._replace(score=each.cost) for each in minima), key=lambda m: m.score)
    if not minima:
        raise no_alignment_error()
    best = minima[0]
    costs = [each.score for each in minima]
    poses = [poses_of(each.evidence, each.state)[0] for each in minima]
    cameras = [each.lenses.cameras_at(each.state.log_focals)[0] for each in minima]
    found = joint_covariance(best.evidence, best.state)
    covariance = pose_and_lengths(best.evidence, best.state, pose_and_border(found, 0))
    if not np.isfinite(covariance).all():
        raise DegenerateError(
            "the alignment is not determined"
            + (f": {why}" if (why := describe_plane(points)) else ""),
            where="points_3d",
            fix="add keypoints elsewhere, hold scales with stretch=, or give a prior",
        )
    residuals = cameras[0].project_where_ahead(poses[0].apply(points)) - pixels
    stats = FitStats(iterations, hypotheses, time.perf_counter() - start)
    return FittedKeypoints(
        points,
        residuals,
        best.inliers,
        poses[0],
        cameras[0],
        options,
        sigma=problem.noise if problem.lacks_sigma else common_sigma([view]),
        fisher_covariance=covariance,
        cost=best.cost,
        alternatives=alternatives_of(points, poses, cameras, costs),
        method="optimal" if ransac is None else "ransac-optimal",
        stats=stats,
    )
