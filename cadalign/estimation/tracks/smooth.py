"""The estimate of a track: shape from some frames, a path through all, then everything together.

The strength of the acceleration is the one of the greatest marginal likelihood: MacKay's fixed
point ("Bayesian interpolation", 1992) of residuals and of the covariance they leave. Keypoints that
do not fit a robust estimate of the track are outliers where these are expected.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import DegenerateError
from cadalign.estimation.contours import refine_with_images
from cadalign.estimation.joint import result_of_minima
from cadalign.estimation.joint_robust import under_cauchy, whitened_lengths, with_sightings
from cadalign.estimation.model import Model
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.prior import Lenses, prior_of, widened
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import FitStats
from cadalign.estimation.search import Inits, JointProblem, Minimum, Track, find_minima, thresholds
from cadalign.estimation.solve import LEAST_LIKELIHOOD
from cadalign.estimation.tracks.frames import (
    Frames,
    SuccessiveErrors,
    best_path,
    candidates_of,
    filled,
    velocities_of,
    weakened,
)
from cadalign.estimation.tracks.motion import Motion, Trajectory
from cadalign.estimation.uncertainty.evidence import count_equations
from cadalign.estimation.uncertainty.posterior import widening_of
from cadalign.estimation.view import View
from cadalign.io.evidence import Size
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.joint.evidence import Evidence
from cadalign.solvers.joint.motion import MotionPrior
from cadalign.solvers.joint.tracks import Path, frame_information, moving_covariance, refine_moving

if TYPE_CHECKING:
    from cadalign.estimation.contours.fit import Refined

_FIRST_ITERATIONS = 15
_ITERATIONS = 60
_STRENGTH_ROUNDS = 12
_STRENGTH_PRECISION = 0.05  # change of its logarithm
_FARTHER = 10.0  # than any frame, where the volume of paths is zero
_LARGEST_CHANGE = 5.0  # factor, of one round
_PSEUDO_COUNT = 1.0  # residuals of the first strength that count as seen
_INLIER_ROUNDS = 4
_CORRELATION_ROUNDS = 3
_OF_MEDIAN = 1.5  # standard deviation over the median of absolute values
_LEAST_STRENGTH = 1e-3  # change of the velocity over the whole track, over its size
_LEAST_SPEED = 1e-6
_MOST_MOTION = 1e13  # information of a motion between two frames, over that of one frame


class EstimatedTrack(NamedTuple):
    """A smooth path of the likeliest component of the shape, and the problem with its noise.

    It has the strength of its motion and the sightings (N,) that it rests on; the ``correlation``
    of errors in successive frames has been taken into account. ``minima`` are those of some frames,
    the likeliest first.
    """

    problem: JointProblem
    minima: Sequence[Minimum]
    evidence: Evidence
    inliers: BoolArray
    path: Path
    motion: MotionPrior
    iterations: int
    hypotheses: int
    correlation: float

    @property
    def minimum(self) -> Minimum:
        """The path as a minimum of all frames' evidence."""
        return self.minima[0]._replace(
            inliers=self.inliers,
            evidence=self.evidence,
            state=self.path.state,
            lenses=self.problem.lenses,
            track=Track(self.motion, self.path.velocities),
        )


def align_track(
    model: Model | ShapeModel,
    motion: Motion,
    size: Size | None,
    options: FitOptions,
    ransac: RansacOptions | None,
    views: Sequence[View],
    inits: Inits,
) -> Result:
    """The result of `cadalign.align` with a motion."""
    start = perf_counter()
    frames, prior = Frames.of(views), prior_of(model)
    problem = JointProblem(
        prior,
        views,
        size,
        options,
        Lenses.of(views, options.focal, options.focal_prior),
        frames=tuple(frames.of_view.tolist()),
    )
    found = estimate_track(problem, frames, motion, inits, ransac)
    found, refined = _with_images(model, found, motion)
    stats = FitStats(found.iterations, found.hypotheses, perf_counter() - start)
    result = _result(model, found, frames, stats)
    for each in refined:
        result = each.noted_in(result)
    return result


def estimate_track(
    problem: JointProblem,
    frames: Frames,
    motion: Motion,
    inits: Inits,
    ransac: RansacOptions | None,
    *,
    may_correlate: bool = True,
) -> EstimatedTrack:
    """All stages of an estimate; errors of successive frames ``may_correlate``."""
    problem, minima, iterations, hypotheses = _of_some(problem, frames, inits, ransac)
    first = minima[0]
    evidence = problem.evidence(first.evidence.shape, problem.lenses)
    path = _first_path(problem, evidence, first, frames, may_skip=ransac is not None)
    limits = None
    if ransac is not None:
        limits = thresholds(evidence, problem.lenses, problem.threshold(ransac))
    used, inliers, path, prior, spent, correlation = _smoothed(
        evidence, path, frames.times, motion, limits, may_correlate=may_correlate
    )
    spent += iterations
    return EstimatedTrack(
        problem, minima, used, inliers, path, prior, spent, hypotheses, correlation
    )


def _with_images(
    model: Model | ShapeModel, found: EstimatedTrack, motion: Motion
) -> tuple[EstimatedTrack, list[Refined]]:
    """The track with the masks and photos of its frames, and what is to be noted of these.

    Their outlines are sought from the smooth path, which then follows what was found.
    """
    problem = found.problem
    (best, *_), refined = refine_with_images(model, problem.prior, problem.views, [found.minimum])
    if not refined:
        return found, refined
    evidence, path = best.evidence, found.path._replace(state=best.state)
    path, prior, spent = _likeliest(evidence, path, found.motion, motion)
    # The other components' shapes lack the outlines' points, and a score without the motion is
    # infinite where frames have no evidence.
    track = found._replace(
        minima=[best._replace(score=found.minima[0].score)],
        evidence=evidence,
        path=path,
        motion=prior,
        iterations=found.iterations + spent,
    )
    return track, refined


def _of_some(
    problem: JointProblem, frames: Frames, inits: Inits, ransac: RansacOptions | None
) -> tuple[JointProblem, Sequence[Minimum], int, int]:
    """The minima of some frames, the likeliest first, and the problem with their noise."""
    numbers = frames.chosen(problem.prior, problem.views)
    views = [problem.views[number] for number in numbers]
    minima: Sequence[Minimum] = ()
    if views:
        options = problem.options
        some = problem._replace(
            views=views,
            lenses=Lenses.of(views, options.focal, options.focal_prior),
            frames=frames.among(numbers),
        )
        known = [inits[number] for number in numbers]
        some, minima, iterations, hypotheses = find_minima(some, known, ransac)
    if not minima:
        raise DegenerateError(
            "no frame has keypoints that determine a pose",
            where="views",
            fix="give at least 3 keypoints in one frame, and check which is which",
        )
    problem = problem._replace(noise=some.noise)
    return problem, minima, iterations, hypotheses


def _first_path(
    problem: JointProblem, evidence: Evidence, first: Minimum, frames: Frames, *, may_skip: bool
) -> Path:
    """The path through all frames' candidates for the shape of some frames."""
    estimated = first.lenses.cameras_at(first.state.log_focals)
    cameras = dict(zip(first.lenses.cameras, estimated, strict=True))
    lenses = tuple(cameras.get(each, each) for each in problem.lenses.cameras)
    known = Lenses(lenses, (-1,) * len(lenses))
    still = problem.evidence(first.evidence.shape, known)
    candidates = candidates_of(under_cauchy(still), first.points * np.exp(first.state.log_scales))
    seen = evidence.rig.pose[evidence.sightings.image]
    counts = np.bincount(seen, minlength=len(frames.times))
    rows = best_path(candidates, frames.times, counts, may_skip=may_skip)
    poses = filled(candidates.poses[rows], candidates.frame[rows], frames.times)
    log_focals = np.zeros(len(evidence.focals.low))
    log_focals[: len(first.state.log_focals)] = first.state.log_focals
    state = first.state._replace(poses=poses, log_focals=log_focals)
    return Path(state, velocities_of(poses, frames.times))


def _smoothed(
    evidence: Evidence,
    path: Path,
    times: FloatArray,
    motion: Motion,
    limits: FloatArray | None,
    *,
    may_correlate: bool,
) -> tuple[Evidence, BoolArray, Path, MotionPrior, int, float]:
    """The smooth path near a first one, with the likeliest strengths where these are not given.

    Sightings whose whitened residuals exceed the ``limits`` (N,) are left out, where there are any.
    Returns the evidence that is used, inliers (N,), path, strengths, iterations and correlation.
    """
    seconds = np.diff(times)
    seen = np.unique(evidence.rig.pose[evidence.sightings.image])
    unknown = _first_strength(path, times, seen)
    prior = MotionPrior(seconds, motion.strength(unknown))
    inliers = np.ones(len(evidence.sightings.point), dtype=bool)
    used = evidence if limits is None else under_cauchy(evidence)
    path, prior, spent = _likeliest(used, path, prior, motion)
    for _ in range(_INLIER_ROUNDS):
        if limits is None:
            break
        kept = whitened_lengths(evidence, path.state) < limits
        if (kept == inliers).all() and used is not evidence:
            break
        inliers, used = kept, with_sightings(evidence, kept)
        path, prior, more = _likeliest(used, path, prior, motion)
        spent += more
    correlation, independent = 0.0, used
    for _ in range(_CORRELATION_ROUNDS if may_correlate else 0):
        found = SuccessiveErrors.of(used, path.state).correlation
        if found <= correlation:
            break
        correlation, used = found, weakened(independent, found)
        path, prior, more = _likeliest(used, path, prior, motion)
        spent += more
    return used, inliers, path, prior, spent, correlation


def _first_strength(path: Path, times: FloatArray, seen: IntArray) -> FloatArray:
    """Strengths (2,) of the changes of a first path's velocity, between frames ``seen`` (n,).

    In others the first path is a straight line, which would say that nothing ever changes.
    """
    seconds, velocities = np.diff(times), path.velocities
    if 1 < len(seen) < len(times):
        velocities = velocities_of(path.state.poses[seen], times[seen])
        times = times[seen]
    changes = np.diff(velocities, axis=0) / np.sqrt(np.diff(times))[:, None]
    sizes = np.array([np.median(np.abs(part)) for part in np.split(changes, 2, axis=1)])
    speeds = np.array([np.abs(part).mean() for part in np.split(path.velocities, 2, axis=1)])
    least = _LEAST_STRENGTH * (speeds + _LEAST_SPEED) / np.sqrt(seconds.sum())
    return np.asarray(np.maximum(_OF_MEDIAN * sizes, least))


def _likeliest(
    evidence: Evidence, path: Path, prior: MotionPrior, motion: Motion
) -> tuple[Path, MotionPrior, int]:
    """The path and the strengths of the greatest marginal likelihood."""
    first, count = prior.strength, 6 * len(prior.seconds)
    least, spent = _least_strength(evidence, path, prior.seconds), 0
    prior = prior._replace(strength=np.maximum(first, least))
    for _ in range(_STRENGTH_ROUNDS):
        cost, path, iterations = refine_moving(
            evidence, prior, path, max_iterations=_FIRST_ITERATIONS
        )
        spent += iterations
        if not cost < np.inf:
            raise DegenerateError(
                "the path leads behind a camera",
                where="views",
                fix="give more keypoints in each frame, or times that agree with them",
            )
        found = moving_covariance(evidence, prior, path)
        if not np.isfinite(found.squares).all():
            break
        told = np.maximum(count - found.variances, 0.0)
        seen = found.squares + _PSEUDO_COUNT * (first / prior.strength) ** 2
        change = np.sqrt(seen / (told + _PSEUDO_COUNT))
        change = np.clip(change, 1 / _LARGEST_CHANGE, _LARGEST_CHANGE)
        strength = np.maximum(motion.strength(prior.strength * change), least)
        farthest = _FARTHER * float(np.linalg.norm(path.state.poses[:, 9:], axis=1).max())
        per_frame = float(told[1]) / len(path.velocities)
        changes = [*np.log(strength / prior.strength), (prior.told - per_frame) / (per_frame + 1)]
        prior = MotionPrior(prior.seconds, strength, per_frame, farthest)
        if np.abs(changes).max() < _STRENGTH_PRECISION:
            break
    _, path, iterations = refine_moving(evidence, prior, path, max_iterations=_ITERATIONS)
    return path, prior, spent + iterations


def _least_strength(evidence: Evidence, path: Path, seconds: FloatArray) -> FloatArray:
    """Strengths (2,) below which rounding of the motion's information hides that of a frame."""
    information = frame_information(evidence, path.state)
    return np.asarray(np.sqrt(12.0 / (_MOST_MOTION * information)) / seconds.min() ** 1.5)


def _of_other_components(best: Minimum, minima: Sequence[Minimum]) -> Iterator[Minimum]:
    """Smooth paths near the best one with other components of the shape that are likely, too."""
    assert best.track is not None
    tried = {best.component}
    for each in minima:
        if each.component in tried or each.score > best.score - 2 * np.log(LEAST_LIKELIHOOD):
            continue
        tried.add(each.component)
        evidence = best.evidence._replace(shape=each.evidence.shape)
        state = best.state._replace(
            log_scales=each.state.log_scales,
            coefficients=each.state.coefficients,
            displacements=each.state.displacements,
        )
        start, prior = Path(state, best.track.velocities), best.track.motion
        cost, path, _ = refine_moving(evidence, prior, start, max_iterations=_ITERATIONS)
        if cost < np.inf:
            track = best.track._replace(velocities=path.velocities)
            yield best._replace(
                component=each.component,
                evidence=evidence,
                state=path.state,
                score=each.score,
                track=track,
            )


def _result(
    model: Model | ShapeModel, found: EstimatedTrack, frames: Frames, stats: FitStats
) -> Result:
    problem, evidence, path = found.problem, found.evidence, found.path
    covariance = moving_covariance(evidence, found.motion, path)
    if not np.isfinite(covariance.costs).all():
        what = "the evidence does not determine the track"
        fix = "give more keypoints, in two frames at least, or a size"
        raise DegenerateError(what, where="views", fix=fix)
    unknowns = 12 * len(frames.times) + int(evidence.scales.free.sum())
    unknowns -= round(float(covariance.variances.sum()))
    redundancy = count_equations(evidence) - len(evidence.shape.modes) - unknowns
    widening = 1.0
    if problem.lacks_sigma:
        widening = widening_of(max(unknowns, 1), max(redundancy, 1))
    track = Track(found.motion, path.velocities, redundancy, widening)
    best = found.minimum._replace(cost=float(covariance.costs[0]), track=track)
    others = _of_other_components(best, found.minima)
    result = result_of_minima(model, problem, [best, *others], stats)
    wide, state = widened(evidence, path.state, problem.prior.inflation)
    covariance = moving_covariance(wide, found.motion, path._replace(state=state))
    turning, moving = found.motion.strength.tolist()
    trajectory = Trajectory(
        frames.times,
        path.state.poses,
        path.velocities,
        widening * covariance.frames,
        widening * covariance.links,
        np.exp(path.state.log_scales),
        Motion(float(np.degrees(turning)), moving),
        found.correlation,
    )
    return replace(result, trajectory=trajectory)
