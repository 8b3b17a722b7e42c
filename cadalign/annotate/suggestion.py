"""Suggestion of the next keypoint to mark."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from cadalign.annotate.alignment import LiveAlignment
from cadalign.annotate.keypoint_registry import KeypointRegistry
from cadalign.annotate.model import CadModel
from cadalign.annotate.next_best import NextBest, find_next_best
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.render.views.visibility import visible_keypoints

_APART = 0.02  # least distance of a corner from marked points [diagonals]


@dataclass(frozen=True)
class Suggestion:
    """The next-best keypoint of the model.

    Parameters
    ----------
    point : ModelKeypoint
        Without a semantic id if it is a corner of the surface instead of a keypoint.
    uv : (float, float)
        Its predicted place in the photo [px].
    next_best : NextBest
    """

    point: ModelKeypoint
    uv: tuple[float, float]
    next_best: NextBest


def suggest(
    model: CadModel, registry: KeypointRegistry, used: Collection[int], live: LiveAlignment
) -> Suggestion | None:
    """Choose among the visible keypoints that are not used; if none is left, among corners."""
    result = live.cautious
    if result is None or result.covariance is None:
        return None
    own = [point for number, point in registry if number not in used]
    gaps = np.linalg.norm(model.sample_points[:, None] - registry.xyz(used), axis=2)
    apart = (gaps > _APART * model.diagonal).all(axis=1)
    corners = [point for point, far in zip(model.samples, apart.tolist(), strict=True) if far]
    camera = result.camera
    for candidates in (own, corners):
        if not candidates:
            continue
        points = np.array([point.xyz for point in candidates])
        seen = np.flatnonzero(visible_keypoints(model.scene, points, camera, result.alignment))
        next_best = find_next_best(
            points[seen],
            camera,
            result.alignment,
            result.covariance,
            sigma=live.sigma,
            known_axis=result.known_axis,
        )
        if next_best is not None:
            chosen = seen[next_best.row]
            ((u, v),) = camera.project(result.alignment.apply(points[chosen : chosen + 1])).tolist()
            return Suggestion(candidates[chosen], (u, v), next_best)
    return None
