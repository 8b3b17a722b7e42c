"""Starts of a joint estimate: poses that the keypoints of each view suggest for the mean shape.

Views whose few keypoints leave the stretch open take that of another view. Where a flat object's
shape leaves open which side is seen, starts half a turn away are added.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.estimation.metric_starts import metric_starts
from cadalign.estimation.uncertainty.evidence import count_equations
from cadalign.solvers.joint.evidence import Evidence, distances_of, kept_rows
from cadalign.solvers.joint.search import MOST_PER_VIEW, view_starts
from cadalign.solvers.marginal.problem import GaussianTarget
from cadalign.solvers.marginal.search import after_motion, half_turns

_MOST_STARTS = 24
_MOST_CARRIED = 3  # stretches of the other view
_MOST_SIZED = 3

ViewStarts = list[tuple[FloatArray, FloatArray]]
_LEAST_POINTS = 3


class Starts(NamedTuple):
    """Starts of a search: ``poses`` (S, P, 12), ``log_focals`` (S, F), ``log_scales`` (S, 3)."""

    poses: FloatArray
    log_focals: FloatArray
    log_scales: FloatArray


def starts_of(evidence: Evidence, init: Start | None = None) -> Starts:
    """Starts at the focal lengths of the rays; none where every view has too few keypoints.

    Where every view has a pose of its own, the likeliest ones are taken together, and then one of
    them replaced by the next. The shape's uncertainty, seen from the distance at which the mean has
    the size of its image, widens the keypoints' own. A start that is given comes first, poses half
    a turn away come last.
    """
    poses, log_scales = _poses_and_scales(evidence, init)
    return Starts(poses, np.zeros((len(poses), len(evidence.focals.low))), log_scales)


def _poses_and_scales(evidence: Evidence, init: Start | None) -> tuple[FloatArray, FloatArray]:
    """Poses (S, P, 12) and log scales (S, 3)."""
    rig = evidence.rig
    poses = int(rig.pose.max()) + 1
    per_pose: list[ViewStarts] = [[] for _ in range(poses)]
    for view in range(len(rig.pose)):
        camera = rig.cam_from_rig[view]
        found, logs = view_starts(evidence, view)
        turned = half_turned(evidence, view, list(found))
        moved = [(in_rig(pose, camera), scales) for pose, scales in zip(found, logs, strict=True)]
        moved += [(in_rig(pose, camera), np.zeros(3)) for pose in turned]
        per_pose[rig.pose[view]].extend(moved)
    is_metric = bool(evidence.scales.free.all())
    if init is not None:
        unknowns = 6 * poses + int(evidence.scales.free.sum())
        is_open = count_equations(evidence) - len(evidence.shape.modes) < unknowns
        for given, found_of_pose in zip(init.poses, per_pose, strict=True):
            if given is None:
                continue
            if is_open:  # what the keypoints alone suggest is arbitrary
                found_of_pose.clear()
            found_of_pose.insert(0, (given, init.log_scales))
    elif is_metric and poses == 1:
        rotations = np.array([pose[:9] for pose, _ in per_pose[0]]).reshape(-1, 3, 3)
        placed, logs = metric_starts(evidence, rotations)
        if len(placed):
            return _with_sized(evidence, per_pose[0], placed, logs)
    for view in weakly_determined(evidence):
        carried = carried_starts(evidence, view, per_pose)
        per_pose[rig.pose[view]][:0] = carried
    if not all(per_pose):
        return np.empty((0, poses, 12)), np.empty((0, 3))
    if is_metric and init is None and (np.bincount(rig.pose) > 1).any():
        return _with_rig(evidence, per_pose)
    first = [0] * poses
    others = [
        [*first[:p], rank, *first[p + 1 :]]
        for rank in range(1, max(len(found) for found in per_pose))
        for p in range(poses)
        if rank < len(per_pose[p])
    ]
    combinations = [first, *others][:_MOST_STARTS]
    chosen = [[per_pose[p][k] for p, k in enumerate(ranks)] for ranks in combinations]
    stacked = np.array([[pose for pose, _ in each] for each in chosen]).reshape(-1, poses, 12)
    scales = np.array([each[0][1] for each in chosen]).reshape(-1, 3)
    if is_metric and init is None:
        return _sized(evidence, stacked, scales)
    return stacked, scales


class Start(NamedTuple):
    """A given start: a pose (12,) or None for each pose of the evidence, and log scales (3,)."""

    poses: Sequence[FloatArray | None]
    log_scales: FloatArray


def _with_rig(
    evidence: Evidence, per_pose: list[list[tuple[FloatArray, FloatArray]]]
) -> tuple[FloatArray, FloatArray]:
    """Starts whose scales are those of the rig with the most views; the other poses follow."""
    main = int(np.argmax(np.bincount(evidence.rig.pose)))
    rotations = np.array([pose[:9] for pose, _ in per_pose[main]]).reshape(-1, 3, 3)
    placed, log_scales = metric_starts(_of_pose(evidence, main), rotations)
    starts = []
    for k, (own, logs) in enumerate(zip(placed[:, 0], log_scales, strict=True)):
        for rank in range(MOST_PER_VIEW if k == 0 else 1):
            start = []
            for p, found in enumerate(per_pose):
                pose, scales = found[min(rank, len(found) - 1)]
                camera = evidence.rig.cam_from_rig[evidence.rig.pose == p][0]
                centre = -camera[:9].reshape(3, 3).T @ camera[9:]
                enlarged = centre + (pose[9:] - centre) * np.exp((logs - scales).mean())
                start.append(own if p == main else np.concatenate([pose[:9], enlarged]))
            starts.append((np.array(start), logs))
    kept = starts[:_MOST_STARTS]
    poses = np.array([start for start, _ in kept]).reshape(-1, len(per_pose), 12)
    return poses, np.array([logs for _, logs in kept]).reshape(-1, 3)


def _with_sized(
    evidence: Evidence, own: ViewStarts, placed: FloatArray, log_scales: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Starts of one metric pose, and after them the likeliest that keypoints alone suggest.

    Of points nearly in a plane, the scales that a rotation leaves to linear equations are noise.
    """
    first = own[:_MOST_SIZED]
    poses = np.array([pose for pose, _ in first]).reshape(-1, 1, 12)
    sized = _sized(evidence, poses, np.array([logs for _, logs in first]).reshape(-1, 3))
    return np.concatenate([placed, sized[0]]), np.concatenate([log_scales, sized[1]])


def _of_pose(evidence: Evidence, pose: int) -> Evidence:
    """The evidence of the views that share a pose."""
    chosen = evidence.rig.pose == pose
    tables = {
        name: getattr(evidence, name) for name in ("sightings", "directions", "offsets", "planes")
    }
    kept = {
        name: kept_rows(rows, (rows.image < 0) | chosen[rows.image])
        for name, rows in tables.items()
    }
    return evidence._replace(**kept)


def _sized(
    evidence: Evidence, poses: FloatArray, log_scales: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Starts enlarged about each view's camera such that depths and distances agree."""
    poses, log_scales = poses.copy(), log_scales.copy()
    for pose, logs in zip(poses, log_scales, strict=True):
        factor = _size_factor(evidence, pose, np.exp(logs))
        if np.isfinite(factor) and factor > 0:
            pose[:, 9:] *= factor
            logs += np.log(factor)
    return poses, log_scales


def _size_factor(evidence: Evidence, poses: FloatArray, scale: FloatArray) -> float:
    """Median of measured over predicted lengths, where every view has a pose of its own.

    NaN where nothing is measured.
    """
    sightings, planes, mean = evidence.sightings, evidence.planes, evidence.shape.mean
    offsets = evidence.offsets

    def seen(point: IntArray, image: IntArray) -> FloatArray:
        turns = poses[evidence.rig.pose[image]]
        turned = np.einsum("nij,nj->ni", turns[:, :9].reshape(-1, 3, 3), mean[point] * scale)
        return np.asarray(turned + turns[:, 9:])

    has_depth = sightings.depths[:, 1] > 0
    depths = seen(sightings.point[has_depth], sightings.image[has_depth])[:, 2]
    distances = (seen(planes.point, planes.image) * planes.normal).sum(axis=1)
    ratios = [
        sightings.depths[has_depth, 0] / depths,
        planes.depth / distances,
        offsets.value / distances_of(evidence, poses, mean * scale),
    ]
    told = np.concatenate(ratios)
    return float(np.median(told)) if len(told) else float("nan")


def in_rig(pose: FloatArray, camera: FloatArray) -> FloatArray:
    """A camera's pose (12,) of the model as the rig's."""
    rotation, translation = camera[:9].reshape(3, 3), camera[9:]
    turned = rotation.T @ pose[:9].reshape(3, 3)
    return np.concatenate([turned.ravel(), rotation.T @ (pose[9:] - translation)])


def weakly_determined(evidence: Evidence) -> list[int]:
    """Numbers of the views of unknown motion whose keypoints leave pose and stretch open."""
    unknowns = 6 + int(evidence.scales.free.sum())
    if unknowns == 6:
        return []
    counts = keypoint_counts(evidence)
    shared = np.bincount(evidence.rig.pose)[evidence.rig.pose] > 1
    return np.flatnonzero((2 * counts <= unknowns) & ~shared & (len(counts) > 1)).tolist()


def carried_starts(evidence: Evidence, view: int, per_pose: Sequence[ViewStarts]) -> ViewStarts:
    """Poses of a view under the stretches of the view with the most keypoints, and these.

    ``per_pose`` are the starts that the views' own keypoints suggest.
    """
    counts = keypoint_counts(evidence)
    others = [v for v in np.argsort(-counts, kind="stable").tolist() if v != view]
    own: ViewStarts = next((found for v in others if (found := per_pose[evidence.rig.pose[v]])), [])
    starts: ViewStarts = []
    for _, logs in own[:_MOST_CARRIED]:
        shape, scales = evidence.shape, evidence.scales
        stretched = evidence._replace(
            shape=shape._replace(mean=shape.mean * np.exp(logs)),
            scales=scales._replace(free=np.zeros(3), precision=np.zeros((3, 3))),
        )
        poses, _ = view_starts(stretched, view)
        starts.extend((pose, logs) for pose in poses)
    return starts


def keypoint_counts(evidence: Evidence) -> IntArray:
    """Number of keypoints of every view (V,)."""
    sightings = evidence.sightings
    is_keypoint = sightings.whitening[:, 2] > 0
    return np.bincount(sightings.image[is_keypoint], minlength=len(evidence.rig.pose))


def half_turned(evidence: Evidence, view: int, poses: Sequence[FloatArray]) -> list[FloatArray]:
    """Turn poses (12,) of the mean by half a turn, about each axis that its shape allows."""
    sightings, shape = evidence.sightings, evidence.shape
    names = np.unique(sightings.point[(sightings.image == view) & (sightings.whitening[:, 2] > 0)])
    if len(names) < _LEAST_POINTS or evidence.scales.free.any():
        return []
    modes = shape.modes[:, names].reshape(len(shape.modes), 3 * len(names))
    covariance = modes.T @ modes + np.diag(np.repeat(shape.spread[names] ** 2, 3))
    motions = half_turns(GaussianTarget(shape.mean[names], covariance))
    return [after_motion(pose, motion) for motion in motions for pose in poses]
