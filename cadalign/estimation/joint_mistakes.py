"""Usual mistakes in a joint estimate's keypoints: undone, and the estimate made anew."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, DegenerateError
from cadalign.estimation.joint_robust import OUTLIER_COST
from cadalign.estimation.mistakes import (
    DOWNWARD,
    INVERTED,
    Explained,
    Mistake,
    find_in_all,
    find_likelier,
    find_mistake,
    other_sizes,
)
from cadalign.estimation.options import RansacOptions
from cadalign.estimation.prior import is_exact
from cadalign.estimation.problem import Problem
from cadalign.estimation.search import (
    Minimum,
    minima_at_noise,
    outlier_areas,
    thresholds,
)
from cadalign.estimation.uncertainty.evidence import redundancy_of
from cadalign.estimation.warning import EstimateWarning

_FEW_REJECTED = 0.9  # share of the keypoints that agree, above which no mistake is searched for
_LEAST_UNCERTAIN_MISFIT = 1.0  # of an uncertain shape, below which none is searched for
_LEAST_MISFIT = 2.0  # root of the reduced chi-square at which a mistake is looked for
_MOST_CORRECTED = 1.6  # the same, without the mistake
_LEAST_RATIO = 1.7  # of both


def joint_mistake(problem: Problem, best: Minimum) -> EstimateWarning | None:
    """Name the mistake without which the keypoints agree better.

    With RANSAC where many are rejected or an uncertain shape follows them poorly, otherwise where
    the evidence does not agree at all.
    """
    ransac = problem.ransac
    if ransac is None:
        return _mistake_in_all(problem, best)
    if not len(best.inliers):  # masks or photos alone
        return None
    are_few = best.inliers.mean() > _FEW_REJECTED
    if are_few and (is_exact(best.evidence) or _misfit(best) < _LEAST_UNCERTAIN_MISFIT):
        return None

    def explain(mistake: Mistake) -> Explained | None:
        minimum = _without(problem, mistake)
        return None if minimum is None else _explained(problem, minimum, ransac)

    found = _explained(problem, best, ransac)
    if are_few:
        return find_likelier(found.score, len(best.inliers), explain, _beside_keypoints(problem))
    return find_mistake(found, len(best.inliers), explain, _beside_keypoints(problem))


def _mistake_in_all(problem: Problem, best: Minimum) -> EstimateWarning | None:
    """Name the mistake without which all evidence agrees."""
    given, count = _misfit(best), sum(len(view.keypoint_ids) for view in problem.views)
    if (
        not count
        or problem.lacks_sigma
        or given < _LEAST_MISFIT
        or best.evidence.sightings.loss.any()
    ):
        return None

    def explain(mistake: Mistake) -> Explained | None:
        minimum = _without(problem, mistake)
        if minimum is None or _misfit(minimum) > min(_MOST_CORRECTED, given / _LEAST_RATIO):
            return None
        return Explained(minimum.score, count, _up(minimum))

    more = _beside_keypoints(problem)
    has_more = problem.size is not None or any(view.sources for view in problem.views)
    # Another image size leaves much open, so that other evidence which is wrong would pass for it.
    is_one = len({(view.camera.width, view.camera.height) for view in problem.views}) == 1
    if is_one and not has_more:
        pixels = np.concatenate([view.pixels for view in problem.views])
        more += other_sizes(pixels, problem.views[0].camera)
    found = find_in_all(best.score, count, explain, more)
    if found is None:
        return None
    return EstimateWarning(
        "mistake",
        f"{found[0]}: corrected, all evidence agrees; as given, the residuals are {given:.2g} "
        "times what their standard deviations allow",
    )


def _beside_keypoints(problem: Problem) -> list[Mistake]:
    """Mistakes in other evidence than keypoints."""
    is_rig = len(problem.views) > 1 and problem.views[0].cam_from_rig is not None
    has_up = any(view.up is not None for view in problem.views)
    return [INVERTED] * is_rig + [DOWNWARD] * has_up


def mistake_beside(problem: Problem) -> str | None:
    """Name the mistake in other evidence than keypoints without which there is an estimate."""
    tried = _beside_keypoints(problem)
    return next((each.clause for each in tried if _without(problem, each)), None)


def no_pose_error(problem: Problem) -> CadalignError:
    """The error where no start leads to a pose: what the evidence lacks, and what to give.

    Raises InputError if a mask or photo is given for a model without meshes.
    """
    views, fix = problem.views, mistake_beside(problem)
    seen = sum(len(view.keypoint_ids) > 0 for view in views)
    shown = [
        f"views[{view.number}].{'image' if view.mask is None else 'mask'}"
        for view in views
        if view.mask is not None or view.image is not None
    ]
    if shown:
        from cadalign.estimation.contours.surface import surfaces_of  # imports this package

        keypoints = problem.prior.components[0].mean[: len(problem.prior.ids)]
        surfaces_of(problem.model, keypoints, shown[0])
    if shown and fix is None:
        is_rig = len(views) > 1 and views[0].cam_from_rig is not None
        if not seen and len(views) == 1 and views[0].mask is not None:
            return DegenerateError(
                "a mask without keypoints does not tell the pose of an object that is only similar",
                where=shown[0],
                fix="give at least 3 keypoints, `init`, or the object's own model",
            )
        if not seen and len(views) == 1:
            return DegenerateError(
                "a photo without keypoints does not tell where its outline is to be sought",
                where=shown[0],
                fix="give `init`, at least 3 keypoints, or a mask",
            )
        if not seen:
            return DegenerateError(
                "photos of several views tell no pose without keypoints",
                where="views",
                fix="give at least 3 keypoints in one view, masks of two, or `init`",
            )
        if is_rig and seen == 1 and problem.size is None:
            return DegenerateError(
                "keypoints of one view alone leave open the size that the known motion gives",
                where="views",
                fix="give a keypoint or a mask in another view, `size`, or `init`",
            )
    return DegenerateError(
        "no pose has the keypoints in front of the camera",
        where="views",
        fix=fix or "give at least 3 keypoints in one view, or `init`, and check which is which",
    )


def _misfit(minimum: Minimum) -> float:
    """Root of the reduced chi-square; 0 where nothing is redundant."""
    redundancy = redundancy_of(minimum.evidence)
    return math.sqrt(minimum.cost / redundancy) if redundancy > 0 else 0.0


def _without(problem: Problem, mistake: Mistake) -> Minimum | None:
    """The likeliest minimum after a mistake is undone, if there is one."""

    def undone(points: FloatArray) -> FloatArray:
        points = mistake.undo_3d(points)
        if mistake.mirrored:  # the last two stay the box's least and greatest
            points[..., -2:, 0] = points[..., :-3:-1, 0].copy()
        return points

    components = tuple(
        shape._replace(mean=undone(shape.mean), modes=undone(shape.modes))
        for shape in problem.prior.components
    )
    views = [
        replace(each, points_2d=mistake.undo_2d(each.pixels, each.camera)) for each in problem.views
    ]
    if mistake.downward:
        views = [
            each if each.up is None else replace(each, up=np.negative(each.up)) for each in views
        ]
    if mistake.inverted:
        motions = [np.linalg.inv(np.asarray(each.cam_from_rig)) for each in views]
        views = [replace(v, cam_from_rig=m) for v, m in zip(views, motions, strict=True)]
    prior = replace(problem.prior, components=components)
    unknown = [None] * len(views)  # starts are of the data as given
    try:
        minima, _, _ = minima_at_noise(problem._replace(prior=prior, views=tuple(views)), unknown)
    except CadalignError:
        return None
    return minima[0] if minima else None


def _up(minimum: Minimum) -> float:
    """The cosine between the model's y axis and the first photo's upwards."""
    rig = minimum.evidence.rig
    in_rig = minimum.state.poses[rig.pose[0], :9].reshape(3, 3)
    in_camera = rig.cam_from_rig[0, :9].reshape(3, 3) @ in_rig
    return -float(in_camera[1, 1])


def _explained(problem: Problem, minimum: Minimum, ransac: RansacOptions) -> Explained:
    """Likelihood of all keypoints at a minimum: outliers of any threshold lie anywhere."""
    rejected, error = ~minimum.inliers, problem.threshold(ransac)
    evidence = problem.evidence(minimum.evidence.shape, minimum.lenses)
    squares = thresholds(evidence, minimum.lenses, error)[rejected] ** 2
    areas = outlier_areas(problem.views, error)[evidence.sightings.image[rejected]]
    anywhere = 2 * np.log(areas * squares / (2 * math.pi * error**2))
    score = minimum.score + float((anywhere - squares - OUTLIER_COST).sum())
    return Explained(score, int(minimum.inliers.sum()), _up(minimum))
