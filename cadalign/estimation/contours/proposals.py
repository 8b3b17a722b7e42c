"""Starts of an estimate from a mask alone: alignments whose silhouettes resemble it."""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.estimation.contours.descent import Masked, approached
from cadalign.estimation.contours.silhouettes import differ, resembling_poses
from cadalign.estimation.contours.surface import surfaces_of
from cadalign.estimation.contours.view_contour import contour_view
from cadalign.estimation.estimates import poses_of
from cadalign.estimation.model import Model
from cadalign.estimation.search import JointProblem, Minimum, find_minima
from cadalign.geometry.mesh import Mesh

_MOST_STARTS = 40
_FEW_STARTS = 12  # that are enough where one of them meets the mask
_MEETS = 0.003  # misfit of such a start, relative to the mask's size
_MEETS_PX = 0.5
_FAR = 0.01  # misfit, relative to the mask's size, of a model that may be another
_FAR_PX = 2.0
_MOST_PROPOSALS = 4
_CLOSE = 3.0  # misfit, relative to the least, at which a proposal is still one
_CLOSE_PX = 3.0


class _Proposal(NamedTuple):
    """A minimum near the mask, and the mean distance [px] of the mask's contour from its rim."""

    minimum: Minimum
    misfit: float


class MaskProposals(NamedTuple):
    """Minima near a mask, the best first; numbers of iterations and of starts, and a mistake."""

    minima: list[Minimum]
    iterations: int
    starts: int
    mistake: str | None


def minima_of_mask(problem: JointProblem, model: Model) -> MaskProposals:
    """Minima of the evidence beside the mask of the only view, at alignments that resemble it.

    Raises InputError if the mask has no contour, or the focal length is unknown.
    """
    (view,), camera = problem.views, problem.lenses.cameras[0]
    if not view.camera.focal_known:
        raise InputError(
            "a mask alone does not tell the focal length",
            where="views[0].camera",
            fix="give a calibrated camera, or keypoints",
        )
    contour = contour_view(0, view, "views[0].mask", camera)
    keypoints = len(problem.prior.ids)
    free = np.asarray(problem.prior.scales.free > 0)
    mask = cast(FloatArray, view.mask_image)
    resembling = resembling_poses(
        cast(Mesh, model.mesh), mask, camera, free=free, count=_MOST_STARTS
    )
    (surface,) = surfaces_of(model, np.empty((0, 3)), "views[0].mask").surfaces
    proposals: list[_Proposal] = []
    steps, starts, least = 0, 0, np.inf
    for each in resembling:
        _, minima, iterations, _ = find_minima(problem, [each.alignment], None)
        steps += iterations
        for minimum in minima[:1]:
            masked = Masked(minimum.evidence, keypoints, [contour], surface)
            found = approached(masked, minimum.state)
            if found is not None:
                moved = minimum._replace(state=found.state)
                proposals.append(_Proposal(moved, found.misfit))
        starts += 1
        least = min((each.misfit for each in proposals), default=np.inf)
        if starts >= _FEW_STARTS and least < max(_MEETS_PX, _MEETS * contour.contour.size):
            break
    mistake = None
    if least > max(_FAR_PX, _FAR * contour.contour.size):
        mistake = (
            "views[0].mask: no pose found brings the outline closer to the mask's than "
            f"{least:.1f} px on average: the model may be another, the mask incomplete, or the "
            "pose wrong"
        )
    chosen = [each.minimum for each in _chosen(proposals)]
    return MaskProposals(chosen, steps, starts, mistake)


def _chosen(proposals: list[_Proposal]) -> list[_Proposal]:
    """The distinct proposals that come about as close to the mask as the best."""
    kept: list[_Proposal] = []
    for each in sorted(proposals, key=lambda proposal: proposal.misfit):
        if kept and each.misfit > max(_CLOSE * kept[0].misfit, kept[0].misfit + _CLOSE_PX):
            break
        (pose,) = poses_of(each.minimum.evidence, each.minimum.state)
        known = [poses_of(other.minimum.evidence, other.minimum.state)[0] for other in kept]
        if all(differ(pose, other) for other in known):
            kept.append(each)
    return kept[:_MOST_PROPOSALS]
