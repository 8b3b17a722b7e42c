"""The first stage of an estimate: starts, at known focal lengths or over a grid of unknown ones."""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.estimation.joint_robust import robust_starts
from cadalign.estimation.prior import Lenses, is_exact
from cadalign.estimation.problem import Inits, Problem
from cadalign.estimation.starts import Start, Starts, starts_of
from cadalign.solvers.joint.evidence import Evidence, Shape
from cadalign.solvers.joint.search import costs_at

_MOST_PER_FOCAL = 8  # starts of one pose, at each focal length of the grid
_MOST_PER_FOCAL_OF_SEVERAL = 3
_SAME_BRANCH = 0.6  # chord between rotations of one minimum at neighbouring focal lengths


class _AtFocals(NamedTuple):
    """Starts at one focal length of each lens, with their costs (S,) there."""

    lenses: Lenses
    starts: Starts
    costs: FloatArray


def propose(problem: Problem, shape: Shape, init: Inits) -> tuple[Lenses, Starts]:
    """Starts for one component of the shape, and the lenses that their focal lengths refer to.

    Unknown focal lengths are those of a grid. Lenses with distortion are those of the start of the
    lowest cost, since they are linear near it. Where a lens cannot be undone there are no starts.

    Raises InputError if it can be undone nowhere.
    """
    lenses = problem.lenses
    if not lenses.count:
        return lenses, _starts_at(problem, problem.evidence(shape, lenses), init)
    found: list[_AtFocals] = []
    failure: InputError | None = None
    for log_focals in lenses.grid():
        there = lenses.at(log_focals)
        try:
            evidence = problem.evidence(shape, there)
        except InputError as error:
            failure = error
            continue
        starts = _starts_at(problem, evidence, init)
        one = starts.poses.shape[1] == 1
        most = _MOST_PER_FOCAL if one else _MOST_PER_FOCAL_OF_SEVERAL
        starts = Starts(*(column[:most] for column in starts))
        found.append(_AtFocals(there, starts, costs_at(evidence, *starts)))
    if failure is not None and not found:
        raise failure
    if lenses.are_distorted:
        best = int(np.argmin([each.costs.min(initial=np.inf) for each in found]))
        lenses = found[best].lenses
    leaves_out = problem.ransac is None and is_exact(evidence)
    return lenses, _merged(found, lenses, leaves_out=leaves_out)


def _starts_at(problem: Problem, evidence: Evidence, init: Inits) -> Starts:
    """Starts at the focal lengths of the rays."""
    first, ransac = _start(init, evidence), problem.ransac
    if ransac is None:
        return starts_of(evidence, first)
    trusted = [cast("FloatArray | None", view.scores) for view in problem.views]
    return robust_starts(evidence, ransac, trusted, first)


def _merged(found: list[_AtFocals], lenses: Lenses, *, leaves_out: bool) -> Starts:
    """All starts by cost, relative to ``lenses``, or those that `_unimproved` leaves."""
    number = np.repeat(np.arange(len(found)), [len(each.costs) for each in found])
    costs = np.concatenate([each.costs for each in found])
    poses = np.concatenate([each.starts.poses for each in found])
    log_scales = np.concatenate([each.starts.log_scales for each in found])
    logs = np.log([each.lenses.focal_lengths / lenses.focal_lengths for each in found])
    order = np.argsort(costs, kind="stable")
    if leaves_out:
        order = order[_unimproved(poses, costs, number)[order]]
    return Starts(poses[order], logs[number[order]], log_scales[order])


def _unimproved(poses: FloatArray, costs: FloatArray, number: IntArray) -> BoolArray:
    """True for starts (S,) that none on the same way, at a neighbouring focal length, betters."""
    turns = poses[:, None, :, :9] - poses[None, :, :, :9]
    is_one = (np.linalg.norm(turns, axis=-1) < _SAME_BRANCH).all(axis=-1)
    is_next = np.abs(number[:, None] - number) == 1
    return np.asarray(~(is_one & is_next & (costs < costs[:, None])).any(axis=1))


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
        poses[evidence.rig.pose[number]] = np.concatenate(
            [each.rotation.ravel(), each.translation / size]
        )
    scale = np.array(given[0].scale)
    if held.any():
        scale = np.where(held, 1.0, scale / scale[held].mean())
    return poses, np.log(scale)
