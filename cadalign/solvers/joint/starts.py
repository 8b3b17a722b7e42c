"""Starts of a joint estimate: poses that the keypoints of one view suggest for the mean shape."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import kernel
from cadalign.solvers.constants import UNKNOWNS, ScalePrior
from cadalign.solvers.joint.evidence import Evidence
from cadalign.solvers.optimal import optimal_batch
from cadalign.solvers.starts import widen_by_shape

MOST_PER_VIEW = 8
_LEAST_POINTS = 3
_UNLIKELY = 60.0  # excess cost of a pose of the mean shape that is still a start


class ViewRays(NamedTuple):
    """Keypoints of one view: points (n, 3) of the mean, rays (n, 2), and whitening (n, 3).

    ``rows`` (n,) are their numbers among all sightings.
    """

    points: FloatArray
    rays: FloatArray
    whitening: FloatArray
    rows: IntArray


@kernel
def rays_in(evidence: Evidence, view: int) -> ViewRays:
    """One view's keypoints, the shape's uncertainty in their whitening."""
    sightings, shape = evidence.sightings, evidence.shape
    rows = np.flatnonzero((sightings.image == view) & (sightings.whitening[:, 2] > 0.0))
    count = len(rows)
    points, rays = np.empty((count, 3)), np.empty((count, 2))
    whitening = np.empty((count, 3))
    for n in range(count):
        points[n] = shape.mean[sightings.point[rows[n]]]
        rays[n] = sightings.rays[rows[n]]
        whitening[n] = sightings.whitening[rows[n]]
    variances = np.empty(count)
    for n in range(count):
        i = sightings.point[rows[n]]
        variances[n] = shape.spread[i] ** 2
        for k in range(shape.modes.shape[0]):
            for a in range(3):
                variances[n] += shape.modes[k, i, a] ** 2 / 3.0
    if count > 0:
        widen_by_shape(points, rays, variances, whitening)
    return ViewRays(points, rays, whitening, rows)


@kernel
def view_starts(evidence: Evidence, view: int) -> tuple[FloatArray, FloatArray]:
    """Camera poses (S, 12) and log scales (S, 3) from one view's keypoints, the likeliest first."""
    given = rays_in(evidence, view)
    sightings, scales = evidence.sightings, evidence.scales
    if len(given.rows) < _LEAST_POINTS:
        return np.empty((0, 12)), np.empty((0, 3))
    # The solvers' first axis is one whose scale is known; the order of the others is cyclic, since
    # it must not be a reflection.
    first = np.argmin(scales.free)
    order = np.array([first, (first + 1) % 3, (first + 2) % 3])
    free = np.ones(UNKNOWNS)
    points = np.empty_like(given.points)
    for a in range(3):
        points[:, a] = given.points[:, order[a]]
        if a > 0:
            free[5 + a] = scales.free[order[a]]
    weight = scales.precision[order[1], order[1]]
    prior = ScalePrior(weight, 0.0) if weight > 0.0 else scales.bound
    found, costs, _, _, info = optimal_batch(
        points,
        given.rays,
        given.whitening,
        np.array([0, len(given.rows)]),
        sightings.loss[given.rows[0]],
        np.array([sightings.loss_scale[given.rows[0]]]),
        np.array([prior.weight]),
        prior.width,
        free,
        _LEAST_POINTS,
    )
    count = 0
    while count < min(info[0, 0], MOST_PER_VIEW) and costs[0, count] < costs[0, 0] + _UNLIKELY:
        count += 1
    poses, logs = np.empty((count, 12)), np.empty((count, 3))
    for k in range(count):
        for a in range(3):
            for r in range(3):
                poses[k, 3 * r + order[a]] = found[0, k, 3 * r + a]
            poses[k, 9 + a] = found[0, k, 9 + a]
            logs[k, order[a]] = np.log(found[0, k, 12 + a])
    return poses, logs
