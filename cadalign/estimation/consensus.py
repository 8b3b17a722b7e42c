"""Fit one view's keypoints with outliers: LO-RANSAC, then a fit to the inliers."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import CadalignError, DegenerateError, InputError, NoConsensusError
from cadalign.estimation.options import MINIMAL_SOLVERS, FitOptions, RansacOptions
from cadalign.estimation.problems import Problems, rays_of, sample_weights, whitening_of
from cadalign.estimation.result_parts import EstimateWarning, FitStats, FittedKeypoints
from cadalign.estimation.solve import fit_keypoints
from cadalign.estimation.uncertainty.residuals import (
    SOLUTIONS_OF_FOUR,
    Support,
    area_of,
    check_support,
    log_expected_by_chance,
    share_as_moderate,
)
from cadalign.geometry.alignment import Alignment, describe_plane
from cadalign.geometry.camera import face_pixels, rotate_poses
from cadalign.solvers.alignment import Objective
from cadalign.solvers.constants import LINEAR, POSE_SIZE, SAMPLE_SIZES
from cadalign.solvers.evidence import KeypointEvidence
from cadalign.solvers.ransac import Settings, ransac_kernel

_MOST_EXHAUSTIVE = 1000  # subsets, up to which all are tried
_CHANCE = 0.2  # largest expected number of alignments by chance
_INLIER_ROUNDS = 5
_FIRST, _FACTOR = 4.0, 2.0  # first threshold [px], and ratio of the next ones, at unknown noise
_WIDEST = 0.25  # largest threshold, relative to the keypoints' extent


@dataclass(frozen=True, eq=False)
class RobustSearch:
    """One problem with the options of its robust search."""

    problems: Problems
    options: FitOptions
    ransac: RansacOptions
    scores: npt.ArrayLike | None

    @property
    def threshold(self) -> float:
        return self.ransac.threshold(self.options.sigma)

    @property
    def sample_size(self) -> int:
        """Least number of keypoints that determine an alignment, and an unknown focal length."""
        size = SAMPLE_SIZES[MINIMAL_SOLVERS[self.ransac.minimal]]
        return size + (self.options.focal == "estimate")

    def residuals_of(self, alignment: Alignment) -> FloatArray:
        """Projected minus observed keypoints (n, 2) [px]; infinite behind the camera."""
        in_camera = alignment.apply(self.problems.points_3d)
        return self.problems.camera.project_where_ahead(in_camera) - self.problems.points_2d

    def support(self, residuals: FloatArray, inliers: BoolArray) -> Support:
        """Support of an estimate with residuals (n, 2) [px] by inliers (n,)."""
        area = area_of(self.problems.points_2d, self.problems.camera, self.threshold)
        return Support(np.linalg.norm(residuals[inliers], axis=1), len(inliers), area)

    def log_chance(self, residuals: FloatArray, inliers: BoolArray) -> float:
        """Log of the expected number of alignments with the same support by chance."""
        support = self.support(residuals, inliers)
        return log_expected_by_chance(support, self.sample_size, SOLUTIONS_OF_FOUR)

    def doubt(self, residuals: FloatArray, inliers: BoolArray) -> EstimateWarning | None:
        """Warn if chance gives as many inliers, so that only a moderate stretch confirms them."""
        if self.log_chance(residuals, inliers) <= math.log(_CHANCE):
            return None
        return EstimateWarning(
            "chance",
            f"{int(inliers.sum())} of {len(inliers)} keypoints agree, hardly more than chance "
            "gives: check the others, or give more",
        )


def fit_robustly(
    problems: Problems,
    options: FitOptions,
    ransac: RansacOptions,
    scores: npt.ArrayLike | None,
    start: float,
) -> FittedKeypoints:
    """Fit one problem to the inliers of its best alignment.

    If neither noise nor threshold is known, several thresholds are tried, and the inliers that are
    least likely by chance win. Raises NoConsensusError if chance explains the inliers; InputError
    for too few keypoints or wrong options; DegenerateError if all keypoints lie in one plane.
    """
    if options.method != "optimal":
        raise InputError(
            f"the method {options.method!r} does not go with ransac",
            where="method",
            fix="leave it at 'optimal'; RansacOptions(minimal=...) names the minimal solver",
        )
    given = replace(  # the caller may change the arrays
        problems, points_3d=problems.points_3d.copy(), points_2d=problems.points_2d.copy()
    )
    trusted = None if scores is None else np.array(scores)
    search = RobustSearch(given, options, ransac, trusted)
    if options.sigma is not None or ransac.max_reproj_error is not None:
        return _fit_to_inliers(search, start)
    thresholds = [_FIRST]
    extent = float(np.ptp(given.points_2d, axis=0).max()) if len(given.points_2d) else 0.0
    while thresholds[-1] * _FACTOR <= _WIDEST * extent:
        thresholds.append(thresholds[-1] * _FACTOR)
    found: list[tuple[float, FittedKeypoints]] = []
    refusals: list[CadalignError] = []
    for threshold in thresholds:
        own = replace(search, ransac=replace(ransac, max_reproj_error=threshold))
        try:
            one = _fit_to_inliers(own, start)
        except (NoConsensusError, DegenerateError) as error:
            refusals.append(error)
        else:
            found.append((own.log_chance(one.residuals, one.inliers), one))
    if not found:
        raise refusals[0]
    return min(found, key=lambda each: each[0])[1]


def _fit_to_inliers(search: RobustSearch, start: float) -> FittedKeypoints:
    """Fit the inliers of the best hypothesis until these don't change."""
    options, ransac, problems = search.options, search.ransac, search.problems
    if options.focal == "estimate":
        # Imported here: most cameras are calibrated, and the kernels import slowly.
        from cadalign.estimation.joint import fit_jointly

        found = fit_jointly(problems, options, ransac, search.scores, start)
        return replace(found, ransac=ransac, doubt=search.doubt)
    alignment, inliers, iterations, hypotheses, score = _best_hypothesis(search)
    residuals = search.residuals_of(alignment)
    share = 1.0  # of alignments by chance with as little stretch
    if not options.prior_weight and options.stretched_axes:
        share = share_as_moderate(alignment.scale, len(options.stretched_axes))
    check_support(
        [search.support(residuals, inliers)],
        search.sample_size,
        max_reproj_error=search.threshold,
        score=score,
        where="points_2d",
        solutions=SOLUTIONS_OF_FOUR,
        chance=_CHANCE,
        share=share,
    )
    points, camera = problems.points_3d, problems.camera
    found = FittedKeypoints(points, residuals, inliers, alignment, camera, options)
    if ransac.refine:
        found = _refine(search, inliers)
    return replace(
        found,
        method=f"ransac-{found.method if ransac.refine else ransac.minimal}",
        stats=FitStats(iterations, hypotheses, time.perf_counter() - start),
        # A corrected mistake has more inliers, so that as many samples suffice for it.
        ransac=replace(ransac, max_iterations=iterations),
        doubt=search.doubt,
    )


def _refine(search: RobustSearch, inliers: BoolArray) -> FittedKeypoints:
    """Fit the inliers (n,) until these don't change; raises CadalignError without an optimum."""
    problems, sigma = search.problems, search.options.sigma
    points, pixels = problems.points_3d, problems.points_2d
    for last in range(_INLIER_ROUNDS + 1):
        offsets, options = np.array([0, int(inliers.sum())]), search.options
        some = Problems(points[inliers], pixels[inliers], offsets, problems.camera)
        if sigma is not None and np.ndim(sigma) > 0:
            options = replace(options, sigma=np.asarray(sigma, dtype=np.float64)[inliers])
        optimum = fit_keypoints(some, options, 0.0)
        residuals = search.residuals_of(optimum.alignment)
        kept = np.linalg.norm(residuals, axis=1) < search.threshold
        if (kept == inliers).all() or kept.sum() < inliers.sum() or last == _INLIER_ROUNDS:
            break
        inliers = kept
    return replace(
        optimum,
        points_3d=points,
        residuals=residuals,
        inliers=inliers,
        options=search.options,
        alternatives=tuple(replace(each, points_3d=points) for each in optimum.alternatives),
    )


def _best_hypothesis(search: RobustSearch) -> tuple[Alignment, BoolArray, int, int, float]:
    """LO-RANSAC's best hypothesis, inliers (n,), numbers of samples and hypotheses, and score."""
    problems, options, ransac = search.problems, search.options, search.ransac
    camera, points = problems.camera, problems.points_3d
    count, minimal = len(points), MINIMAL_SOLVERS[ransac.minimal]
    size = SAMPLE_SIZES[minimal]
    if count < size:
        raise InputError(
            f"{count} keypoints are too few", where="points_3d", fix=f"give at least {size}"
        )
    confidence = sample_weights(search.scores, count)
    order = np.random.default_rng(ransac.seed).permutation(count)
    if len(confidence):
        confidence = np.cumsum(confidence[order])
    facing = face_pixels(camera, problems.points_2d)
    facing.require_focal()
    rays = rays_of(problems.points_2d[order], facing, clips=True)
    whitening_of(options.sigma, rays, facing)  # checks sigma
    first = np.ascontiguousarray(points[order])
    keypoints = KeypointEvidence(first, rays, whitening_of(1.0, rays, facing), LINEAR, 1.0)
    exhaustive = math.comb(count, size) <= _MOST_EXHAUSTIVE
    pose = np.zeros(POSE_SIZE)
    inliers = np.zeros(count, dtype=bool)
    score, iterations, hypotheses = ransac_kernel(
        Objective(options.free, keypoints, options.scale_prior),
        confidence,
        Settings(
            threshold=search.threshold,
            minimal=minimal,
            size=size,
            max_iterations=_MOST_EXHAUSTIVE if exhaustive else int(ransac.max_iterations),
            min_iterations=_MOST_EXHAUSTIVE if exhaustive else int(ransac.min_iterations),
            success_prob=float(ransac.success_prob),
            seed=int(ransac.seed),
            exhaustive=exhaustive,
            optimize=ransac.refine,
        ),
        pose,
        inliers,
    )
    if not hypotheses and (plane := describe_plane(problems.points_3d)):
        raise DegenerateError(
            f"{plane}: samples of ransac do not determine an alignment",
            where="points_3d",
            fix="omit ransac: use loss='cauchy', with stretch= or stretch_sigma=",
        )
    pose = rotate_poses(pose, facing.lens_from_camera)
    kept = np.empty(count, dtype=bool)
    kept[order] = inliers
    return Alignment.from_vector(pose), kept, int(iterations), int(hypotheses), float(score)
