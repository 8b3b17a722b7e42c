"""The next keypoint to click: the one whose place in the photo would tell most."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from cadalign.annotate.live import LiveAlignment, short
from cadalign.annotate.models import KeypointRegistry, ObjectShape
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.geometry.camera import predicted_covariances, projection_jacobian
from cadalign.render.viewpoints import visible_keypoints

# Depth of visible points beneath the surface, and beneath one that is warped [diagonals].
_BENEATH, _BENEATH_WARPED = 2e-3, 0.02


@dataclass(frozen=True)
class Suggestion:
    """A keypoint of the model."""

    point: ModelKeypoint
    uv: tuple[float, float]  # its predicted place in the photo [px]
    sigma: float  # standard deviation of that place [px]

    @property
    def text(self) -> str:
        """Name of the point, and what is known of it."""
        return f"{self.point.name}: so far known to ± {short(self.sigma)} px; it would tell most"


def suggest(
    live: LiveAlignment,
    registry: KeypointRegistry,
    used: Collection[int],
    shape: ObjectShape,
) -> Suggestion | None:
    """Choose the visible keypoint that tells most.

    A click of the standard deviation s tells log det(1 + C / s^2) / 2 of the estimate, where C is
    the covariance of the point's predicted place.
    """
    result, lines = live.result, live.wireframe
    if result is None or lines is None or result.covariance is None:
        return None
    camera, pose = live.camera, live.alignment
    points = [point for number, point in registry if number not in used]
    if shape.is_estimated:
        of_points = result.points_cam_covariance
        rows = {label: row for row, label in enumerate(result.ids)}
        points = [point for point in points if shape.id_of(point) in rows]
        own = np.array([rows[shape.id_of(point)] for point in points], dtype=np.int64)
        xyz = result.points_3d[own]
    elif "x" in result.stretched_axes:
        return None
    else:
        xyz = np.array([point.xyz for point in points]).reshape(-1, 3)
    beneath = _BENEATH_WARPED if shape.is_estimated else _BENEATH
    seen = np.flatnonzero(visible_keypoints(lines.scene, xyz, camera, pose, tolerance=beneath))
    if not len(seen):
        return None
    if shape.is_estimated:
        assert of_points is not None
        places = camera.projected_covariances(pose.apply(xyz[seen]), of_points[own[seen]])
    else:
        slopes = projection_jacobian(xyz[seen], camera, pose)[:, :, : len(result.covariance)]
        places = predicted_covariances(slopes, result.covariance)
    # Rounded, so that points that differ by rounding alone are chosen by their order.
    gain = np.round(np.linalg.slogdet(np.eye(2) + places / live.sigma**2)[1], 9)
    best = int(np.argmax(gain))
    ((u, v),) = camera.project(pose.apply(xyz[seen[best], None])).tolist()
    return Suggestion(points[seen[best]], (u, v), float(np.sqrt(np.trace(places[best]))))
