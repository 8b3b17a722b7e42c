"""Starts that masks suggest where keypoints leave poses, or the object's size, open.

The mask of a view of unknown motion starts from silhouettes of the own model. Of a rig whose
outlines alone tell the object's size, one view determines the pose: the only one with keypoints or,
without any, that of the largest mask. The object is enlarged about its camera until it is seen amid
the masks of the others.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError
from cadalign.estimation.estimates import poses_of
from cadalign.estimation.prior import camera_like
from cadalign.estimation.problem import Inits, Problem
from cadalign.estimation.search import Minimum, find_minima
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import turned_alignment

_MOST_STARTS = 8
_INSIDE = 0.5  # probability of a mask's pixel


def starts_by_outlines(problem: Problem) -> tuple[Problem, list[Inits]]:
    """Starts for the search; the given ones where masks add none.

    Returns the problem without views whose mask alone leads to no pose.

    Raises DegenerateError if the first view is among these, or one view of a rig that alone must
    determine the pose does not.
    """
    if problem.is_rig:
        starts = [] if any(problem.inits) else _starts_of_rig(problem)
        return problem, starts or [problem.inits]
    inits, without = list(problem.inits), []
    for number, view in enumerate(problem.views):
        is_open = inits[number] is None and view.has_mask_alone and len(inits) > 1
        if is_open and problem.has_own_mesh:
            try:
                best = _minima_of_view(problem.alone(number))[0]
            except DegenerateError:
                without.append(number)
            else:
                pose = poses_of(best.evidence, best.state)[0]
                inits[number] = turned_alignment(pose, problem.turns[number])
    return problem.without(without)._replace(inits=inits), [inits]


def _minima_of_view(problem: Problem) -> list[Minimum]:
    """Minima of one view, the likeliest first."""
    if problem.views[0].has_mask_alone and problem.has_own_mesh:
        from cadalign.estimation.contours.silhouette_starts import minima_of_mask  # with OpenCV

        return minima_of_mask(problem)[0]
    return find_minima(problem, [problem.inits])[1]


def _starts_of_rig(problem: Problem) -> list[Inits]:
    """Starts of a rig, the likeliest first; none where its outlines need not tell the size."""
    views = problem.views
    seen = [number for number, view in enumerate(views) if len(view.keypoint_ids)]
    has_size = problem.size is not None or any(view.depth is not None for view in views)
    has_size |= any(view.camera_height is not None for view in views)
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
    shape = problem.prior.components[0]
    rig = problem.evidence(shape, problem.lenses).rig.cam_from_rig
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


def _factor_amid(
    center: FloatArray, middles: Sequence[tuple[FloatArray, FloatArray, FloatArray]]
) -> float:
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
