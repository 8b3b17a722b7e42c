"""Estimates that are equal under the model's symmetry."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.fitting.joint.estimates import Estimate
from cadalign.fitting.symmetric import is_same, step_to, without_free_turns
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.symmetry import Symmetry
from cadalign.geometry.symmetry_group import Equal, group_of

Held = tuple[bool, bool, bool]
_ALONG_AXES = 1e-6  # of a rotation's entries, that are 0 or 1 where it takes axes to axes


def one_of_equals(
    likely: Sequence[Estimate], symmetry: Symmetry | None, held: Held
) -> list[Estimate]:
    """Estimates in their canonical form, without those that are equal to the first.

    ``held`` are the axes whose scale is.
    """
    if symmetry is None or group_of(symmetry).is_trivial:
        return list(likely)
    group = group_of(symmetry)
    found = [canonical(each, symmetry, held) for each in likely]
    best = found[0]
    return [best] + [
        each
        for each in found[1:]
        if not is_same(group, best.poses[0], each.poses[0], best.covariance)
    ]


def canonical(estimate: Estimate, symmetry: Symmetry, held: Held) -> Estimate:
    """The canonical one of all equal estimates, without deviations that mean nothing."""
    given = estimate.poses[0]
    best = group_of(symmetry).canonical(given, held=held)
    turn = best.motion[:3, :3]
    covariance = without_free_turns(_carried(estimate.covariance, given, best), best)
    points = best.relabelled(estimate.points)
    points[-2:] = _turned_box(estimate.points[-2:], best)
    return estimate._replace(
        points=points,
        scale=best.alignment.scale,
        poses=(best.alignment, *(_turned(pose, best) for pose in estimate.poses[1:])),
        lengths=(points[-1] - points[-2]) * best.alignment.scale,
        covariance=covariance,
        of_points=turn.T @ estimate.of_points @ turn,
    )


def _carried(covariance: FloatArray, given: Alignment, best: Equal) -> FloatArray:
    step = step_to(best, given)
    return np.asarray(step @ covariance @ step.T)


def _turned(pose: Alignment, best: Equal) -> Alignment:
    """An alignment in another view after the symmetry's motion."""
    shift = pose.translation + pose.linear @ best.motion[:3, 3]
    return Alignment(pose.rotation @ best.motion[:3, :3], shift, best.alignment.scale)


def _turned_box(corners: FloatArray, best: Equal) -> FloatArray:
    """Corners (2, 3) of the object's box; a box that leaves the axes stays as the symmetric is."""
    entries = np.abs(best.motion[:3, :3])
    if (np.minimum(entries, 1 - entries) > _ALONG_AXES).any():
        return corners
    return np.sort(best.relabelled(corners), axis=0)
