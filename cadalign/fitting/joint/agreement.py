"""Agreement of each piece of evidence with an estimate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.fitting.joint.pieces import depths_in, keypoints_in
from cadalign.fitting.joint.summary import EvidenceSummary
from cadalign.geometry.camera import Camera
from cadalign.solvers.joint.evidence import Evidence, State, points_of

_OUTLIER = 8.0  # [sigma], of a depth: it is that of something else


def summaries_of(
    evidence: Evidence, state: State, cameras: Sequence[Camera]
) -> tuple[EvidenceSummary, ...]:
    """Root mean square residuals of all pieces but masks, view by view."""
    points = points_of(evidence.shape, state)
    found = []
    for view, camera in enumerate(cameras):
        found.extend(_of_keypoints(evidence, state, points, view, camera))
        found.extend(_of_depths(evidence, state, points, view))
        found.extend(_of_up(evidence, state, view))
        found.extend(_of_height(evidence, state, points, view))
    lengths = evidence.lengths
    if len(lengths.value):
        box = points[lengths.points[:, 1]] - points[lengths.points[:, 0]]
        errors = box[np.arange(len(box)), lengths.axis] - lengths.value
        found.append(_summary("size", None, errors, errors * lengths.weight, ""))
    return tuple(found)


def seen_in_cameras(
    evidence: Evidence, state: State, points: FloatArray, image: IntArray
) -> FloatArray:
    """Points (N, 3) of the model in the cameras (N,) of views."""
    rig = evidence.rig
    for motion in (state.poses[rig.pose[image]], rig.cam_from_rig[image]):
        turned = np.einsum("nij,nj->ni", motion[:, :9].reshape(-1, 3, 3), points)
        points = turned + motion[:, 9:]
    return points


def _of_keypoints(
    evidence: Evidence, state: State, points: FloatArray, view: int, camera: Camera
) -> list[EvidenceSummary]:
    sightings, rows = evidence.sightings, keypoints_in(evidence, view)
    if not rows.any():
        return []
    seen = seen_in_cameras(evidence, state, points[sightings.point[rows]], _numbers(rows, view))
    errors = seen[:, :2] / seen[:, 2:] - sightings.rays[rows]
    return [summary_of_keypoints(errors, sightings.whitening[rows], view, camera)]


def summary_of_keypoints(
    errors: FloatArray, whitening: FloatArray, view: int, camera: Camera
) -> EvidenceSummary:
    """The summary of errors (n, 2) of rays, with their whitening (n, 3)."""
    a, b, c = whitening.T
    whitened = np.hypot(a * errors[:, 0] + b * errors[:, 1], c * errors[:, 1])
    in_pixels = np.hypot(errors[:, 0] * camera.fx, errors[:, 1] * camera.fy)
    return _summary("keypoints", view, in_pixels, whitened, "px", 2)


def _of_depths(
    evidence: Evidence, state: State, points: FloatArray, view: int
) -> list[EvidenceSummary]:
    if not depths_in(evidence, view).any() and not (evidence.planes.image == view).any():
        return []
    expected, measured, weights = _depths(evidence, state, points, view)
    errors = expected - measured
    counted = np.abs(errors * weights) < _OUTLIER
    if not counted.any():
        counted[:] = True
    return [_summary("depth", view, errors[counted], (errors * weights)[counted], "")]


def depth_factor(evidence: Evidence, state: State, view: int) -> float:
    """Median of measured over expected depths of a view."""
    expected, measured, _ = _depths(evidence, state, points_of(evidence.shape, state), view)
    return float(np.median(measured / expected))


def _depths(
    evidence: Evidence, state: State, points: FloatArray, view: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Expected and measured depths of a view (n,), with the inverse deviations."""
    sightings, rows = evidence.sightings, depths_in(evidence, view)
    seen = seen_in_cameras(evidence, state, points[sightings.point[rows]], _numbers(rows, view))
    expected, measured, weights, images = plane_distances(evidence, state)
    others = images == view
    return (
        np.concatenate([seen[:, 2], expected[others]]),
        np.concatenate([sightings.depths[rows, 0], measured[others]]),
        np.concatenate([sightings.depths[rows, 1], weights[others]]),
    )


def plane_distances(
    evidence: Evidence, state: State
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Expected and measured distances along planes' normals, inverse deviations, and views."""
    planes = evidence.planes
    points = points_of(evidence.shape, state)[planes.point]
    seen = seen_in_cameras(evidence, state, points, planes.image)
    return (seen * planes.normal).sum(axis=1), planes.offset, planes.weight, planes.image


def _of_up(evidence: Evidence, state: State, view: int) -> list[EvidenceSummary]:
    directions, rig = evidence.directions, evidence.rig
    rows = directions.image == view
    if not rows.any():
        return []
    rotation = rig.cam_from_rig[view][:9].reshape(3, 3) @ state.poses[rig.pose[view]][:9].reshape(
        3, 3
    )
    differences = directions.model[rows] @ rotation.T - directions.camera[rows]
    whitened = np.einsum("nij,nj->ni", directions.whitening[rows], differences)
    halves = np.minimum(np.linalg.norm(differences, axis=1) / 2, 1.0)
    angles = np.degrees(2 * np.arcsin(halves))
    return [_summary("gravity", view, angles, np.linalg.norm(whitened, axis=1), "deg", 2)]


def _of_height(
    evidence: Evidence, state: State, points: FloatArray, view: int
) -> list[EvidenceSummary]:
    heights, rig = evidence.heights, evidence.rig
    rows = heights.image == view
    if not rows.any():
        return []
    seen = seen_in_cameras(evidence, state, points[heights.point[rows]], heights.image[rows])
    rotation = rig.cam_from_rig[view][:9].reshape(3, 3) @ state.poses[rig.pose[view]][:9].reshape(
        3, 3
    )
    errors = -(seen * (heights.direction[rows] @ rotation.T)).sum(axis=1) - heights.value[rows]
    return [_summary("camera height", view, errors, errors * heights.weight[rows], "")]


def _numbers(rows: BoolArray, view: int) -> IntArray:
    return np.full(int(rows.sum()), view)


def _summary(
    kind: str,
    view: int | None,
    errors: FloatArray,
    whitened: FloatArray,
    unit: str,
    equations: int = 1,
) -> EvidenceSummary:
    """The summary of residuals (n,) and their lengths in sigmas, of so many equations each."""
    count = len(errors)
    in_sigmas = np.sqrt((whitened * whitened).sum() / (equations * count))
    return EvidenceSummary(
        kind, view, count, float(in_sigmas), float(np.sqrt((errors * errors).mean())), unit
    )
