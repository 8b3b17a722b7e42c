"""Robust fits of one view's keypoints, to those that support its best alignment.

Where the noise is known, consensus of LO-RANSAC over the minimal solver gives the inliers.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, as_floats
from cadalign.errors import CadalignError, DegenerateError, InputError, NoConsensusError
from cadalign.estimation.assemble import result_of_keypoints, result_of_solution
from cadalign.estimation.facing import faced, turned_poses
from cadalign.estimation.focal import check_estimable, log_focal_range
from cadalign.estimation.focal_search import focal_views
from cadalign.estimation.mistakes import (
    LEAST_ERROR,
    SOLUTIONS_OF_FOUR,
    Explained,
    Mistake,
    Support,
    area_of,
    check_support,
    disagreeing,
    find_mistake,
    larger_sizes,
    log_expected_by_chance,
)
from cadalign.estimation.options import (
    MINIMAL_SOLVERS,
    FitOptions,
    RansacOptions,
    pixel_information,
)
from cadalign.estimation.problems import (
    Problems,
    are_in_one_plane,
    check_sigmas,
    rays_of,
    whitening_of,
)
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import FitStats
from cadalign.estimation.solve import solve_one
from cadalign.estimation.uncertainty.residuals import f_quantile
from cadalign.estimation.uncertainty.stated import KeypointStatistics
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.solvers.alignment import Objective
from cadalign.solvers.constants import LINEAR, POSE_SIZE, SAMPLE_SIZES
from cadalign.solvers.evidence import KeypointEvidence, LogFocalPrior, Views
from cadalign.solvers.ransac import Settings, ransac_kernel

_MOST_EXHAUSTIVE = 1000  # subsets that are all tried rather than drawn from
_CHANCE = 0.2  # bound on the expected number of models; 1 in 50 such problems has one
_SIGMAS = 3.0  # that the threshold of inliers is taken to be where the noise is not known
_STRETCH_SIGMA = 1.0  # of log scales, by which alignments are compared: outliers invite extremes
_INLIER_ROUNDS = 5
_REACH = 3.0  # estimated sigmas within which keypoints agree
_FIRST, _FACTOR = 4.0, 2.0  # thresholds [px]
_WIDEST = 0.25  # threshold, over the keypoints' extent
_PREFERENCE = math.log(1000)  # for Cauchy's loss, whose estimate is the more accurate one
_LEAST_KEYPOINTS = 5
_SMALL_CHANCE = 0.01  # that an alignment to scattered keypoints leaves so small residuals


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

    def without(self, mistake: Mistake) -> RobustSearch:
        """The search with a mistake undone."""
        given = self.problems
        points_3d = mistake.undo_3d(given.points_3d)
        points_2d = mistake.undo_2d(given.points_2d, given.cameras[0])
        return replace(self, problems=replace(given, points_3d=points_3d, points_2d=points_2d))

    def residuals_of(self, alignment: Alignment, camera: Camera) -> FloatArray:
        """Projected minus observed keypoints (n, 2) [px]; infinite behind the camera."""
        projected = camera.project_where_ahead(alignment.apply(self.problems.points_3d))
        return projected - self.problems.points_2d

    def check(self, best: Consensus) -> None:
        """Refuse a hypothesis that has no more support than chance gives: NoConsensusError.

        It carries the best score reached.
        """
        errors = np.linalg.norm(best.residuals[best.inliers], axis=1)
        size = SAMPLE_SIZES[MINIMAL_SOLVERS[self.ransac.minimal]]
        check_support(
            [Support(errors, len(best.inliers), self.area)],
            size + (self.options.focal == "estimate"),  # which half a keypoint determines
            max_reproj_error=self.threshold,
            score=best.score,
            where="points_2d",
            solutions=SOLUTIONS_OF_FOUR,
            chance=_CHANCE,
            disagreeing=disagreeing(np.linalg.norm(best.residuals, axis=1), best.inliers),
        )

    @np.errstate(all="ignore")  # residuals that overflow are outliers'
    def explained(self, alignment: Alignment, residuals: FloatArray) -> Explained:
        """Likelihood of all keypoints with residuals (n, 2) [px]: an outlier lies anywhere."""
        sigma, limit = self.options.sigma, self.threshold
        if sigma is None:
            sigma = limit / _SIGMAS
        information = pixel_information(sigma, len(residuals))
        kept = np.linalg.norm(residuals, axis=1) < limit
        finite = np.where(kept[:, None], residuals, 0.0)
        squares = np.einsum("ni,nij,nj->n", finite, information, finite)
        normal = squares + math.log(4 * math.pi**2) - np.log(np.linalg.det(information))
        uniform = 2 * math.log(self.area)
        score = np.where(kept, np.minimum(normal, uniform), uniform).sum()
        score += (np.log(alignment.scale) ** 2).sum() / _STRETCH_SIGMA**2
        return Explained(float(score), int(kept.sum()), -float(alignment.rotation[1, 1]))


@np.errstate(all="ignore")  # what is not finite explains nothing
def mistake_in(search: RobustSearch, found: Explained) -> str | None:
    """Name the mistake without which the keypoints agree better; see `find_mistake`.

    ``found`` is what the estimate explains.
    """
    given = len(search.problems.points_2d)

    def explain(mistake: Mistake) -> Explained | None:
        own = search.without(mistake)
        try:
            if found.inliers == given:  # which samples need not be drawn for
                solved = solve_one(own.problems, own.options)
                return own.explained(Alignment.from_packed(solved.poses[0, 0]), solved.residuals)
            best = find_consensus(own)
            own.check(best)
            return own.explained(best.alignment, best.residuals)
        except CadalignError:
            return None

    sizes = larger_sizes(search.problems.points_2d, search.problems.cameras[0])
    return find_mistake(found, given, explain, sizes)


def find_consensus(search: RobustSearch) -> Consensus:
    """Find the best hypothesis of LO-RANSAC, which chance may give as well.

    Raises InputError if the keypoints are fewer than the minimal solver needs, or options don't go
    together; DegenerateError if all keypoints lie in one plane.
    """
    problems, options, ransac = search.problems, search.options, search.ransac
    camera, points = problems.cameras[0], problems.points_3d[:, options.axis_order]
    count, minimal = len(points), MINIMAL_SOLVERS[ransac.minimal]
    size = SAMPLE_SIZES[minimal]
    if count < size:
        raise InputError(
            f"{count} keypoints are too few", where="points_3d", fix=f"give at least {size}"
        )
    if options.focal == "estimate" and ransac.minimal != "ap4p":
        raise InputError(
            f"{ransac.minimal!r} does not estimate the focal length",
            where="minimal",
            fix="leave it at 'ap4p'",
        )
    by_score = _order_of_scores(search.scores, count)
    order = np.random.default_rng(ransac.seed).permutation(count)
    ranked = np.arange(count) if by_score is None else np.argsort(order)[by_score]
    facing = faced(camera, problems.points_2d)
    if options.focal == "estimate":
        check_estimable([facing])
        views = focal_views(problems.points_2d[order], facing, options.focal_prior, None)
    else:
        facing.require_focal()
        rays = rays_of(problems.points_2d[order], facing, clips=True)
        weights = whitening_of(1.0, rays, facing)
        views = Views(np.array([facing.fx]), rays[None], weights[None])
    first = np.ascontiguousarray(points[order])
    keypoints = KeypointEvidence(first, views.rays[0], views.whitening[0], LINEAR, 1.0)
    exhaustive = math.comb(count, size) <= _MOST_EXHAUSTIVE
    pose = np.zeros(POSE_SIZE)
    inliers = np.zeros(count, dtype=bool)
    score, log_focal, iterations, hypotheses = ransac_kernel(
        Objective(options.free, keypoints, options.scale_prior),
        views,
        np.log(views.focals),
        LogFocalPrior(*log_focal_range(camera, options.focal_prior)),
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
            estimate_focal=options.focal == "estimate",
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
    if options.focal == "estimate":
        camera = camera.with_focal(math.exp(log_focal))
    pose = turned_poses(options.in_model_axes(pose), facing.lens_from_camera)
    alignment = Alignment.from_packed(pose)
    kept = np.empty(count, dtype=bool)
    kept[order] = inliers
    residuals, effort = search.residuals_of(alignment, camera), (int(iterations), int(hypotheses))
    return Consensus(alignment, camera, kept, residuals, *effort, float(score))


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


def fit_robustly(
    problems: Problems,
    options: FitOptions,
    ransac: RansacOptions,
    scores: npt.ArrayLike | None,
    start: float,
) -> Result:
    """Fit the only problem to the keypoints that support its best alignment.

    Raises NoConsensusError if no alignment has more support than chance gives; it carries the best
    score reached.
    """
    if options.method != "optimal":
        raise InputError(
            f"the method {options.method!r} does not go with ransac",
            where="method",
            fix="leave it at 'optimal'; RansacOptions(minimal=...) names the minimal solver",
        )
    check_sigmas([options.sigma], problems.counts)
    given = replace(  # the caller may go on to change theirs
        problems, points_3d=problems.points_3d.copy(), points_2d=problems.points_2d.copy()
    )
    trusted = None if scores is None else np.array(scores)
    search = RobustSearch(given, options, ransac, trusted)
    best, refined = _found(search), None
    # As many samples would find the support that a corrected mistake gives, which is more.
    ransac = replace(ransac, max_iterations=best.iterations)
    points = given.points_3d
    if ransac.refine:
        best, refined = _refined(search, best, start)
    fitted = {
        "points_3d": points,
        "residuals": best.residuals,
        "inliers": best.inliers,
        "alignment": best.alignment,
        "camera": best.camera,
        "options": options,
        "sigma": refined and refined.sigma,
        "fisher_covariance": None if refined is None else refined.fisher_covariance,
        "search": replace(search, ransac=ransac),
    }
    ratio, seconds = float(best.inliers.mean()), time.perf_counter() - start
    others = () if refined is None else refined.alternatives
    return result_of_keypoints(
        problems.points_2d,
        fitted,
        method=f"ransac-{ransac.minimal if refined is None else refined.method}",
        stats=FitStats(best.iterations, best.hypotheses, seconds, ratio, best.score),
        cost=None if refined is None else refined.cost,
        alternatives=tuple(replace(each, points_3d=points) for each in others),
    )


def _found(search: RobustSearch) -> Consensus:
    """The consensus; where there is none, the error names the mistake that is to blame."""
    best = find_consensus(search)
    try:
        search.check(best)
    except NoConsensusError as error:
        found = search.explained(best.alignment, best.residuals)
        error.fix = mistake_in(search, found) or error.fix
        raise
    return best


def _refined(search: RobustSearch, best: Consensus, start: float) -> tuple[Consensus, Result]:
    """The optimum for the inliers, until these don't change, and its result."""
    given, inliers, sigma = search.problems, best.inliers, search.options.sigma
    for last in range(_INLIER_ROUNDS + 1):
        some, options = given.chosen(inliers), search.options
        if sigma is not None and np.ndim(sigma) > 0:
            options = replace(options, sigma=np.asarray(sigma, dtype=np.float64)[inliers])
        seconds = time.perf_counter() - start
        result = result_of_solution(some, solve_one(some, options), options, seconds)
        residuals = search.residuals_of(result.alignment, result.camera)
        kept = np.linalg.norm(residuals, axis=1) < search.threshold
        if (kept == inliers).all() or kept.sum() < inliers.sum() or last == _INLIER_ROUNDS:
            break
        inliers = kept
    found = best._replace(
        alignment=result.alignment, camera=result.camera, inliers=inliers, residuals=residuals
    )
    return found, result


def fit_similar_robustly(
    problems: Problems,
    options: FitOptions,
    ransac: RansacOptions,
    scores: npt.ArrayLike | None,
    start: float,
) -> Result:
    """Fit the only problem, whose keypoints' standard deviation is to be estimated.

    Of a model that is only similar the noise, and with it the threshold, is unknown. Two estimates
    compete: the alignment under Cauchy's loss, which tolerates some outliers and any noise, and the
    consensus at thresholds from a few pixels up, which tolerates most keypoints being outliers, but
    not that all of them are off by more than the threshold. The one whose inliers chance explains
    less wins. Raises NoConsensusError if both explain the keypoints no better than chance.
    """
    tolerant = _under_cauchy(problems, options, start)
    strict: tuple[Result, float] | None = None
    refusal: CadalignError | None = None
    extent = float(np.ptp(problems.points_2d, axis=0).max(initial=0.0))
    threshold = _FIRST
    while threshold == _FIRST or threshold <= _WIDEST * extent:
        chosen = replace(ransac, max_reproj_error=threshold)
        try:
            found = fit_robustly(problems, options, chosen, scores, start)
        except (NoConsensusError, DegenerateError) as error:
            refusal = refusal or error
        else:
            if strict is None or _by_chance(found, threshold) < _by_chance(*strict):
                strict = found, threshold
        threshold *= _FACTOR
    if tolerant is not None:
        reach = _reach(tolerant)
        if strict is None or _by_chance(tolerant, reach) - _PREFERENCE <= _by_chance(*strict):
            if strict is None and not _is_explained(tolerant, options):
                raise _refused(tolerant)
            return tolerant
    if strict is None:
        assert refusal is not None
        raise refusal
    return strict[0]


def _under_cauchy(problems: Problems, options: FitOptions, start: float) -> Result | None:
    """The alignment under Cauchy's loss, its inliers marked; None where there is none."""
    own = replace(options, loss="cauchy" if options.loss == "linear" else options.loss)
    try:
        result = result_of_solution(problems, solve_one(problems, own), own, 0.0)
    except CadalignError:
        return None
    near = np.linalg.norm(result.residuals, axis=1) <= _reach(result)
    if near.sum() < min(_LEAST_KEYPOINTS, len(near)):
        return None
    statistics = replace(cast(KeypointStatistics, result.statistics), inliers=near)
    seconds = time.perf_counter() - start
    return replace(
        result,
        views=(replace(result.views[0], inliers=near, statistics=statistics),),
        statistics=statistics,
        method="robust-optimal",
        stats=replace(result.stats, seconds=seconds, inlier_ratio=float(near.mean())),
    )


def _by_chance(result: Result, threshold: float) -> float:
    """Log of the number of alignments that chance supports as well; see `support`."""
    errors = np.linalg.norm(result.residuals[result.inliers], axis=1)
    view = result.views[0]
    area = area_of(view.points_2d, view.camera, threshold)
    return log_expected_by_chance(Support(errors, len(result.inliers), area), 4, SOLUTIONS_OF_FOUR)


def _is_explained(result: Result, options: FitOptions) -> bool:
    """True if the alignment explains more of the keypoints' places than chance would.

    An F test of the residuals against those of the keypoints' mean.
    """
    kept = result.inliers
    residuals, pixels = result.residuals[kept], result.views[0].points_2d[kept]
    left = float((residuals**2).sum())
    total = float(((pixels - pixels.mean(axis=0)) ** 2).sum())
    unknowns = options.unknowns - 2
    redundancy = 2 * len(pixels) - options.unknowns
    if redundancy < 1:
        return True
    ratio = (total - left) / unknowns / max(left / redundancy, 1e-300)
    return ratio > f_quantile(unknowns, redundancy, _SMALL_CHANCE)


def _reach(result: Result) -> float:
    """Largest residual of a keypoint that agrees [px]."""
    return max(_REACH * (result.sigma or 0.0), LEAST_ERROR)


def _refused(result: Result) -> NoConsensusError:
    """The error of keypoints that no alignment explains, with those that disagree most."""
    errors = np.linalg.norm(result.residuals, axis=1)
    typical = errors <= np.median(errors)
    return NoConsensusError(
        f"no alignment is supported: the best leaves residuals of {np.median(errors):.3g} px, as "
        f"chance does; {disagreeing(errors, typical)}",
        where="points_2d",
        fix="check which keypoint is which, the model and the camera; give sigma or "
        "max_reproj_error where you know them, or a learned shape",
        inliers=int(result.inliers.sum()),
    )
