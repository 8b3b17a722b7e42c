"""Starts of an estimate from a mask alone: alignments whose silhouettes resemble it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import cv2
import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import DegenerateError, InputError
from cadalign.estimation.contours.descent import MOST_ROUNDS, FirstSteps, Masked
from cadalign.estimation.contours.resembling import (
    Possible,
    Resembling,
    distinct,
    resembling_poses,
)
from cadalign.estimation.contours.surface import Surface, surfaces_of
from cadalign.estimation.contours.view_contour import (
    ViewContour,
    contour_view,
    correlation_length,
    cost_of_contour,
)
from cadalign.estimation.estimates import poses_of
from cadalign.estimation.focal import prior_of_camera
from cadalign.estimation.model import Model, is_exact_model
from cadalign.estimation.pack import evidence_of
from cadalign.estimation.search import JointProblem, Minimum, find_minima
from cadalign.estimation.solve import LEAST_LIKELIHOOD
from cadalign.estimation.view import View
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import TrainingShapes

_MOST_MESHES = 4  # of a learned shape's training models
_MOST_COMPARED = 100  # of these
_MEETS = 0.003  # standard deviation of a contour that meets the rim, relative to its size
_MEETS_PX = 0.5
_FAR = 0.01  # misfit, relative to the mask's size, of a model that may be another
_FAR_PX = 2.0
_MOST_PROPOSALS = 5
_CLOSE = 1.1  # cost above the least, of a contour's sample, at which a proposal is still one
_ROUGH_SIZE = 160.0  # [px], of the mask's copy in which starts are followed
_LEAST_PIXEL = 1.3  # of a smaller copy, in those of the mask
_ROUGHLY = np.radians(10.0)  # standard deviation of a start's directions
_ROUGH_STRETCH = 0.3  # of the logarithms of its lengths
_MOST_SIGMAS = 3.0
_LARGEST_FOCAL_SIGMA = 0.25  # relative: poses are sought at the focal length of the prior
_WHERE = "views[0].mask"


class _Search(NamedTuple):
    """A search of starts whose silhouettes resemble the mask, or what lines leave of these.

    Silhouettes are compared in ``every`` so many rows and columns. So many ``starts`` are followed
    for some ``steps``, and the ``kept`` best ones to the end.
    """

    is_cut: bool
    every: int
    starts: int
    steps: int
    kept: int


_SEARCHES = (
    _Search(is_cut=False, every=2, starts=12, steps=2, kept=4),
    _Search(is_cut=True, every=2, starts=24, steps=5, kept=8),
)
_SEARCHES_OF_SIMILAR = (  # whose surfaces meet no mask
    _Search(is_cut=False, every=1, starts=12, steps=0, kept=12),
)


class _Proposal(NamedTuple):
    """A minimum near the mask.

    The ``residuals`` (S,) [px] are the distances of the mask's contour from the rim, the ``cost``
    the mean of the samples' -log probability density [1/px]; so many neighbouring samples as the
    ``correlation`` are off alike, and count as one.
    """

    minimum: Minimum
    residuals: FloatArray
    cost: float
    correlation: float

    @property
    def misfit(self) -> float:
        """Mean distance [px]."""
        return float(np.abs(self.residuals).mean())

    @property
    def independent(self) -> float:
        """Number of samples that are off independently."""
        return len(self.residuals) / self.correlation

    def over(self, best: _Proposal) -> float:
        """-2 log of the likelihood over the best one's, for the fewer independent samples."""
        return 2 * (self.cost - best.cost) * min(self.independent, best.independent)


class _Start(NamedTuple):
    """A start on its way to the mask: its minimum without this, and the steps so far.

    They approach the ``shown`` part of the contour, which no line hides.
    """

    minimum: Minimum
    masked: Masked
    shown: Masked
    approach: FirstSteps

    @property
    def cost(self) -> float:
        """See `_Proposal`; the contour that is not shown lies anywhere within the reach."""
        reach, residuals = self.approach.first_reach, self.approach.residuals()
        share = len(residuals) / len(self.masked.views[0].contour.points)
        own = cost_of_contour(residuals, reach)
        return share * own + (1 - share) * float(np.log(2 * reach))

    def followed(self, steps: int = MOST_ROUNDS) -> _Start | None:
        """So many steps further, at most; None where no rim comes near the contour."""
        further = self.approach.followed(self.shown, steps)
        return None if further is None else self._replace(approach=further)

    @property
    def proposal(self) -> _Proposal:
        """The minimum near the start, its outline brought to the mask's."""
        (contour,), here = self.masked.views, self.approach
        if here.reach < here.first_reach or self.shown is not self.masked:
            here = here.widened(self.masked)
        residuals, every = here.residuals(), np.ones(len(contour.contour.points), dtype=bool)
        cost = cost_of_contour(residuals, here.first_reach)
        alike = correlation_length(contour.contour, residuals, every)
        return _Proposal(self.minimum._replace(state=here.place.state), residuals, cost, alike)


def minima_of_mask(
    problem: JointProblem, model: Model | ShapeModel
) -> tuple[list[Minimum], int, int, str | None]:
    """Minima of the evidence beside the mask of the only view, at alignments that resemble it.

    The best is the first; then numbers of iterations and of starts, and a mistake to warn of.

    For a model that is only similar, and for a learned shape, they are proposals: another shape in
    another pose has an outline alike. Their ``outline_score`` is what ranks them: warped to the
    mask, a model follows it in a wrong pose, too.

    Raises InputError if the mask has no contour, the model no mesh, or no prior says roughly what
    the focal length is.
    """
    (view,), camera = problem.views, problem.lenses.cameras[0]
    known = prior_of_camera(problem.lenses.prior, camera)
    if problem.lenses.count and (known is None or known.relative_sigma > _LARGEST_FOCAL_SIGMA):
        raise InputError(
            "a mask alone does not tell the focal length",
            where="views[0].camera",
            fix="give a calibrated camera, a focal_prior whose relative_sigma is at most "
            f"{_LARGEST_FOCAL_SIGMA}, or keypoints",
        )
    is_exact = is_exact_model(model)
    # The likelihoods of a similar model's proposals are calibrated for the mask itself.
    contour, pixel = _rough_contour(view, camera, _ROUGH_SIZE if is_exact else np.inf)
    searches = _SEARCHES if is_exact else _SEARCHES_OF_SIMILAR
    proposals, steps, starts = _searched(problem, model, contour, searches)
    if not proposals:
        raise DegenerateError(
            "no pose gives the model an outline like the mask's",
            where=_WHERE,
            fix="check that the mask is nonzero on the object, not around it, and that the model "
            "is the object's; or give an init or keypoints",
        )
    misfit, size = pixel * proposals[0].misfit, pixel * contour.contour.size
    mistake = None
    if not is_exact:
        mistake = (
            f"{_WHERE} alone does not tell the pose of an object that is only similar: the "
            "estimate is a proposal, as its alternatives are, and three keypoints settle it"
        )
    elif misfit > max(_FAR_PX, _FAR * size):
        mistake = (
            f"{_WHERE}: the outline of the best pose found is {misfit:.1f} px from the mask's on "
            "average: the object may be partly hidden, the model another, or the pose wrong"
        )
    chosen = _chosen(proposals, _symmetry_of(model))
    scores = [each.over(chosen[0]) for each in chosen]
    likely = [
        each.minimum._replace(outline_score=score)
        for each, score in zip(chosen, scores, strict=True)
        if is_exact or np.exp(-score / 2) >= LEAST_LIKELIHOOD
    ]
    return likely, steps, starts, mistake


def _searched(
    problem: JointProblem,
    model: Model | ShapeModel,
    contour: ViewContour,
    searches: Sequence[_Search],
) -> tuple[list[_Proposal], int, int]:
    """Minima near a contour, the likeliest first; numbers of iterations and of starts.

    A search follows those before it where none of these meets the contour.
    """
    found: list[_Proposal] = []
    steps, starts = 0, 0
    for search in searches:
        begun = []
        for each, surface in _resembling(problem, model, search):
            start, iterations = _begun(problem, each, surface, contour)
            starts, steps = starts + 1, steps + iterations
            tried = None if start is None else start.followed(search.steps)
            if tried is not None:
                begun.append(tried)
        begun.sort(key=lambda start: start.cost)
        ends = [start.followed() for start in begun[: search.kept]]
        found.extend(end.proposal for end in ends if end is not None)
        found.sort(key=lambda proposal: proposal.cost)
        if found and found[0].cost < _met_by(contour):
            break
    return found, steps, starts


def _met_by(contour: ViewContour) -> float:
    """Cost below which an outline is as likely as one that meets the whole contour."""
    sigma = max(_MEETS_PX, _MEETS * contour.contour.size)
    return float(np.log(sigma) + (1 + np.log(2 * np.pi)) / 2)


def _rough_contour(view: View, camera: Camera, size: float) -> tuple[ViewContour, float]:
    """The contour of a view's mask, or of a copy of a ``size`` [px] where it is larger.

    Then how many of the mask's pixels one of the copy is.
    """
    contour = contour_view(0, view, _WHERE, camera)
    pixel = contour.contour.size / size
    if pixel < _LEAST_PIXEL:
        return contour, 1.0
    mask = np.asarray(view.mask_image, dtype=np.float32)
    width, height = (round(side / pixel) for side in mask.shape[::-1])
    small = np.clip(cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA), 0.0, 1.0)
    sigma = view.mask_sigma and view.mask_sigma / pixel
    smaller = View(view.camera.resized(width, height), mask=small, mask_sigma=sigma)
    return contour_view(0, smaller, _WHERE, camera.resized(width, height)), pixel


def _resembling(
    problem: JointProblem, model: Model | ShapeModel, search: _Search
) -> list[tuple[Resembling, Surface]]:
    """Alignments of all meshes whose silhouettes resemble the mask, the best first."""
    (view,), camera = problem.views, problem.lenses.cameras[0]
    free = np.asarray(problem.prior.scales.free > 0)
    mask = cast(FloatArray, view.mask_image)
    found: list[tuple[Resembling, Surface]] = []
    for surface in _surfaces_of(model):
        poses = resembling_poses(
            surface.mesh,
            mask,
            camera,
            free=free,
            count=search.starts,
            is_cut=search.is_cut,
            every=search.every,
            symmetry=_symmetry_of(model),
            possible=_possible(problem, surface),
        )
        found.extend((each, surface) for each in poses)
    return sorted(found, key=lambda pair: -pair[0].overlap)[: search.starts]


def _possible(problem: JointProblem, surface: Surface) -> Possible | None:
    """Tell which poses known directions, such as gravity's, and known lengths leave."""
    directions = evidence_of(problem.prior, problem.views, lenses=problem.lenses).directions
    lengths = np.full(3, np.nan) if problem.size is None else problem.size.lengths
    known = np.log(lengths / np.ptp(surface.mesh.bounds, axis=0))
    if not len(directions.model) and np.isfinite(known).sum() < 2:
        return None
    roots, axes = np.linalg.eigh(directions.whitening.swapaxes(1, 2) @ directions.whitening)
    weights = roots / (1 + _ROUGHLY**2 * roots)  # of directions that are as rough as a start

    def possible(rotations: FloatArray, scales: FloatArray) -> BoolArray:
        seen = np.einsum("nij,dj->ndi", rotations, directions.model) - directions.camera
        along = np.einsum("ndi,dij->ndj", seen, axes)
        agree = (weights * along**2).sum(axis=2) < _MOST_SIGMAS**2
        gaps = (known - np.log(scales))[:, np.isfinite(known)]
        spread = np.ptp(gaps, axis=1) if gaps.size else np.zeros(len(scales))
        return np.asarray(agree.all(axis=1) & (spread < _MOST_SIGMAS * _ROUGH_STRETCH))

    return possible


def _begun(
    problem: JointProblem, start: Resembling, surface: Surface, contour: ViewContour
) -> tuple[_Start | None, int]:
    """A start before its first step towards the mask's outline; and iterations that led there."""
    _, minima, iterations, _ = find_minima(problem, [start.alignment], None)
    if not minima:
        return None, iterations
    best = minima[0]
    masked = Masked(best.evidence, len(problem.prior.ids), [contour], surface)
    part = contour.shown_by(start.line)
    shown = masked if part is contour else masked._replace(views=[part])
    approach = FirstSteps.begun(shown, best.state, is_wide=True)
    return _Start(best, masked, shown, approach), iterations


def _symmetry_of(model: Model | ShapeModel) -> Symmetry | None:
    """The symmetry under which alignments are equal; a learned shape's mirror is none."""
    return model.symmetry if isinstance(model, Model) else None


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


def _chosen(proposals: list[_Proposal], symmetry: Symmetry | None) -> list[_Proposal]:
    """The distinct ones of sorted proposals that are about as likely as the best."""
    likely = [each for each in proposals if each.cost <= proposals[0].cost + _CLOSE]
    poses = [poses_of(each.minimum.evidence, each.minimum.state)[0] for each in likely]
    return distinct(zip(poses, likely, strict=True), _MOST_PROPOSALS, symmetry)
