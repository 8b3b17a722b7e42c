"""Likely estimates as a mixture of Gaussians: their moments, and one for all that are equal.

Estimates are equal under the model's symmetry.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.problem import Problem
from cadalign.estimation.symmetry import carried, is_same, without_free_turns
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera, turned_alignment, turned_covariance
from cadalign.geometry.rotations import vector_from_rotation
from cadalign.geometry.symmetry import Symmetry
from cadalign.geometry.symmetry_group import group_of

_Held = tuple[bool, bool, bool]
_ALONG_AXES = 1e-6  # of a rotation's entries, that are 0 or 1 where it takes axes to axes


class Estimate(NamedTuple):
    """An estimate: points, the box's corners last, ``lengths`` of the box, covariances.

    Poses, covariances (9, 9) and cameras are those of every view that takes part, in the frames of
    the cameras that were given; ``likelihood`` is relative to the best.
    The optimum is the one of the least cost, which a shape without latent unknowns has.
    """

    points: FloatArray
    scale: FloatArray
    poses: tuple[Alignment, ...]
    lengths: FloatArray
    covariances: tuple[FloatArray, ...]
    of_points: FloatArray
    of_seen: FloatArray
    likelihood: float
    cameras: tuple[Camera, ...]
    is_optimum: bool = False


def as_given(estimate: Estimate, problem: Problem) -> Estimate:
    """An estimate in the frames of turned lenses as that in the frames that were given."""
    numbers = problem.numbers
    turns = [problem.turns[number] for number in numbers]
    first = turns[0]
    if all(problem.views[n].camera == problem.given[n].camera for n in numbers):
        return estimate
    wide = [problem.given[number].camera for number in numbers]
    return estimate._replace(
        poses=tuple(map(turned_alignment, estimate.poses, turns)),
        covariances=tuple(map(turned_covariance, estimate.covariances, turns)),
        of_seen=first @ estimate.of_seen @ first.T,
        cameras=tuple(
            given if given.is_wide else own
            for given, own in zip(wide, estimate.cameras, strict=True)
        ),
    )


def moments_of_poses(estimates: Sequence[Estimate], view: int) -> tuple[FloatArray, FloatArray]:
    """Second moments of estimates about the first, in a view's camera, and distances (L,).

    These are squared distances of the rotations from the first one's, in its standard deviations;
    infinite where it has none.
    """
    best, *others = estimates
    total, distances = best.likelihood * best.covariances[view], np.zeros(len(estimates))
    try:
        root = np.linalg.inv(np.linalg.cholesky(best.covariances[view][:3, :3]))
    except np.linalg.LinAlgError:
        root = np.full((3, 3), np.nan)
    for k, each in enumerate(others, start=1):
        step = _step(best, each, view)
        total += each.likelihood * (each.covariances[view] + step[:, None] * step)
        distance = np.square(root @ step[:3]).sum()
        distances[k] = distance if np.isfinite(distance) else np.inf
    return total / sum(each.likelihood for each in estimates), distances


def _step(first: Estimate, second: Estimate, view: int) -> FloatArray:
    """Rotation vector, translation, log lengths and log focal length between estimates."""
    start, end = first.poses[view], second.poses[view]
    before = [*first.lengths.tolist(), first.cameras[view].fx]
    after = [*second.lengths.tolist(), second.cameras[view].fx]
    turn = vector_from_rotation(end.rotation @ start.rotation.T)
    logs = [math.log(b / a) if a > 0 < b else 0.0 for a, b in zip(before, after, strict=True)]
    step = [*turn, *(end.translation - start.translation), *logs]
    return np.array(step[: len(first.covariances[view])])


def moments_of_points(estimates: Sequence[Estimate]) -> tuple[FloatArray, FloatArray]:
    """Second moments (m, 3, 3) of points about the first estimate, in model and first camera."""
    best = estimates[0]
    if len(estimates) == 1:
        return best.of_points, best.of_seen
    weights = np.array([each.likelihood for each in estimates])
    weights /= weights.sum()

    def total(covariances: list[FloatArray], places: list[FloatArray]) -> FloatArray:
        gaps = np.array(places) - places[0]
        squares = gaps[..., None] * gaps[..., None, :]
        return np.asarray(np.tensordot(weights, np.array(covariances) + squares, axes=1))

    return (
        total([e.of_points for e in estimates], [e.points * e.scale for e in estimates]),
        total([e.of_seen for e in estimates], [e.poses[0].apply(e.points) for e in estimates]),
    )


def one_of_equals(
    likely: Sequence[Estimate], symmetry: Symmetry | None, held: _Held
) -> Sequence[Estimate]:
    """Estimates in their canonical form, without those that are equal to the first.

    ``held`` are the axes whose scale is.
    """
    if symmetry is None or group_of(symmetry).is_trivial:
        return likely
    group = group_of(symmetry)
    best, *others = (_canonical(each, symmetry, held) for each in likely)
    covariance = best.covariances[0]
    return [
        best,
        *(each for each in others if not is_same(group, best.poses[0], each.poses[0], covariance)),
    ]


def _canonical(estimate: Estimate, symmetry: Symmetry, held: _Held) -> Estimate:
    """The canonical one of all equal estimates, without standard deviations that mean nothing."""
    best = group_of(symmetry).canonical(estimate.poses[0], held=held)
    turn, shift, scale = best.motion[:3, :3], best.motion[:3, 3], best.alignment.scale
    poses: list[Alignment] = []
    covariances = []
    for given, covariance in zip(estimate.poses, estimate.covariances, strict=True):
        pose = Alignment(given.rotation @ turn, given.translation + given.linear @ shift, scale)
        equal = replace(best, alignment=pose if poses else best.alignment)
        poses.append(equal.alignment)
        covariances.append(without_free_turns(carried(covariance, given, equal), equal))
    points = best.relabelled(estimate.points)
    entries = np.abs(turn)
    if (np.minimum(entries, 1 - entries) > _ALONG_AXES).any():
        points[-2:] = estimate.points[-2:]  # a box that leaves the axes stays as the symmetric is
    else:
        points[-2:] = np.sort(points[-2:], axis=0)
    return estimate._replace(
        points=points,
        scale=scale,
        poses=tuple(poses),
        lengths=(points[-1] - points[-2]) * scale,
        covariances=tuple(covariances),
        of_points=turn.T @ estimate.of_points @ turn,
    )
