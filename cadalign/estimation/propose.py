"""First stage of an estimate: propose starts at known focal lengths, or at a grid of them."""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray, read_only
from cadalign.estimation.options import MINIMAL_SOLVERS, RansacOptions
from cadalign.estimation.prior import Lenses, is_exact
from cadalign.estimation.problem import Inits, Problem
from cadalign.estimation.problems import sample_weights
from cadalign.estimation.starts import Start, Starts, rig_pose, starts_of
from cadalign.solvers.constants import CAUCHY, LINEAR, SAMPLE_SIZES
from cadalign.solvers.joint.evidence import Evidence, Shape
from cadalign.solvers.joint.search import costs_at, keypoints_of
from cadalign.solvers.ransac import rigid_hypotheses

_MOST_PER_FOCAL = 8  # starts at each focal length of the grid, for one pose
_MOST_PER_FOCAL_OF_SEVERAL = 3  # the same for several poses
_SAME_BRANCH = 0.6  # largest chord between rotations of one minimum at neighbouring focal lengths
_INLIER_RATIO = 0.4
_LIMIT = 9.0  # squared whitened residual of a keypoint that supports a hypothesis
_REFINED = 8


class _FocalStarts(NamedTuple):
    """Starts at one focal length of each lens, with their costs (S,) there."""

    lenses: Lenses
    starts: Starts
    costs: FloatArray


def propose(problem: Problem, shape: Shape, init: Inits) -> tuple[Lenses, Starts]:
    """Starts for one component of the shape, and the lenses that their log focals refer to."""
    lenses = problem.lenses
    if not lenses.count:
        return lenses, _starts_at(problem, problem.evidence(shape, lenses), init)
    found: list[_FocalStarts] = []
    for log_focals in lenses.grid():
        there = lenses.replace_focals(log_focals)
        evidence = problem.evidence(shape, there)
        starts = _starts_at(problem, evidence, init)
        one = starts.poses.shape[1] == 1
        most = _MOST_PER_FOCAL if one else _MOST_PER_FOCAL_OF_SEVERAL
        starts = Starts(*(column[:most] for column in starts))
        found.append(_FocalStarts(there, starts, costs_at(evidence, *starts)))
    leaves_out = problem.ransac is None and is_exact(evidence)
    return lenses, _merge(found, lenses, leaves_out=leaves_out)


def _starts_at(problem: Problem, evidence: Evidence, init: Inits) -> Starts:
    first, ransac = _start(init, evidence), problem.ransac
    if ransac is None:
        return starts_of(evidence, first)
    starts = starts_of(add_cauchy_loss(evidence), first)
    if evidence.rig.pose.max() > 0:
        return starts
    samples = np.array(
        [
            rig_pose(pose, camera)
            for view, camera in enumerate(evidence.rig.cam_from_rig)
            for pose in _hypotheses(evidence, view, ransac, _weights_of(problem, view))
        ]
    ).reshape(-1, 12)
    count, focals = len(samples), starts.log_focals.shape[1]
    return Starts(
        np.concatenate([starts.poses, samples[:, None]]),
        np.concatenate([starts.log_focals, np.zeros((count, focals))]),
        np.concatenate([starts.log_scales, np.zeros((count, 3))]),
    )


def _merge(found: list[_FocalStarts], lenses: Lenses, *, leaves_out: bool) -> Starts:
    """Sort starts by cost, relative to ``lenses``; ``leaves_out`` keeps `_local_minima` only."""
    number = np.repeat(np.arange(len(found)), [len(each.costs) for each in found])
    costs = np.concatenate([each.costs for each in found])
    poses = np.concatenate([each.starts.poses for each in found])
    log_scales = np.concatenate([each.starts.log_scales for each in found])
    logs = np.log([each.lenses.focal_lengths / lenses.focal_lengths for each in found])
    order = np.argsort(costs, kind="stable")
    if leaves_out:
        order = order[_local_minima(poses, costs, number)[order]]
    return Starts(poses[order], logs[number[order]], log_scales[order])


def _local_minima(poses: FloatArray, costs: FloatArray, number: IntArray) -> BoolArray:
    """True (S,) for starts that cost no more than similar ones at neighbouring focal lengths."""
    turns = poses[:, None, :, :9] - poses[None, :, :, :9]
    is_one = (np.linalg.norm(turns, axis=-1) < _SAME_BRANCH).all(axis=-1)
    is_next = np.abs(number[:, None] - number) == 1
    return np.asarray(~(is_one & is_next & (costs < costs[:, None])).any(axis=1))


def _start(init: Inits, evidence: Evidence) -> Start | None:
    """Given alignments as a start; a fixed size scales them about their cameras."""
    given = [each for each in init if each is not None]
    if not given:
        return None
    held = evidence.scales.free == 0
    poses: list[FloatArray | None] = [None] * (int(evidence.rig.pose.max()) + 1)
    for number, each in enumerate(init):
        if each is None:
            continue
        size = np.array(each.scale)[held].mean() if held.any() else 1.0
        poses[evidence.rig.pose[number]] = np.concatenate(
            [each.rotation.ravel(), each.translation / size]
        )
    scale = np.array(given[0].scale)
    if held.any():
        scale = np.where(held, 1.0, scale / scale[held].mean())
    return poses, np.log(scale)


def add_cauchy_loss(evidence: Evidence) -> Evidence:
    old = evidence.sightings
    return evidence._replace(sightings=old._replace(loss=np.full(len(old.loss), CAUCHY)))


def _hypotheses(
    evidence: Evidence, view: int, ransac: RansacOptions, weights: tuple[float, ...]
) -> FloatArray:
    """Camera poses (S, 12) from small samples of one view's keypoints, the best supported first."""
    given = keypoints_of(evidence, view)._replace(loss=LINEAR)
    count, size = len(given.points), SAMPLE_SIZES[MINIMAL_SOLVERS[ransac.minimal]]
    if count < size:
        return np.empty((0, 12))
    poses, supports = rigid_hypotheses(given, _samples(count, size, ransac, weights), _LIMIT)
    order = np.argsort(supports)[:_REFINED]
    return poses[order[np.isfinite(supports[order])], :12]


def _weights_of(problem: Problem, number: int) -> tuple[float, ...]:
    """The weights of a view's keypoints in samples, in the order of the evidence."""
    view = problem.views[number]
    weights = sample_weights(view.scores, len(view.keypoint_ids)).tolist()
    rows = problem.prior.rows_of(view.keypoint_ids, f"views[{number}].ids")
    return tuple(weights[place] for place in np.argsort(rows, kind="stable") if weights)


def _samples(count: int, size: int, ransac: RansacOptions, weights: tuple[float, ...]) -> IntArray:
    """Samples (S, size): all, or enough for 40 % inliers, half of them weighted."""
    without = math.log(1 - ransac.success_prob) / math.log1p(-(_INLIER_RATIO**size))
    wanted = min(max(math.ceil(without), ransac.min_iterations), ransac.max_iterations)
    if math.comb(count, size) <= wanted:
        return np.array(list(combinations(range(count), size)))
    return _random_samples(count, size, wanted, ransac.seed, weights)


@lru_cache(maxsize=16)  # reused at every focal length and in every diagnosis
def _random_samples(
    count: int, size: int, wanted: int, seed: int, weights: tuple[float, ...]
) -> IntArray:
    rng = np.random.default_rng(seed)
    draws = [
        rng.choice(count, size, replace=False, p=(weights or None) if k % 2 else None)
        for k in range(wanted)
    ]
    return read_only(np.unique(np.sort(draws, axis=1), axis=0))
