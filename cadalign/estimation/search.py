"""Minima of all evidence about an object, over all components of its shape and focal lengths."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.joint_robust import (
    Consensus,
    find_consensus,
    robust_starts,
    with_sightings,
)
from cadalign.estimation.lenses import ROUNDS, Lenses
from cadalign.estimation.model import Size
from cadalign.estimation.options import LOSSES, FitOptions, RansacOptions
from cadalign.estimation.pack import evidence_of
from cadalign.estimation.prior import ShapePrior
from cadalign.estimation.starts import Start, Starts, starts_of
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.solvers.joint.evidence import Evidence, Shape, State
from cadalign.solvers.joint.search import refine_joint, score_state, search_joint

_MOST_PER_FOCAL = 8  # starts of one pose, at each focal length of the grid
_MOST_PER_FOCAL_OF_SEVERAL = 3
_ITERATIONS = 100


class Problem(NamedTuple):
    """Views of an object with a prior shape, in the terms of the user."""

    prior: ShapePrior
    views: Sequence[View]
    size: Size | None
    options: FitOptions
    lenses: Lenses

    def evidence(self, shape: Shape, lenses: Lenses) -> Evidence:
        """The evidence about one component of the shape, with rays of ``lenses``."""
        everything = evidence_of(
            self.prior,
            self.views,
            self.size,
            loss=LOSSES[self.options.loss],
            loss_scale=self.options.loss_scale,
            lenses=lenses,
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
    problem: Problem, init: Alignment | None, ransac: RansacOptions | None
) -> tuple[list[Minimum], int, int]:
    """Minima, the likeliest first, and the numbers of iterations and of starts."""
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
            found, used = find_consensus(evidence, starts, threshold)
        iterations += used
        prior_score = -2 * float(np.log(problem.prior.weights[number]))
        minima.extend(
            Minimum(number, *each._replace(score=each.score + prior_score), problem.lenses)
            for each in found
        )
    if problem.lenses.have_distortion:
        minima = [_relinearised(problem, each) for each in minima]
    minima.sort(key=lambda minimum: minimum.score)
    return minima, iterations, hypotheses


def _starts(
    problem: Problem, shape: Shape, init: Alignment | None, ransac: RansacOptions | None
) -> Starts:
    """Starts at every focal length of the grid, or at those that are known."""
    lenses = problem.lenses
    found = []
    for log_focals in lenses.grid():
        known = Lenses(tuple(lenses.cameras_at(log_focals)), (-1,) * len(lenses.cameras))
        evidence = problem.evidence(shape, known)
        first = None if init is None else _start(init, evidence)
        if ransac is None:
            starts = starts_of(evidence, first)
        else:
            starts = robust_starts(evidence, int(ransac.seed), first)
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


def _relinearised(problem: Problem, minimum: Minimum) -> Minimum:
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


def _thresholds(evidence: Evidence, lenses: Lenses, max_reproj_error: float) -> FloatArray:
    """Largest whitened residuals (N,) of inliers."""
    sightings = evidence.sightings
    focal = np.array([np.sqrt(camera.fx * camera.fy) for camera in lenses.cameras])
    root = np.sqrt(sightings.whitening[:, 0] * sightings.whitening[:, 2])
    return max_reproj_error / focal[sightings.image] * root


def _start(init: Alignment, evidence: Evidence) -> Start:
    """A given alignment as a start; where the size is held, it shrinks about the origin."""
    rotation, translation, scale = init.rotation, init.translation, np.array(init.scale)
    held = evidence.scales.free == 0
    if held.any():
        size = scale[held].mean()
        scale, translation = np.where(held, 1.0, scale / size), translation / size
    return Start(np.concatenate([rotation.ravel(), translation]), np.log(scale))
