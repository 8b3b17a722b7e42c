"""Starts of a joint estimate: poses that the keypoints of each view suggest for the mean shape."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.solvers.joint.evidence import Evidence
from cadalign.solvers.joint.starts import view_starts

_MOST = 24


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
        camera = rig.cam_from_rig[view]
        found = zip(*view_starts(evidence, view), strict=True)
        moved = [(in_rig(pose, camera), scales) for pose, scales in found]
        per_pose[rig.pose[view]].extend(moved)
    if not all(per_pose):
        return np.empty((0, poses, 12)), np.empty((0, 3))
    first = [0] * poses
    others = [
        [*first[:p], rank, *first[p + 1 :]]
        for rank in range(1, max(map(len, per_pose)))
        for p in range(poses)
        if rank < len(per_pose[p])
    ]
    combinations = [first, *others][:_MOST]
    chosen = [[per_pose[p][k] for p, k in enumerate(ranks)] for ranks in combinations]
    stacked = np.array([[pose for pose, _ in each] for each in chosen]).reshape(-1, poses, 12)
    scales = np.array([each[0][1] for each in chosen]).reshape(-1, 3)
    return stacked, scales


def in_rig(pose: FloatArray, camera: FloatArray) -> FloatArray:
    """A camera's pose (12,) of the model as the rig's."""
    rotation, translation = camera[:9].reshape(3, 3), camera[9:]
    turned = rotation.T @ pose[:9].reshape(3, 3)
    return np.concatenate([turned.ravel(), rotation.T @ (pose[9:] - translation)])
