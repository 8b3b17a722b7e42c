"""Starts of a joint estimate: poses that the keypoints of each view suggest for the mean shape."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.solvers.constants import UNKNOWNS
from cadalign.solvers.joint.evidence import Evidence, Shape
from cadalign.solvers.optimal import optimal_batch

_MOST_PER_VIEW = 8
_MOST = 24
_LEAST_POINTS = 3
_UNLIKELY = 60.0  # excess cost of a pose of the mean shape that is still a start
_LEAST_DEPTH = 1e-9
_FLATNESS = 0.01  # displacement that no image shows, relative to the extent


def starts_of(evidence: Evidence) -> tuple[FloatArray, FloatArray]:
    """Poses (S, P, 12) and log scales (S, 3); none where every view has too few keypoints.

    Where every view has a pose of its own, the likeliest ones are taken together, and then one of
    them replaced by the next. The shape's uncertainty, seen from the distance at which the mean has
    the size of its image, widens the keypoints' own.
    """
    rig = evidence.rig
    poses = int(rig.pose.max()) + 1
    per_pose: list[list[tuple[FloatArray, FloatArray]]] = [[] for _ in range(poses)]
    for view in range(len(rig.pose)):
        found = _of_view(evidence, view)
        camera = rig.cam_from_rig[view]
        moved = [(in_rig(pose, camera), scales) for pose, scales in found]
        per_pose[rig.pose[view]].extend(moved)
    if not all(per_pose):
        return np.empty((0, poses, 12)), np.empty((0, 3))
    first = [0] * poses
    others = [
        [*first[:p], rank, *first[p + 1 :]]
        for rank in range(1, _MOST_PER_VIEW)
        for p in range(poses)
        if rank < len(per_pose[p])
    ]
    combinations = [first, *others][:_MOST]
    chosen = [[per_pose[p][k] for p, k in enumerate(ranks)] for ranks in combinations]
    stacked = np.array([[pose for pose, _ in each] for each in chosen]).reshape(-1, poses, 12)
    scales = np.array([each[0][1] for each in chosen]).reshape(-1, 3)
    return stacked, scales


class ViewRays(NamedTuple):
    """Keypoints of one view: points (n, 3) of the mean, rays (n, 2), and whitening (n, 3)."""

    points: FloatArray
    rays: FloatArray
    whitening: FloatArray
    rows: IntArray


def rays_in(evidence: Evidence, view: int) -> ViewRays:
    """One view's keypoints, the shape's uncertainty in their whitening."""
    sightings = evidence.sightings
    rows = np.flatnonzero((sightings.image == view) & (sightings.whitening[:, 2] > 0))
    names = sightings.point[rows]
    points = np.ascontiguousarray(evidence.shape.mean[names])
    rays = np.ascontiguousarray(sightings.rays[rows])
    if not len(rows):
        return ViewRays(points, rays, np.empty((0, 3)), rows)
    return ViewRays(points, rays, _widened(evidence, points, rays, rows, names), rows)


def _of_view(evidence: Evidence, view: int) -> list[tuple[FloatArray, FloatArray]]:
    """Camera poses (12,) and log scales (3,) from one view's keypoints, the likeliest first."""
    given = rays_in(evidence, view)
    if len(given.rows) < _LEAST_POINTS:
        return []
    sightings, scales = evidence.sightings, evidence.scales
    order = _axis_order(scales.free)
    free = np.ones(UNKNOWNS)
    free[6:] = scales.free[order[1:]]
    found, costs, _, _, info = optimal_batch(
        np.ascontiguousarray(given.points[:, order]),
        given.rays,
        given.whitening,
        np.array([0, len(given.rows)]),
        int(sightings.loss[given.rows[0]]),
        np.array([float(sightings.loss_scale[given.rows[0]])]),
        np.array([float(scales.precision[order[1], order[1]])]),
        free,
        _LEAST_POINTS,
    )
    count = min(int(info[0, 0]), _MOST_PER_VIEW)
    kept = [k for k in range(count) if costs[0, k] < costs[0, 0] + _UNLIKELY]
    place = np.argsort(order)
    columns = np.concatenate([place, 3 + place, 6 + place, [9, 10, 11], 12 + place])
    starts = [(found[0, k, columns[:12]], np.log(found[0, k, columns[12:]])) for k in kept]
    if scales.free.any():
        return starts
    turns = _half_turns(evidence.shape, given.points, sightings.point[given.rows])
    return starts + [(_after(pose, turn), logs) for turn in turns for pose, logs in starts]


def _half_turns(shape: Shape, points: FloatArray, names: IntArray) -> list[FloatArray]:
    """Motions (12,) of the model by half a turn that leave it a likely shape.

    The mean does not show such an ambiguity: a blade whose width varies more than it measures looks
    much the same from behind, with its edge and its back exchanged.
    """
    centre = points.mean(axis=0)
    offsets = points - centre
    modes = shape.modes[:, names].reshape(len(shape.modes), -1)
    own = np.repeat(shape.spread[names] ** 2, 3) + (_FLATNESS**2 * (offsets**2).sum(axis=1).max())
    largest = float((modes**2).sum(axis=1).max(initial=0.0) + own.max())
    found = []
    for axis in np.linalg.svd(offsets, full_matrices=False)[2]:
        turn = 2 * np.outer(axis, axis) - np.eye(3)
        moved = (offsets @ turn - offsets).ravel()
        if moved @ moved > _UNLIKELY * largest:  # a bound that spares the next line
            continue
        if moved @ np.linalg.solve(modes.T @ modes + np.diag(own), moved) < _UNLIKELY:
            found.append(np.concatenate([turn.ravel(), centre - turn @ centre]))
    return found


def _after(pose: FloatArray, motion: FloatArray) -> FloatArray:
    """The pose (12,) of a model that was moved first."""
    rotation = pose[:9].reshape(3, 3)
    turned = rotation @ motion[:9].reshape(3, 3)
    return np.concatenate([turned.ravel(), rotation @ motion[9:] + pose[9:]])


def _axis_order(free: FloatArray) -> IntArray:
    """The model's axes in the solvers' order: one whose scale is known first, no reflection."""
    first = int(np.argmin(free))
    return np.array([first, (first + 1) % 3, (first + 2) % 3])


def _widened(
    evidence: Evidence, points: FloatArray, rays: FloatArray, rows: IntArray, names: IntArray
) -> FloatArray:
    """Whitening (n, 3) of the rays with the shape's own variance in it."""
    shape, whitening = evidence.shape, evidence.sightings.whitening[rows]
    variance = (shape.modes[:, names] ** 2).sum(axis=(0, 2)) / 3 + shape.spread[names] ** 2
    extent = points.std(axis=0)
    seen = rays.std(axis=0)
    depth = np.sqrt((extent**2).sum() * 2 / 3 / max((seen**2).sum(), 1e-30))
    of_rays = variance / max(depth, _LEAST_DEPTH) ** 2
    if not of_rays.any():
        return np.ascontiguousarray(whitening)
    # The variances add up for a whitening (a, b, c) whose b is small beside a and c.
    widened = (
        whitening
        / np.sqrt(1 + of_rays * (whitening[:, 0] ** 2 + whitening[:, 2] ** 2) / 2)[:, None]
    )
    return np.ascontiguousarray(widened)


def in_rig(pose: FloatArray, camera: FloatArray) -> FloatArray:
    """A camera's pose (12,) of the model as the rig's."""
    rotation, translation = camera[:9].reshape(3, 3), camera[9:]
    turned = rotation.T @ pose[:9].reshape(3, 3)
    return np.concatenate([turned.ravel(), rotation.T @ (pose[9:] - translation)])
