"""Starts of an estimate from a mask alone, and its keypoints' depths that the surface covers.

Starts are alignments of the own model that resemble the mask. Depths at keypoints that the model's
own surface covers are left out: a depth image shows that surface.
"""

from __future__ import annotations

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
from cadalign.estimation.contours.surface import RigidSurface, Surface, rigid_surface, surfaces_of
from cadalign.estimation.contours.view_contour import (
    ViewContour,
    contour_view,
    correlation_length,
    cost_of_contour,
)
from cadalign.estimation.estimates import poses_of
from cadalign.estimation.focal import prior_of_camera
from cadalign.estimation.joint_robust import LEAST_SEEN, cost_of_hidden, hidden_limits
from cadalign.estimation.model import Model
from cadalign.estimation.pack import evidence_of
from cadalign.estimation.problem import Problem
from cadalign.estimation.search import Minimum, find_minima
from cadalign.estimation.view import View
from cadalign.estimation.warning import EstimateWarning, Warnings
from cadalign.geometry.alignment import model_rays
from cadalign.geometry.camera import Camera, turned_alignment
from cadalign.geometry.mesh import Mesh
from cadalign.solvers.joint.evidence import (
    Evidence,
    ImageDepths,
    State,
    kept_rows,
    points_of,
    seen_in_cameras,
)
from cadalign.solvers.joint.search import refine_joint

_MEETS = 0.003  # standard deviation of a contour that meets the rim, relative to its size
_MEETS_PX = 0.5
_FAR = 0.01  # misfit, relative to the mask's size, of a model that may be another
_FAR_PX = 2.0
_MOST_ENDS = 5
_CLOSE = 1.1  # cost above the least, of a contour's sample, at which an end still counts
_ROUGH_SIZE = 160.0  # [px], of the mask's copy in which starts are followed
_LEAST_PIXEL = 1.3  # of a smaller copy, in those of the mask
_ROUGHLY = np.radians(10.0)  # standard deviation of a start's directions
_ROUGH_STRETCH = 0.3  # of the logarithms of its lengths
_MOST_SIGMAS = 3.0
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


class _End(NamedTuple):
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

    def over(self, best: _End) -> float:
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
        """See `_End`; the contour that is not shown lies anywhere within the reach."""
        reach, residuals = self.approach.first_reach, self.approach.residuals()
        share = len(residuals) / len(self.masked.views[0].contour.points)
        own = cost_of_contour(residuals, reach)
        return share * own + (1 - share) * float(np.log(2 * reach))

    def followed(self, steps: int = MOST_ROUNDS) -> _Start | None:
        """So many steps further, at most; None where no rim comes near the contour."""
        further = self.approach.followed(self.shown, steps)
        return None if further is None else self._replace(approach=further)

    @property
    def end(self) -> _End:
        """The minimum near the start, its outline brought to the mask's."""
        (contour,), here = self.masked.views, self.approach
        if here.reach < here.first_reach or self.shown is not self.masked:
            here = here.widened(self.masked)
        residuals, every = here.residuals(), np.ones(len(contour.contour.points), dtype=bool)
        cost = cost_of_contour(residuals, here.first_reach)
        alike = correlation_length(contour.contour, residuals, every)
        return _End(self.minimum._replace(state=here.place.state), residuals, cost, alike)


def minima_of_mask(
    problem: Problem,
) -> tuple[list[Minimum], int, int, Warnings]:
    """Minima of the evidence beside the mask of the only view, at alignments that resemble it.

    The model is exact and has a mesh. The best is the first; then numbers of iterations and of
    starts, and a warning where the outlines differ.

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
    where = f"views[{view.number}].mask"
    contour, pixel = _rough_contour(view, where, camera)
    ends, steps, starts = _searched(problem, model, contour)
    if not ends:
        raise DegenerateError(
            "no pose gives the model an outline like the mask's",
            where=where,
            fix="check that the mask is nonzero on the object, not around it, and that the model "
            "is the object's; or give an init or keypoints",
        )
    misfit, size = pixel * ends[0].misfit, pixel * contour.contour.size
    warnings: Warnings = ()
    if misfit > max(_FAR_PX, _FAR * size):
        text = (
            f"{where}: the outline of the best pose found is {misfit:.1f} px from the mask's on "
            "average: the object may be partly hidden, the model another, or the pose wrong"
        )
        warnings = (EstimateWarning("mask", text, view.number),)
    likely = [each for each in ends if each.cost <= ends[0].cost + _CLOSE]
    poses = [poses_of(each.minimum.evidence, each.minimum.state)[0] for each in likely]
    chosen = distinct(zip(poses, likely, strict=True), _MOST_ENDS, model.symmetry)
    minima = [each.minimum._replace(outline_score=each.over(chosen[0])) for each in chosen]
    return minima, steps, starts, warnings


def _searched(problem: Problem, model: Model, contour: ViewContour) -> tuple[list[_End], int, int]:
    """Minima near a contour, the likeliest first; numbers of iterations and of starts.

    A search follows those before it where none of these meets the contour.
    """
    surface = rigid_surface(cast(Mesh, model.mesh))
    found: list[_End] = []
    steps, starts = 0, 0
    for search in _SEARCHES:
        begun = []
        for each in _resembling(problem, model, search):
            start, iterations = _begun(problem, each, surface, contour)
            starts, steps = starts + 1, steps + iterations
            tried = None if start is None else start.followed(search.steps)
            if tried is not None:
                begun.append(tried)
        begun.sort(key=lambda start: start.cost)
        ends = [start.followed() for start in begun[: search.kept]]
        found.extend(start.end for start in ends if start is not None)
        found.sort(key=lambda end: end.cost)
        if found and found[0].cost < _met_by(contour):
            break
    return found, steps, starts


def _met_by(contour: ViewContour) -> float:
    """Cost below which an outline is as likely as one that meets the whole contour."""
    sigma = max(_MEETS_PX, _MEETS * contour.contour.size)
    return float(np.log(sigma) + (1 + np.log(2 * np.pi)) / 2)


def _rough_contour(view: View, where: str, camera: Camera) -> tuple[ViewContour, float]:
    """The contour of a view's mask, or of a copy of `_ROUGH_SIZE` where it is larger.

    Then how many of the mask's pixels one of the copy is.
    """
    contour = contour_view(0, view, where, camera)
    pixel = contour.contour.size / _ROUGH_SIZE
    if pixel < _LEAST_PIXEL:
        return contour, 1.0
    mask = np.asarray(view.mask_image, dtype=np.float32)
    width, height = (round(side / pixel) for side in mask.shape[::-1])
    small = np.clip(cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA), 0.0, 1.0)
    sigma = view.mask_sigma and view.mask_sigma / pixel
    smaller = View(view.camera.resized(width, height), mask=small, mask_sigma=sigma)
    return contour_view(0, smaller, where, camera.resized(width, height)), pixel


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
        possible=_possible(problem, mesh),
    )


def _possible(problem: Problem, mesh: Mesh) -> Possible | None:
    """Tell which poses known directions, such as gravity's, and known lengths leave."""
    directions = evidence_of(problem.prior, problem.views, lenses=problem.lenses).directions
    lengths = np.full(3, np.nan) if problem.size is None else problem.size.lengths
    known = np.log(lengths / np.ptp(mesh.bounds, axis=0))
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
    problem: Problem, start: Resembling, surface: RigidSurface, contour: ViewContour
) -> tuple[_Start | None, int]:
    """A start before its first step towards the mask's outline; and iterations that led there."""
    alignment = turned_alignment(start.alignment, problem.turns[0])
    _, minima, iterations, _ = find_minima(problem._replace(ransac=None), [[alignment]])
    if not minima:
        return None, iterations
    best = minima[0]
    masked = Masked(best.evidence, len(problem.prior.ids), [contour], surface)
    part = contour.shown_by(start.line)
    shown = masked if part is contour else masked._replace(views=[part])
    approach = FirstSteps.begun(shown, best.state, is_wide=True)
    return _Start(best, masked, shown, approach), iterations


_ROUNDS = 6
_ITERATIONS = 12
_UNLIKELY = 60.0  # excess score of a minimum that is still tried
_MOST_COVERED = 12
_COVERED = 0.5  # [sigma], of a keypoint behind the surface


def without_covered(problem: Problem, minima: list[Minimum]) -> list[Minimum]:
    """Minima by the depths of keypoints that the model's own surface does not hide, the best first.

    A depth image shows that surface in their place. Where next to none is in view, as of keypoints
    inside of the mesh, minima stay as they are.
    """
    first = minima[0]
    keypoints = len(problem.prior.ids)
    surface = surfaces_of(problem.model, first.points[:keypoints], "views[0].depth").surfaces[0]
    likely = [each for each in minima if not each.score > first.score + _UNLIKELY]
    found: dict[tuple[bytes, float], Minimum] = {}
    for each in likely[:_MOST_COVERED]:
        whole = problem.evidence(each.evidence.shape, each.lenses).image_depths
        uncovered = _uncovered(each, whole, surface)
        depths = uncovered.evidence.image_depths
        found.setdefault((depths.point.tobytes(), round(uncovered.score, 3)), uncovered)
    return sorted(found.values(), key=lambda minimum: minimum.score)


def _uncovered(minimum: Minimum, whole: ImageDepths, surface: Surface) -> Minimum:
    """The minimum by those of the ``whole`` depths that the surface does not hide.

    Where another object hides a keypoint, the depths' robust loss allows for it.
    """
    own = minimum.evidence.image_depths
    evidence, state = minimum.evidence._replace(image_depths=whole), minimum.state
    had = set(zip(own.image.tolist(), own.point.tolist(), strict=True))
    rows = zip(whole.image.tolist(), whole.point.tolist(), strict=True)
    shown = np.array([row in had for row in rows])
    # What the score has beside its evidence and the depths that were left out, of keypoints.
    beside = minimum.prior_score - cost_of_hidden(hidden_limits(evidence, state)[0], shown)
    shown = np.zeros(len(whole.point), dtype=bool)
    for _ in range(_ROUNDS):
        again = ~_is_covered(evidence, state, surface)
        if again.sum() < LEAST_SEEN or (again == shown).all():
            break
        shown = again
        some = evidence._replace(image_depths=kept_rows(whole, shown))
        cost, score, moved = refine_joint(some, _ITERATIONS, state)
        if not np.isfinite(score):
            break
        state = moved
        minimum = minimum._replace(evidence=some, state=state, cost=cost, score=beside + score)
    return minimum


def _is_covered(evidence: Evidence, state: State, surface: Surface) -> BoolArray:
    """Marks the depths (m,) of keypoints that lie behind the surface."""
    depths, posed = evidence.image_depths, surface.at(evidence.shape, state)
    points = points_of(evidence.shape, state)[depths.point]
    seen = seen_in_cameras(evidence, state.poses, points, depths.image)
    covered = np.zeros(len(points), dtype=bool)
    for number, pose in enumerate(poses_of(evidence, state)):
        rows = np.flatnonzero(depths.image == number)
        if not len(rows):
            continue
        origin, model_from_ray = model_rays(pose)
        rays = seen[rows] / seen[rows, 2:]
        face, depth = posed.caster.first_hits(origin, rays @ model_from_ray.T)
        nearer = (seen[rows, 2] - depth) * depths.weight[rows]
        covered[rows] = (face >= 0) & (nearer > _COVERED)
    return covered
