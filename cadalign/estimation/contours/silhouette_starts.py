"""Starts of an estimate that masks suggest where keypoints leave poses, or the size, open.

A mask alone starts from alignments of the own model whose silhouettes resemble it. Of a rig whose
outlines alone tell the object's size, one view determines the pose: the only one with keypoints or,
without any, that of the largest mask. The object is enlarged about its camera until it is seen amid
the masks of the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError, InputError
from cadalign.estimation.contours.engine import refine_with_outlines
from cadalign.estimation.contours.silhouettes import resembling_poses
from cadalign.estimation.estimates import poses_of
from cadalign.estimation.focal import prior_of_camera
from cadalign.estimation.model import Model
from cadalign.estimation.prior import camera_like
from cadalign.estimation.problem import Inits, Problem
from cadalign.estimation.search import Minimum, SearchResult, search
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import turned_alignment
from cadalign.geometry.mesh import Mesh

_MOST_STARTS = 8
_RESEMBLING = 12  # silhouettes from which a mask alone starts
_INSIDE = 0.5  # probability of a mask's pixel
_LARGEST_FOCAL_SIGMA = 0.25  # relative: poses are sought at the focal length of the prior

_View = tuple[FloatArray, FloatArray, FloatArray]


def search_by_masks(problem: Problem) -> SearchResult:
    """As `search`, from starts that masks suggest, too.

    The problem that is returned lacks the views whose mask alone leads to no pose.

    Raises InputError if a mask has no contour, or no prior says roughly what the focal length of a
    mask alone is; DegenerateError if the first view's mask alone leads to no pose, or one view of a
    rig that alone must determine the pose does not.
    """
    starts: list[Inits] = []
    if problem.is_rig:
        starts = [] if any(problem.inits) else _starts_of_rig(problem)
    elif len(problem.views) > 1:
        problem = _with_poses_of_masks(problem)
    elif problem.is_mask_alone and not any(problem.inits):
        problem, starts = problem._replace(ransac=None), _starts_of_mask(problem)
    return search(problem, starts or [problem.inits])


def _starts_of_mask(problem: Problem) -> list[Inits]:
    """Alignments of the own model whose silhouettes resemble the mask of the only view."""
    (view,), camera, model = problem.views, problem.lenses.cameras[0], cast(Model, problem.model)
    known = prior_of_camera(problem.lenses.prior, camera)
    if problem.lenses.count and (known is None or known.relative_sigma > _LARGEST_FOCAL_SIGMA):
        raise InputError(
            "a mask alone does not tell the focal length",
            where=f"views[{view.number}].camera",
            fix="give a calibrated camera, a focal_prior whose relative_sigma is at most "
            f"{_LARGEST_FOCAL_SIGMA}, or keypoints",
        )
    poses = resembling_poses(
        cast(Mesh, model.mesh),
        cast(FloatArray, view.mask_image),
        camera,
        free=np.asarray(problem.prior.scales.free > 0),
        count=_RESEMBLING,
        symmetry=model.symmetry,
    )
    return [[turned_alignment(pose, problem.turns[0])] for pose, _ in poses]


def _with_poses_of_masks(problem: Problem) -> Problem:
    """The problem whose inits are those of masks alone, without views where these lead to none."""
    inits, without = list(problem.inits), []
    for number, view in enumerate(problem.views):
        if inits[number] is None and view.has_mask_alone and problem.has_own_mesh:
            try:
                best = _minima_of_view(problem.alone(number))[0]
            except DegenerateError:
                without.append(number)
            else:
                pose = poses_of(best.evidence, best.state)[0]
                inits[number] = turned_alignment(pose, problem.turns[number])
    return problem.without(without)._replace(inits=inits)


def _minima_of_view(problem: Problem) -> list[Minimum]:
    """Minima of one view, the likeliest first."""
    if not (problem.views[0].has_mask_alone and problem.has_own_mesh):
        return search(problem, [problem.inits]).minima
    minima = search(problem._replace(ransac=None), _starts_of_mask(problem)).minima
    return refine_with_outlines(problem.model, problem.prior, problem.views, minima)[0]


def _starts_of_rig(problem: Problem) -> list[Inits]:
    """Starts of a rig, the likeliest first; none where its outlines need not tell the size."""
    views = problem.views
    seen = [number for number, view in enumerate(views) if len(view.keypoint_ids)]
    has_size = problem.size is not None or any(
        view.depth is not None or view.camera_height is not None for view in views
    )
    given = {n: np.asarray(view.mask) for n, view in enumerate(views) if view.mask is not None}
    masks = {n: mask > _INSIDE for n, mask in given.items() if mask.max() > _INSIDE}
    if len(seen) > 1 or (seen and has_size) or not masks:
        return []
    first = seen[0] if seen else max(masks, key=lambda number: int(masks[number].sum()))
    others = [number for number in masks if number != first]
    if not others or not (seen or problem.has_own_mesh):
        return []
    minima = _minima_of_view(problem.alone(first))[:_MOST_STARTS]
    if not minima:
        raise DegenerateError(
            "its keypoints determine no pose, and no other view has any",
            where=f"views[{first}]",
            fix="give at least 3 keypoints, not on one line, or `init`",
        )
    rig = problem.evidence(problem.prior.components[0], problem.lenses).rig.cam_from_rig
    turn, shift = rig[first, :9].reshape(3, 3).T, rig[first, 9:]
    starts: list[Inits] = []
    for each in minima:
        pose = poses_of(each.evidence, each.state)[0]
        known = {views[first].camera: each.lenses.cameras_at(each.state.log_focals)[0]}
        middles = []
        for number in others:
            pixel = np.argwhere(masks[number]).mean(axis=0)[None, ::-1]
            ray = camera_like(views[number].camera, known).normalize(pixel)[0]
            own = rig[number, :9].reshape(3, 3) @ turn
            middles.append((own, rig[number, 9:] - own @ shift, ray))
        factor = _factor_amid(pose.apply(each.points[-2:].mean(axis=0)[None])[0], middles)
        if factor > 0:
            place = turn @ (factor * pose.translation - shift)
            enlarged = Alignment(turn @ pose.rotation, place, factor * pose.scale)
            starts.append([enlarged, *[None] * (len(views) - 1)])
    return starts


def _factor_amid(center: FloatArray, middles: Sequence[_View]) -> float:
    """Factor of a point's distance from its camera that puts it amid masks; not positive for none.

    These are of cameras of known rotation (3, 3) and translation (3,) in the point's, which see
    their middles by rays (2,).
    """
    by_factor, rest = [], []
    for rotation, translation, ray in middles:
        along = rotation @ center
        by_factor.append(along[:2] - ray * along[2])
        rest.append(translation[:2] - ray * translation[2])
    first, second = np.concatenate(by_factor), np.concatenate(rest)
    squares = first @ first
    return -float(first @ second / squares) if squares > 0 else 0.0
