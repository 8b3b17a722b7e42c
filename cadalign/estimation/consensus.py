"""Consensus of one view's keypoints, by LO-RANSAC over the minimal solver."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, as_floats
from cadalign.errors import CadalignError, DegenerateError, InputError
from cadalign.estimation.focal import check_estimable, focal_grid, prior_of_camera
from cadalign.estimation.options import (
    MINIMAL_SOLVERS,
    FitOptions,
    RansacOptions,
)
from cadalign.estimation.problems import (
    Problems,
    Solutions,
    are_in_one_plane,
    rays_of,
    whitening_of,
)
from cadalign.estimation.solve import camera_of, solve_one
from cadalign.estimation.uncertainty.residuals import (
    SOLUTIONS_OF_FOUR,
    Support,
    area_of,
    check_support,
    disagreeing,
    log_expected_by_chance,
    share_as_moderate,
)
from cadalign.estimation.warning import EstimateWarning
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera, faced, turned_poses
from cadalign.solvers.alignment import Objective
from cadalign.solvers.constants import LINEAR, POSE_SIZE, SAMPLE_SIZES
from cadalign.solvers.evidence import KeypointEvidence
from cadalign.solvers.ransac import Settings, ransac_kernel

_MOST_EXHAUSTIVE = 1000  # subsets that are all tried rather than drawn from
_CHANCE = 0.2  # bound on the expected number of models; 1 in 50 such problems has one
_SIGMAS = 3.0  # that the threshold of inliers is taken to be where the noise is not known
_INLIER_ROUNDS = 5
_STRETCH_SIGMA = 1.0  # of log scales, by which alignments are compared: outliers invite extremes


class Consensus(NamedTuple):
    """An alignment with the keypoints (n,) that support it, and the residuals (n, 2) [px] of all.

    ``score`` is the truncated sum of squares [px^2].
    """

    alignment: Alignment
    camera: Camera
    inliers: BoolArray
    residuals: FloatArray
    iterations: int
    hypotheses: int
    score: float


@dataclass(frozen=True, eq=False)
class RobustSearch:
    """The only problem, and how to search for the keypoints that agree."""

    problems: Problems
    options: FitOptions
    ransac: RansacOptions
    scores: npt.ArrayLike | None

    @property
    def area(self) -> float:
        """The area [px^2] over which outliers are scattered."""
        return area_of(self.problems.points_2d, self.problems.cameras[0], self.threshold)

    @property
    def threshold(self) -> float:
        """Largest reprojection error of an inlier [px]."""
        return self.ransac.threshold(self.options.sigma)

    def residuals_of(self, alignment: Alignment, camera: Camera) -> FloatArray:
        """Projected minus observed keypoints (n, 2) [px]; infinite behind the camera."""
        projected = camera.project_where_ahead(alignment.apply(self.problems.points_3d))
        return projected - self.problems.points_2d

    def check(self, best: Consensus) -> None:
        """Refuse a hypothesis that has no more support than chance gives: NoConsensusError.

        It carries the best score reached.
        """
        options, share = self.options, 1.0  # of alignments by chance that are stretched as little
        if not options.prior_weight and options.focal == "known" and options.stretched_axes:
            share = share_as_moderate(best.alignment.scale, len(options.stretched_axes))
        check_support(
            [self._support(best.residuals, best.inliers)],
            self._sample_size,
            max_reproj_error=self.threshold,
            score=best.score,
            where="points_2d",
            solutions=SOLUTIONS_OF_FOUR,
            chance=_CHANCE,
            share=share,
            disagreeing=disagreeing(np.linalg.norm(best.residuals, axis=1), best.inliers),
        )

    def doubt(self, residuals: FloatArray, inliers: BoolArray) -> EstimateWarning | None:
        """Warn where chance supports as many, and a moderate stretch alone speaks for them.

        ``residuals`` (n, 2) [px] and ``inliers`` (n,) are those of the estimate.
        """
        support = self._support(residuals, inliers)
        expected = log_expected_by_chance(support, self._sample_size, SOLUTIONS_OF_FOUR)
        if expected <= np.log(_CHANCE):
            return None
        return EstimateWarning(
            "chance",
            f"{int(inliers.sum())} of {len(inliers)} keypoints agree, hardly more than chance "
            "gives: check the others, or give more",
        )

    @property
    def _sample_size(self) -> int:
        """Keypoints that determine an alignment; a focal length takes half of one."""
        size = SAMPLE_SIZES[MINIMAL_SOLVERS[self.ransac.minimal]]
        return size + (self.options.focal == "estimate")

    def _support(self, residuals: FloatArray, inliers: BoolArray) -> Support:
        errors = np.linalg.norm(residuals[inliers], axis=1)
        return Support(errors, len(inliers), self.area)


def find_consensus(search: RobustSearch) -> Consensus:
    """Find the best hypothesis of LO-RANSAC, which chance may give as well.

    Raises InputError if the keypoints are fewer than the minimal solver needs, or options don't go
    together; DegenerateError if all keypoints lie in one plane.
    """
    if search.options.focal == "estimate":
        return _consensus_over_focals(search)
    problems, options, ransac = search.problems, search.options, search.ransac
    camera, points = problems.cameras[0], problems.points_3d[:, options.axis_order]
    count, minimal = len(points), MINIMAL_SOLVERS[ransac.minimal]
    size = SAMPLE_SIZES[minimal]
    if count < size:
        raise InputError(
            f"{count} keypoints are too few", where="points_3d", fix=f"give at least {size}"
        )
    by_score = _order_of_scores(search.scores, count)
    order = np.random.default_rng(ransac.seed).permutation(count)
    ranked = np.arange(count) if by_score is None else np.argsort(order)[by_score]
    facing = faced(camera, problems.points_2d)
    facing.require_focal()
    rays = rays_of(problems.points_2d[order], facing, clips=True)
    first = np.ascontiguousarray(points[order])
    keypoints = KeypointEvidence(first, rays, whitening_of(1.0, rays, facing), LINEAR, 1.0)
    exhaustive = math.comb(count, size) <= _MOST_EXHAUSTIVE
    pose = np.zeros(POSE_SIZE)
    inliers = np.zeros(count, dtype=bool)
    score, iterations, hypotheses = ransac_kernel(
        Objective(options.free, keypoints, options.scale_prior),
        ranked,
        Settings(
            threshold=search.threshold,
            minimal=minimal,
            size=size,
            max_iterations=_MOST_EXHAUSTIVE if exhaustive else int(ransac.max_iterations),
            min_iterations=_MOST_EXHAUSTIVE if exhaustive else int(ransac.min_iterations),
            success_prob=float(ransac.success_prob),
            seed=int(ransac.seed),
            exhaustive=exhaustive,
            guided=by_score is not None,
            optimize=ransac.refine,
        ),
        pose,
        inliers,
    )
    if not hypotheses and are_in_one_plane(points):
        raise DegenerateError(
            "all keypoints lie in one plane, where the samples of ransac determine nothing",
            where="points_3d",
            fix="leave ransac away: use loss='cauchy', with stretch= or stretch_sigma=",
        )
    pose = turned_poses(options.in_model_axes(pose), facing.lens_from_camera)
    alignment = Alignment.from_packed(pose)
    kept = np.empty(count, dtype=bool)
    kept[order] = inliers
    residuals, effort = search.residuals_of(alignment, camera), (int(iterations), int(hypotheses))
    return Consensus(alignment, camera, kept, residuals, *effort, float(score))


def _consensus_over_focals(search: RobustSearch) -> Consensus:
    """The best consensus at a grid of focal lengths, then with that of the inliers' optimum."""
    camera, given = search.problems.cameras[0], search.options.focal_prior
    check_estimable([camera])
    grid, prior = focal_grid(camera, given), prior_of_camera(given, camera)
    middle = grid[len(grid) // 2] if prior is None else prior.focal
    best: Consensus | None = None
    hypotheses = 0
    failure: InputError | None = None
    own = replace(search, options=replace(search.options, focal="known", focal_prior=None))
    for focal in grid[np.argsort(np.abs(np.log(grid / middle)), kind="stable")].tolist():
        problems = replace(search.problems, cameras=(camera.with_focal(focal),))
        try:
            found = find_consensus(replace(own, problems=problems))
        except InputError as error:  # the lens model cannot be undone there
            failure = error
            continue
        hypotheses += found.hypotheses
        if best is None or found.score < best.score:
            best = found
            # As many samples find any larger support at another focal length.
            most = min(own.ransac.max_iterations, max(found.iterations, 1))
            own = replace(own, ransac=replace(own.ransac, max_iterations=most))
    if best is None:
        assert failure is not None
        raise failure
    if search.ransac.refine:
        with suppress(CadalignError):  # too few keypoints agree
            best = refined(search, best).consensus
            squares = (best.residuals**2).sum(axis=1)
            best = best._replace(score=float(np.minimum(squares, search.threshold**2).sum()))
    return best._replace(hypotheses=hypotheses)


class Refined(NamedTuple):
    """A consensus whose alignment is the optimum of its inliers, and this optimum."""

    consensus: Consensus
    problems: Problems
    solutions: Solutions
    options: FitOptions


def refined(search: RobustSearch, best: Consensus) -> Refined:
    """Find the optimum of the inliers, until these don't change.

    Raises CadalignError if they do not determine the alignment.
    """
    given, inliers, sigma = search.problems, best.inliers, search.options.sigma
    for last in range(_INLIER_ROUNDS + 1):
        some, options = given.chosen(inliers), search.options
        if sigma is not None and np.ndim(sigma) > 0:
            options = replace(options, sigma=np.asarray(sigma, dtype=np.float64)[inliers])
        solutions = solve_one(some, options)
        alignment = Alignment.from_packed(solutions.poses[0, 0])
        camera = camera_of(some, solutions, 0)
        residuals = search.residuals_of(alignment, camera)
        kept = np.linalg.norm(residuals, axis=1) < search.threshold
        if (kept == inliers).all() or kept.sum() < inliers.sum() or last == _INLIER_ROUNDS:
            break
        inliers = kept
    found = best._replace(alignment=alignment, camera=camera, inliers=inliers, residuals=residuals)
    return Refined(found, some, solutions, options)


def _order_of_scores(scores: npt.ArrayLike | None, count: int) -> npt.NDArray[np.intp] | None:
    """The order of falling scores; None where there are none, or all are alike."""
    if scores is None:
        return None
    values = as_floats(scores, name="scores", shape=(count,))
    if (values < 0).any():
        raise InputError(
            f"keypoint {int(np.argmax(values < 0))} has the score {values.min():g}",
            where="scores",
            fix="give numbers that are not negative",
        )
    return np.argsort(-values, kind="stable") if np.ptp(values) > 0 else None
