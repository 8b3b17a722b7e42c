"""Starts of a joint estimate, from each view's keypoints and the mean shape.

A view with too few keypoints for the stretch takes it from the view with the most keypoints. If a
flat object may be seen from either side, starts half a turn away are added.

If the evidence determines the size, all unknowns but the rotation are linear. In a camera (C, c) of
a rig, a model point is at ``X = C (R diag(s) x + t) + c``. Its ray gives ``X_x = u X_z`` and
``X_y = v X_z``, its depth ``X_z = z``; known lengths and camera heights are linear in s and t too.
All views share one system, so that views with one keypoint contribute.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.prior import has_scale_prior, redundancy_of
from cadalign.geometry.rotations import spread_rotations
from cadalign.solvers.constants import LEAST_POINTS
from cadalign.solvers.joint.evidence import (
    Evidence,
    depths_along_axes,
    distances_of,
    kept_rows,
)
from cadalign.solvers.joint.search import view_starts
from cadalign.solvers.marginal.problem import GaussianTarget
from cadalign.solvers.marginal.search import after_motion, half_turns

_MOST_STARTS = 24
_MOST_SIZED = 3

_GRID = 400  # rotations
_MOST_METRIC = 16
_ROUNDS = 2  # of weighting by depth
_RIDGE = 1e-14  # of normal equations with a diagonal of 1
_LEAST_SIZE = 1e-300
_LEAST_SCALE = 1e-6

_Start = tuple[FloatArray, FloatArray]  # a pose (12,) or all poses (P, 12), and log scales (3,)


class Starts(NamedTuple):
    """Starts of a search: ``poses`` (S, P, 12), ``log_focals`` (S, F), ``log_scales`` (S, 3)."""

    poses: FloatArray
    log_focals: FloatArray
    log_scales: FloatArray


Start = tuple[Sequence[FloatArray | None], FloatArray]
"""A given start: a pose (12,) or None for each pose of the evidence, and log scales (3,)."""


def starts_of(evidence: Evidence, init: Start | None = None) -> Starts:
    """Starts at the focal lengths of the rays; none if every view has too few keypoints.

    With several poses, the first start has the likeliest of each; the next ones replace one pose at
    a time. A given start comes first, poses half a turn away come last.
    """
    found = _propose(evidence, init)
    return Starts(
        np.array([poses for poses, _ in found]).reshape(-1, int(evidence.rig.pose.max()) + 1, 12),
        np.zeros((len(found), len(evidence.focals.low))),
        np.array([logs for _, logs in found]).reshape(-1, 3),
    )


def _propose(evidence: Evidence, init: Start | None) -> list[_Start]:
    rig = evidence.rig
    poses = int(rig.pose.max()) + 1
    per_pose: list[list[_Start]] = [[] for _ in range(poses)]
    is_keypoint = evidence.sightings.whitening[:, 2] > 0
    counts = np.bincount(evidence.sightings.image[is_keypoint], minlength=len(rig.pose))
    unknowns = 6 + int(evidence.scales.free.sum())
    is_several = poses > 1 and unknowns > 6
    still = evidence.scales._replace(free=np.zeros(3), precision=np.zeros((3, 3)))
    held = evidence._replace(scales=still)
    for view, camera in enumerate(rig.cam_from_rig):
        is_weak = is_several and 2 * counts[view] <= unknowns
        found, logs = view_starts(held if is_weak else evidence, view)
        turned = _half_turns(evidence, view, found)
        moved = [(rig_pose(pose, camera), scales) for pose, scales in zip(found, logs, strict=True)]
        moved += [(rig_pose(pose, camera), np.zeros(3)) for pose in turned]
        per_pose[rig.pose[view]].extend(moved)
    is_metric = init is None and bool(evidence.scales.free.all())
    if init is not None:
        is_open = redundancy_of(evidence) < 0
        for given, found_of_pose in zip(init[0], per_pose, strict=True):
            if given is None:
                continue
            if is_open:  # the keypoints alone give arbitrary poses
                found_of_pose.clear()
            found_of_pose.insert(0, (given, init[1]))
    elif is_metric and poses == 1:
        placed = _metric_starts(evidence, per_pose[0])
        if placed:
            # Linear scales of nearly planar points are noise, so the likeliest poses from the
            # keypoints alone are added.
            first = [(pose[None], logs) for pose, logs in per_pose[0][:_MOST_SIZED]]
            return placed + [_match_size(evidence, *each) for each in first]
        if rig.is_shared.any():  # the size is undetermined
            return []
    if not all(per_pose):
        return []
    likeliest = [found[0] for found in per_pose]
    others = [
        [*likeliest[:p], per_pose[p][rank], *likeliest[p + 1 :]]
        for rank in range(1, max(len(found) for found in per_pose))
        for p in range(poses)
        if rank < len(per_pose[p])
    ]
    chosen = [likeliest, *others][:_MOST_STARTS]
    best = rig.pose[int(np.argmax(counts))] if init is None else 0  # the pose with the best stretch
    starts = [(np.array([pose for pose, _ in each]), each[best][1]) for each in chosen]
    return [_match_size(evidence, *each) for each in starts] if is_metric else starts


def _match_size(evidence: Evidence, poses: FloatArray, log_scales: FloatArray) -> _Start:
    """Scale a start about the cameras to match measured depths and distances."""
    stretched = evidence.shape.mean * np.exp(log_scales)
    some = kept_rows(evidence.sightings, evidence.sightings.depths[:, 1] > 0)
    depths = depths_along_axes(evidence, poses, stretched[some.point], some.image)
    lengths = distances_of(evidence, poses, stretched)
    ratios = np.concatenate([some.depths[:, 0] / depths, evidence.offsets.value / lengths])
    factor = np.median(ratios) if len(ratios) else np.nan
    if not np.isfinite(factor) or not factor > 0:
        return poses, log_scales
    larger = np.concatenate([poses[:, :9], factor * poses[:, 9:]], axis=1)
    return larger, log_scales + np.log(factor)


def rig_pose(pose: FloatArray, camera: FloatArray) -> FloatArray:
    """Transform a pose (12,) from a camera's frame to the rig's."""
    rotation, translation = camera[:9].reshape(3, 3), camera[9:]
    turned = rotation.T @ pose[:9].reshape(3, 3)
    return np.concatenate([turned.ravel(), rotation.T @ (pose[9:] - translation)])


def _half_turns(evidence: Evidence, view: int, poses: FloatArray) -> list[FloatArray]:
    """Turn poses (12,) by half a turn about each axis that the mean shape allows."""
    sightings, shape = evidence.sightings, evidence.shape
    names = np.unique(sightings.point[(sightings.image == view) & (sightings.whitening[:, 2] > 0)])
    if len(names) < LEAST_POINTS or evidence.scales.free.any():
        return []
    modes = shape.modes[:, names].reshape(len(shape.modes), 3 * len(names))
    covariance = modes.T @ modes + np.diag(np.repeat(shape.spread[names] ** 2, 3))
    motions = half_turns(GaussianTarget(shape.mean[names], covariance))
    return [after_motion(pose, motion) for motion in motions for pose in poses]


class _Rows(NamedTuple):
    """Weighted linear equations of the model's ``points`` (N, 3) in a rig's cameras.

    ``is_ray`` (N,) is 1 for equations of rays, whose standard deviation grows with the depth.
    """

    points: FloatArray
    turns: FloatArray
    shifts: FloatArray
    normals: FloatArray
    right: FloatArray
    weights: FloatArray
    is_ray: FloatArray


def _metric_starts(evidence: Evidence, own: Sequence[_Start]) -> list[_Start]:
    """Likeliest poses (1, 12) and log scales, at rotations of ``own`` or of a grid."""
    rows, is_tied = _rows_of(evidence), has_scale_prior(evidence.scales)
    basis = np.ones((3, 1)) if is_tied else np.eye(3)  # of scales; one if a prior ties them
    given = [pose[:9].reshape(3, 3) for pose, _ in own]
    rotations = np.array(given) if given else spread_rotations(_GRID)
    by_scale = (rows.normals @ rotations) * rows.points
    same = np.broadcast_to(rows.normals, by_scale.shape)
    left = np.concatenate([same, by_scale @ basis], axis=2)
    extra_left, extra_right = _distance_rows(evidence, rotations, basis)
    weights = np.broadcast_to(rows.weights, left.shape[:2])
    for _ in range(_ROUNDS):
        weighted = np.concatenate([left * weights[:, :, None], extra_left], axis=1)
        target = np.concatenate([rows.right * weights, extra_right], axis=1)[:, :, None]
        sizes = np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), _LEAST_SIZE)
        scaled = weighted / sizes
        normal = scaled.swapaxes(1, 2) @ scaled + _RIDGE * np.eye(left.shape[2])
        solved = np.linalg.solve(normal, scaled.swapaxes(1, 2) @ target)
        costs = ((scaled @ solved - target) ** 2).sum(axis=(1, 2))
        found = solved[:, :, 0] / sizes[:, 0]
        scales = found[:, 3:] @ basis.T
        placed = rows.points @ (rotations * scales[:, None]).swapaxes(1, 2) + found[:, None, :3]
        depths = np.einsum("nj,snj->sn", rows.turns[:, 2], placed) + rows.shifts[:, 2]
        weights = rows.weights / np.where(rows.is_ray > 0, np.maximum(depths, 1e-3), 1.0)
    valid = (scales > _LEAST_SCALE).all(axis=1) & (depths > 0).all(axis=1) & np.isfinite(costs)
    costs = np.where(valid, costs + _costs_of_up(evidence, rotations), np.inf)
    poses = np.concatenate([rotations.reshape(-1, 9), found[:, :3]], axis=1)
    likely = np.argsort(costs, kind="stable")[: min(int(valid.sum()), _MOST_METRIC)]
    return [(poses[k, None], np.log(scales[k])) for k in likely]


def _rows_of(evidence: Evidence) -> _Rows:
    sightings, shape = evidence.sightings, evidence.shape
    u, v = sightings.rays.T
    zeros = np.zeros_like(u)
    a, b, c = sightings.whitening.T
    normals = [
        np.stack([a, b, -(a * u + b * v)], axis=1),
        np.stack([zeros, c, -c * v], axis=1),
        evidence.rig.axes[sightings.image],
    ]
    right = [zeros, zeros, sightings.depths[:, 0]]
    weights = [(c > 0).astype(float), (c > 0).astype(float), sightings.depths[:, 1]]
    point, image = np.tile(sightings.point, 3), np.tile(sightings.image, 3)
    is_ray = np.repeat([1.0, 1.0, 0.0], len(u))
    weight, normal = np.concatenate(weights), np.concatenate(normals)
    kept = weight > 0
    cameras, normal = evidence.rig.cam_from_rig[image[kept]], normal[kept]
    turns, shifts = cameras[:, :9].reshape(-1, 3, 3), cameras[:, 9:]
    return _Rows(
        shape.mean[point[kept]],
        turns,
        shifts,
        np.einsum("ni,nij->nj", normal, turns),
        np.concatenate(right)[kept] - (normal * shifts).sum(axis=1),
        weight[kept],
        is_ray[kept],
    )


def _distance_rows(
    evidence: Evidence, rotations: FloatArray, basis: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Whitened equations (S, L, 3 + k) of known distances in translation and scales."""
    offsets, mean, count = evidence.offsets, evidence.shape.mean, len(rotations)
    left = np.zeros((count, len(offsets.value), 6))
    right = np.tile(offsets.value, (count, 1))
    for k, (image, direction) in enumerate(zip(offsets.image, offsets.direction, strict=True)):
        for point, sign in zip(offsets.ends[k], (-1.0, 1.0), strict=True):
            if point >= 0:
                left[:, k, 3:] += sign * direction * mean[point]
            else:
                camera, turned = evidence.rig.cam_from_rig[image], rotations @ direction
                left[:, k, :3] -= sign * turned
                right[:, k] += sign * turned @ (camera[:9].reshape(3, 3).T @ camera[9:])
    left = np.concatenate([left[:, :, :3], left[:, :, 3:] @ basis], axis=2)
    return offsets.weight[:, None] * left, offsets.weight * right


def _costs_of_up(evidence: Evidence, rotations: FloatArray) -> FloatArray:
    """Squared whitened differences (S,) of known directions."""
    directions = evidence.directions
    turns = evidence.rig.cam_from_rig[directions.image][:, :9].reshape(-1, 3, 3)
    turned = np.einsum("dij,sjk,dk->sdi", turns, rotations, directions.model)
    whitened = np.einsum("dij,sdj->sdi", directions.whitening, turned - directions.camera)
    return np.asarray((whitened**2).sum(axis=(1, 2)))
