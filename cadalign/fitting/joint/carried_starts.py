"""Starts of views whose few keypoints leave the stretch open, by the stretch of another view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.solvers.joint.evidence import Evidence
from cadalign.solvers.joint.starts import view_starts

_MOST_CARRIED = 3  # stretches of the other view

Starts = list[tuple[FloatArray, FloatArray]]


def weakly_determined(evidence: Evidence) -> list[int]:
    """Numbers of the views of unknown motion whose keypoints leave pose and stretch open."""
    unknowns = 6 + int(evidence.scales.free.sum())
    if unknowns == 6:
        return []
    counts = keypoint_counts(evidence)
    shared = np.bincount(evidence.rig.pose)[evidence.rig.pose] > 1
    return np.flatnonzero((2 * counts <= unknowns) & ~shared & (len(counts) > 1)).tolist()


def carried_starts(evidence: Evidence, view: int, per_pose: Sequence[Starts]) -> Starts:
    """Poses of a view under the stretches of the view with the most keypoints, and these.

    ``per_pose`` are the starts that the views' own keypoints suggest.
    """
    counts = keypoint_counts(evidence)
    others = [v for v in np.argsort(-counts, kind="stable").tolist() if v != view]
    own: Starts = next((found for v in others if (found := per_pose[evidence.rig.pose[v]])), [])
    starts: Starts = []
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
