"""Minima of all evidence about an object, over all components of its shape and focal lengths."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.consensus import Support, area_of, check_support
from cadalign.estimation.joint_robust import (
    Consensus,
    robust_minima,
    robust_starts,
    whitened_lengths,
    with_sightings,
)
from cadalign.estimation.lenses import ROUNDS, Lenses
from cadalign.estimation.options import LOSSES, FitOptions, RansacOptions
from cadalign.estimation.pack import evidence_of
from cadalign.estimation.prior import ShapePrior
from cadalign.estimation.starts import Start, Starts, starts_of
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.io.evidence import Size
from cadalign.solvers.joint.evidence import Evidence, Shape, State
from cadalign.solvers.joint.search import refine_joint, score_state, search_joint

_MOST_PER_FOCAL = 8  # starts of one pose, at each focal length of the grid
_MOST_PER_FOCAL_OF_SEVERAL = 3
_ITERATIONS = 100
_MOST_FREE = 2  # scales that keypoints determine; the size follows from other evidence


Inits = Sequence[Alignment | None]
"""Given starts: one for each view of unknown motion, or one in the frame that the views share."""


class JointProblem(NamedTuple):
    """Views of an object with a prior shape, in the terms of the user."""

    prior: ShapePrior
    views: Sequence[View]
    size: Size | None
    options: FitOptions
    lenses: Lenses
    noise: float = 1.0  # [px], where it is not given

    def evidence(self, shape: Shape, lenses: Lenses) -> Evidence:
        """The evidence about one component of the shape, with rays of ``lenses``."""
        everything = evidence_of(
            self.prior,
            self.views,
            self.size,
            loss=LOSSES[self.options.loss],
            loss_scale=self.options.loss_scale,
            lenses=lenses,
            noise=self.noise,
        )
        return everything._replace(shape=shape)


class Minimum(NamedTuple):
    """An estimate under one component of the prior; ``score`` is -2 log of its probability.

    The state's focal lengths are relative to those of ``lenses``.
    """

    component: int
    inliers: BoolArray
    evidence: Evidence
    state: State
    cost: float
    score: float
    lenses: Lenses


def find_minima(
    problem: JointProblem, init: Inits, ransac: RansacOptions | None
) -> tuple[list[Minimum], int, int]:
    """Minima, the likeliest first, and the numbers of iterations and of starts.

    Raises
    ------
    NoConsensusError
        With ``ransac``: if the likeliest has no more support by keypoints than chance gives.
    """
    minima: list[Minimum] = []
    iterations = hypotheses = 0
    for number, shape in enumerate(problem.prior.components):
        evidence = problem.evidence(shape, problem.lenses)
        starts = _starts(problem, shape, init, ransac)
        hypotheses += len(starts.poses)
        if not len(starts.poses):
            continue
        if ransac is None:
            found, used = _search(evidence, starts)
        else:
            threshold = _thresholds(evidence, problem.lenses, ransac.max_reproj_error)
            found, used = robust_minima(evidence, starts, threshold, settles=ransac.refine)
        iterations += used
        prior_score = -2 * float(np.log(problem.prior.weights[number]))
        minima.extend(
            Minimum(number, *each._replace(score=each.score + prior_score), problem.lenses)
            for each in found
        )
    if ransac is not None and minima:
        _check_support(problem, min(minima, key=lambda each: each.score), ransac.max_reproj_error)
    if problem.lenses.have_distortion:
        minima = [_relinearised(problem, each) for each in minima]
    minima.sort(key=lambda minimum: minimum.score)
    return minima, iterations, hypotheses


def _starts(
    problem: JointProblem, shape: Shape, init: Inits, ransac: RansacOptions | None
) -> Starts:
    """Starts at every focal length of the grid, or at those that are known."""
    lenses = problem.lenses
    found = []
    for log_focals in lenses.grid():
        known = Lenses(tuple(lenses.cameras_at(log_focals)), (-1,) * len(lenses.cameras))
        evidence = problem.evidence(shape, known)
        first = _start(init, evidence)
        if ransac is None:
            starts = starts_of(evidence, first)
        else:
            trusted = [cast("FloatArray | None", view.confidences) for view in problem.views]
            starts = robust_starts(evidence, ransac, trusted, first)
        if lenses.count:
            one = starts.poses.shape[1] == 1
            most = _MOST_PER_FOCAL if one else _MOST_PER_FOCAL_OF_SEVERAL
            poses, log_scales = starts.poses[:most], starts.log_scales[:most]
            starts = Starts(poses, np.tile(log_focals, (len(poses), 1)), log_scales)
        found.append(starts)
    return Starts(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _search(evidence: Evidence, starts: Starts) -> tuple[list[Consensus], int]:
    """Minima of all sightings together, and the iterations they took."""
    minima, iterations = search_joint(evidence, *starts)
    all_of_them = np.ones(len(evidence.sightings.point), dtype=bool)
    found = [
        Consensus(all_of_them, evidence, state, float(cost), float(score))
        for state, cost, score in zip(*minima, strict=True)
    ]
    return found, iterations


def _relinearised(problem: JointProblem, minimum: Minimum) -> Minimum:
    """The minimum with lenses linearised about its own focal lengths."""
    score = minimum.score - score_state(minimum.evidence, minimum.state)
    for _ in range(ROUNDS):
        log_focals = minimum.state.log_focals
        if Lenses.is_settled(log_focals):
            break
        lenses = minimum.lenses.at(log_focals)
        there = problem.evidence(minimum.evidence.shape, lenses)
        evidence = with_sightings(there, minimum.inliers)
        state = minimum.state._replace(log_focals=np.zeros_like(log_focals))
        cost, state, _, _ = refine_joint(evidence, _ITERATIONS, state)
        if not cost < np.inf:
            break
        minimum = minimum._replace(evidence=evidence, state=state, cost=cost, lenses=lenses)
    return minimum._replace(score=score_state(minimum.evidence, minimum.state) + score)


def _check_support(problem: JointProblem, best: Minimum, max_reproj_error: float) -> None:
    """Refuse a minimum that chance gives as well; few keypoints leave that to other evidence."""
    views, rig, sightings = problem.views, best.evidence.rig, best.evidence.sightings
    limits = _thresholds(best.evidence, best.lenses, 1.0)
    errors = whitened_lengths(best.evidence, best.state) / limits
    areas = np.array(
        [
            area_of(cast(FloatArray, view.points_2d), view.camera, max_reproj_error)
            if len(view.keypoint_ids)
            else 1.0
            for view in views
        ]
    )
    free = int(best.evidence.scales.free.sum())
    size = 3 + min(free, _MOST_FREE) // 2 + (problem.lenses.count > 0)
    supports = []
    for pose in range(int(rig.pose.max()) + 1):
        seen = np.flatnonzero(rig.pose == pose)
        area = float(areas[seen].max())
        own = np.isin(sightings.image, seen)
        relative = errors[own] * np.sqrt(area / areas[sightings.image[own]])
        count = sum(len(views[view].keypoint_ids) for view in seen.tolist())
        if count > size:
            supports.append(Support(relative, count, area))
    if supports:
        left_out = len(best.inliers) - len(errors)
        score = float((errors**2).sum() + left_out * max_reproj_error**2)
        check_support(supports, size, max_reproj_error=max_reproj_error, score=score, where="views")


def _thresholds(evidence: Evidence, lenses: Lenses, max_reproj_error: float) -> FloatArray:
    """Largest whitened residuals (N,) of inliers."""
    sightings = evidence.sightings
    focal = np.array([np.sqrt(camera.fx * camera.fy) for camera in lenses.cameras])
    root = np.sqrt(sightings.whitening[:, 0] * sightings.whitening[:, 2])
    return max_reproj_error / focal[sightings.image] * root


def _start(init: Inits, evidence: Evidence) -> Start | None:
    """Given alignments as a start; where the size is held, they shrink about their cameras."""
    given = [each for each in init if each is not None]
    if not given:
        return None
    held = evidence.scales.free == 0
    poses: list[FloatArray | None] = [None] * (int(evidence.rig.pose.max()) + 1)
    for number, each in enumerate(init):
        if each is None:
            continue
        size = np.array(each.scale)[held].mean() if held.any() else 1.0
        poses[number] = np.concatenate([each.rotation.ravel(), each.translation / size])
    scale = np.array(given[0].scale)
    if held.any():
        scale = np.where(held, 1.0, scale / scale[held].mean())
    return Start(poses, np.log(scale))
