"""Starts of an estimate from a mask alone: alignments whose silhouettes resemble it."""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError, InputError
from cadalign.estimation.contours.descent import Masked, approached
from cadalign.estimation.contours.silhouettes import differ, resembling_poses
from cadalign.estimation.contours.surface import Surface, surfaces_of
from cadalign.estimation.contours.view_contour import (
    ViewContour,
    contour_view,
    correlation_length,
    cost_of_contour,
)
from cadalign.estimation.estimates import poses_of
from cadalign.estimation.model import Model, is_exact_model
from cadalign.estimation.search import JointProblem, Minimum, find_minima
from cadalign.estimation.solve import LEAST_LIKELIHOOD
from cadalign.geometry.alignment import Alignment
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import TrainingShapes

_SEARCHES = ((False, 12), (True, 24))  # whole silhouettes, then what lines leave; starts of each
_SEARCHES_OF_SIMILAR = ((False, 12),)  # whose surfaces are warped, and meet no mask
_MOST_MESHES = 4  # of a learned shape's training models
_MOST_COMPARED = 100  # of these
_MEETS = 0.003  # standard deviation of a contour that meets the rim, relative to its size
_MEETS_PX = 0.5
_FAR = 0.01  # misfit, relative to the mask's size, of a model that may be another
_FAR_PX = 2.0
_MOST_PROPOSALS = 5
_CLOSE = 1.1  # cost above the least, of a contour's sample, at which a proposal is still one
_WHERE = "views[0].mask"


class _Proposal(NamedTuple):
    """A minimum near the mask.

    The ``misfit`` is the mean distance [px] of the mask's contour from the rim, the ``cost`` the
    mean of the samples' -log probability density [1/px]; neighbouring samples are off alike, so
    that as many as are ``independent`` count.
    """

    minimum: Minimum
    misfit: float
    cost: float
    independent: float

    def over(self, best: _Proposal) -> float:
        """-2 log of the likelihood over the best one's, for the fewer independent samples."""
        return 2 * (self.cost - best.cost) * min(self.independent, best.independent)


def minima_of_mask(
    problem: JointProblem, model: Model | ShapeModel
) -> tuple[list[Minimum], int, int, str | None]:
    """Minima of the evidence beside the mask of the only view, at alignments that resemble it.

    The best is the first; then numbers of iterations and of starts, and a mistake to warn of.

    For a model that is only similar, and for a learned shape, they are proposals: another shape in
    another pose has an outline alike. Their ``outline_score`` is what ranks them: warped to the
    mask, a model follows it in a wrong pose, too.

    Raises InputError if the mask has no contour, the model no mesh, or the focal length is unknown.
    """
    (view,), camera = problem.views, problem.lenses.cameras[0]
    if not view.camera.focal_known:
        raise InputError(
            "a mask alone does not tell the focal length",
            where="views[0].camera",
            fix="give a calibrated camera, or keypoints",
        )
    contour = contour_view(0, view, _WHERE, camera)
    is_exact = is_exact_model(model)
    proposals: list[_Proposal] = []
    steps, starts = 0, 0
    sigma = max(_MEETS_PX, _MEETS * contour.contour.size)
    met = np.log(sigma) + (1 + np.log(2 * np.pi)) / 2
    for is_cut, count in _SEARCHES if is_exact else _SEARCHES_OF_SIMILAR:
        for alignment, surface in _resembling(problem, model, count, is_cut=is_cut):
            found, iterations = _approached(problem, alignment, surface, contour)
            starts, steps = starts + 1, steps + iterations
            if found is not None:
                proposals.append(found)
        cost = min((proposal.cost for proposal in proposals), default=np.inf)
        if cost < met:  # as likely as one whose whole outline meets the contour
            break
    if not proposals:
        raise DegenerateError(
            "no pose gives the model an outline like the mask's",
            where=_WHERE,
            fix="check that the mask is nonzero on the object, not around it, and that the model "
            "is the object's; or give an init or keypoints",
        )
    proposals.sort(key=lambda proposal: proposal.cost)
    misfit = proposals[0].misfit
    mistake = None
    if not is_exact:
        mistake = (
            f"{_WHERE} alone does not tell the pose of an object that is only similar: the "
            "estimate is a proposal, as its alternatives are, and three keypoints settle it"
        )
    elif misfit > max(_FAR_PX, _FAR * contour.contour.size):
        mistake = (
            f"{_WHERE}: the outline of the best pose found is {misfit:.1f} px from the mask's on "
            "average: the object may be partly hidden, the model another, or the pose wrong"
        )
    chosen = _chosen(proposals)
    if is_exact:
        return [each.minimum for each in chosen], steps, starts, mistake
    scores = [each.over(chosen[0]) for each in chosen]
    likely = [
        each.minimum._replace(outline_score=score)
        for each, score in zip(chosen, scores, strict=True)
        if np.exp(-score / 2) >= LEAST_LIKELIHOOD
    ]
    return likely, steps, starts, mistake


def _resembling(
    problem: JointProblem, model: Model | ShapeModel, count: int, *, is_cut: bool
) -> list[tuple[Alignment, Surface]]:
    """Alignments of all meshes whose silhouettes resemble the mask, the best first."""
    (view,), camera = problem.views, problem.lenses.cameras[0]
    free = np.asarray(problem.prior.scales.free > 0)
    mask = cast(FloatArray, view.mask_image)
    found = [
        (each, surface)
        for surface in _surfaces_of(model)
        for each in resembling_poses(
            surface.mesh, mask, camera, free=free, count=count, is_cut=is_cut
        )
    ]
    best = sorted(found, key=lambda pair: -pair[0][0])[:count]
    return [(alignment, surface) for (_, alignment), surface in best]


def _approached(
    problem: JointProblem, start: Alignment, surface: Surface, contour: ViewContour
) -> tuple[_Proposal | None, int]:
    """The minimum near a start, its outline brought to the mask's; and the iterations."""
    _, minima, iterations, _ = find_minima(problem, [start], None)
    if not minima:
        return None, iterations
    best = minima[0]
    masked = Masked(best.evidence, len(problem.prior.ids), [contour], surface)
    found = approached(masked, best.state)
    if found is None:
        return None, iterations
    state, residuals, reach = found
    misfit, cost = float(np.abs(residuals).mean()), cost_of_contour(residuals, reach)
    alike = correlation_length(contour.contour, residuals, np.ones(len(residuals), dtype=bool))
    minimum = best._replace(state=state)
    return _Proposal(minimum, misfit, cost, len(residuals) / alike), iterations


def _surfaces_of(model: Model | ShapeModel) -> list[Surface]:
    """Surfaces of the model's mesh, or of varied training models'."""
    if isinstance(model, Model):
        shapes = [cast(FloatArray, model.points_3d)]
    else:
        mean = model.components[0].mean[: len(model.ids)]
        surfaces_of(model, mean, _WHERE)  # refuses a model without meshes
        training = cast(TrainingShapes, model.training)
        rows = _varied(training, mean)
        shapes = list(training.points_3d[rows].astype(np.float64))
    return [surfaces_of(model, points, _WHERE).surfaces[0] for points in shapes]


def _varied(training: TrainingShapes, mean: FloatArray) -> list[int]:
    """Rows of training models with meshes: the nearest to the mean, and those far from others."""
    rows = training.rows_with_mesh
    rows = rows[:: 1 + len(rows) // _MOST_COMPARED]
    points = training.points_3d[rows].astype(np.float64)
    points = np.where(np.isfinite(points), points, mean)
    gaps = np.linalg.norm(points[:, None] - points[None], axis=3).mean(axis=2)
    chosen = [int(np.linalg.norm(points - mean, axis=2).mean(axis=1).argmin())]
    while len(chosen) < min(_MOST_MESHES, len(rows)):
        chosen.append(int(gaps[:, chosen].min(axis=1).argmax()))
    return [rows[k] for k in chosen]


def _chosen(proposals: list[_Proposal]) -> list[_Proposal]:
    """The distinct ones of sorted proposals that are about as likely as the best."""
    kept: list[_Proposal] = []
    for each in proposals:
        if kept and each.cost > kept[0].cost + _CLOSE:
            break
        (pose,) = poses_of(each.minimum.evidence, each.minimum.state)
        known = [poses_of(other.minimum.evidence, other.minimum.state)[0] for other in kept]
        if all(differ(pose, other) for other in known):
            kept.append(each)
    return kept[:_MOST_PROPOSALS]
