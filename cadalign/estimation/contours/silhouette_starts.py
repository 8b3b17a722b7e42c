"""Starts of an estimate that masks suggest where keypoints leave poses, or the size, open.

A mask alone starts from alignments of the own model whose silhouettes resemble it. Of a rig whose
outlines alone tell the object's size, one view determines the pose: the only one with keypoints or,
without any, that of the largest mask. The object is enlarged about its camera until it is seen amid
the masks of the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import cv2
import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError, InputError
from cadalign.estimation.contours.descent import MOST_ROUNDS, Approach
from cadalign.estimation.contours.mask import LARGEST, MaskSource, outline_cost
from cadalign.estimation.contours.outline import MeasuredOutline, Outline, Track
from cadalign.estimation.contours.problem import ContourProblem
from cadalign.estimation.contours.resembling import (
    Resembling,
    distinct,
    resembling_poses,
)
from cadalign.estimation.contours.surface import RigidSurface, rigid_surface
from cadalign.estimation.estimates import poses_of
from cadalign.estimation.focal import prior_of_camera
from cadalign.estimation.model import Model
from cadalign.estimation.prior import camera_like
from cadalign.estimation.problem import Inits, Problem
from cadalign.estimation.search import Found, Minimum, search
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera, turned_alignment
from cadalign.geometry.mesh import Mesh

_MOST_STARTS = 8
_INSIDE = 0.5  # probability of a mask's pixel
_MEETS = 0.003  # standard deviation of a contour that meets the rim, relative to its size
_MEETS_PX = 0.5
_MOST_ENDS = 5
_CLOSE = 1.1  # cost above the least, of a contour's sample, at which an end still counts
_ROUGH_SIZE = 160.0  # [px], of the mask's copy in which starts are followed
_LEAST_PIXEL = 1.3  # of a smaller copy, in those of the mask
_LARGEST_FOCAL_SIGMA = 0.25  # relative: poses are sought at the focal length of the prior


class _Search(NamedTuple):
    """A search of starts whose silhouettes resemble the mask, or what lines leave of these.

    So many ``starts`` are followed for some ``steps``, and the ``kept`` best ones to the end.
    """

    is_cut: bool
    starts: int
    steps: int
    kept: int


_SEARCHES = (
    _Search(is_cut=False, starts=12, steps=2, kept=4),
    _Search(is_cut=True, starts=24, steps=5, kept=8),
)


class _Start(NamedTuple):
    """A start on its way to the part of the mask's contour that no line hides."""

    minimum: Minimum
    problem: ContourProblem
    approach: Approach

    def followed(self, rounds: int = MOST_ROUNDS) -> _Start | None:
        """So many rounds further, at most; None where no rim comes near the contour."""
        further = self.approach.followed(self.problem, rounds)
        return None if further is None else self._replace(approach=further)

    def cost(self, whole: MaskSource) -> float:
        """The mean -log density of the contour's samples [1/px]; hidden ones lie anywhere."""
        (part,) = cast(list[MaskSource], self.problem.sources)
        share = len(part.contour.points) / len(whole.contour.points)
        own = self._cost(self.problem, self.approach.tracks)
        return share * own + (1 - share) * float(np.log(2 * LARGEST))

    def end(self, whole: MaskSource) -> tuple[float, Minimum]:
        """The cost of the whole contour, and the minimum with its outline brought to the mask's."""
        cost = self._cost(self.problem._replace(sources=[whole]), [whole.first(is_wide=True)])
        return cost, self.minimum._replace(state=self.approach.place.state)

    def _cost(self, problem: ContourProblem, tracks: list[Track]) -> float:
        place = self.approach.place
        (outline,) = problem.look(place, tracks).outlines
        (own,), (track,) = place.own, self.approach.tracks
        return outline_cost(MeasuredOutline(cast(Outline, outline), own, track.noise))


def minima_of_mask(problem: Problem) -> tuple[list[Minimum], int, int]:
    """Minima of the evidence beside the mask of the only view, at alignments that resemble it.

    The model is exact and has a mesh. The best is the first; then numbers of iterations and of
    starts.

    Raises InputError if the mask has no contour, or no prior says roughly what the focal length is;
    DegenerateError if no start leads to the mask.
    """
    (view,), camera, model = problem.views, problem.lenses.cameras[0], cast(Model, problem.model)
    known = prior_of_camera(problem.lenses.prior, camera)
    if problem.lenses.count and (known is None or known.relative_sigma > _LARGEST_FOCAL_SIGMA):
        raise InputError(
            "a mask alone does not tell the focal length",
            where=f"views[{view.number}].camera",
            fix="give a calibrated camera, a focal_prior whose relative_sigma is at most "
            f"{_LARGEST_FOCAL_SIGMA}, or keypoints",
        )
    ends, steps, starts = _ends_near(problem, model, _rough_contour(view, camera))
    if not ends:
        raise DegenerateError(
            "no pose gives the model an outline like the mask's",
            where=f"views[{view.number}].mask",
            fix="check that the mask is nonzero on the object, not around it, and that the model "
            "is the object's; or give an init or keypoints",
        )
    likely = [minimum for cost, minimum in ends if cost <= ends[0][0] + _CLOSE]
    poses = [poses_of(each.evidence, each.state)[0] for each in likely]
    chosen = distinct(zip(poses, likely, strict=True), _MOST_ENDS, model.symmetry)
    return chosen, steps, starts


def _ends_near(
    problem: Problem, model: Model, contour: MaskSource
) -> tuple[list[tuple[float, Minimum]], int, int]:
    """Costs and minima near a contour, the likeliest first; numbers of iterations and of starts.

    A search follows those before it where none of these meets the contour.
    """
    surface = rigid_surface(cast(Mesh, model.mesh))
    found: list[tuple[float, Minimum]] = []
    steps, starts = 0, 0
    for one in _SEARCHES:
        begun = []
        for each in _resembling(problem, model, one):
            start, iterations = _begun(problem, each, surface, contour)
            starts, steps = starts + 1, steps + iterations
            tried = None if start is None else start.followed(one.steps)
            if tried is not None:
                begun.append(tried)
        begun.sort(key=lambda start: start.cost(contour))
        ends = [start.followed() for start in begun[: one.kept]]
        found.extend(start.end(contour) for start in ends if start is not None)
        found.sort(key=lambda end: end[0])
        if found and found[0][0] < _met_by(contour):
            break
    return found, steps, starts


def _met_by(contour: MaskSource) -> float:
    """Cost below which an outline is as likely as one that meets the whole contour."""
    sigma = max(_MEETS_PX, _MEETS * contour.contour.size)
    return float(np.log(sigma) + (1 + np.log(2 * np.pi)) / 2)


def _rough_contour(view: View, camera: Camera) -> MaskSource:
    """The contour of a view's mask, or of a copy of `_ROUGH_SIZE` where it is larger."""
    contour = MaskSource.of(0, view, camera)
    pixel = contour.contour.size / _ROUGH_SIZE
    if pixel < _LEAST_PIXEL:
        return contour
    mask = np.asarray(view.mask_image, dtype=np.float32)
    width, height = (round(side / pixel) for side in mask.shape[::-1])
    small = np.clip(cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA), 0.0, 1.0)
    sigma = view.mask_sigma and view.mask_sigma / pixel
    resized = view.camera.resized(width, height)
    smaller = View(resized, mask=small, mask_sigma=sigma, number=view.number)
    return MaskSource.of(0, smaller, camera.resized(width, height))


def _resembling(problem: Problem, model: Model, search: _Search) -> list[Resembling]:
    """Alignments whose silhouettes resemble the mask, the best first."""
    (view,) = problem.views
    mesh = cast(Mesh, model.mesh)
    return resembling_poses(
        mesh,
        cast(FloatArray, view.mask_image),
        problem.lenses.cameras[0],
        free=np.asarray(problem.prior.scales.free > 0),
        count=search.starts,
        is_cut=search.is_cut,
        symmetry=model.symmetry,
    )


def _begun(
    problem: Problem, start: Resembling, surface: RigidSurface, contour: MaskSource
) -> tuple[_Start | None, int]:
    """A start before its first step towards the mask's outline; and iterations that led there."""
    alignment = turned_alignment(start.alignment, problem.turns[0])
    _, minima, iterations, _ = search(problem._replace(ransac=None), [[alignment]])
    if not minima:
        return None, iterations
    part, keypoints = [contour.shown_by(start.line)], len(problem.prior.ids)
    shown = ContourProblem(minima[0].evidence, keypoints, part, surface)
    approach = Approach.begun(shown, minima[0].state, is_wide=True)
    return _Start(minima[0], shown, approach), iterations


def search_by_masks(problem: Problem) -> Found:
    """As `search`, from starts that masks suggest, too."""
    problem, starts = starts_by_masks(problem)
    if len(problem.views) == 1 and not any(problem.inits) and problem.is_mask_alone:
        return Found(problem, *minima_of_mask(problem))
    return search(problem, starts)


def starts_by_masks(problem: Problem) -> tuple[Problem, list[Inits]]:
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
        return minima_of_mask(problem)[0]
    return search(problem, [problem.inits]).minima


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
