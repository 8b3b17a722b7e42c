"""Which point of the model to mark next."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from cadalign.annotate.advice import Advice, best_next
from cadalign.annotate.alignment import LiveAlignment
from cadalign.annotate.keypoint_book import KeypointBook
from cadalign.annotate.model import CadModel
from cadalign.datasets.models.model_keypoints import ModelKeypoint

_APART = 0.02  # corners nearer to a marked point, in diagonals, are no other points


@dataclass(frozen=True)
class Suggestion:
    """The point whose measurement would help most.

    Parameters
    ----------
    point : ModelKeypoint
        Without a semantic id if it is not one of the model's keypoints.
    uv : (float, float)
        Where it should be in the photo [px].
    advice : Advice
    """

    point: ModelKeypoint
    uv: tuple[float, float]
    advice: Advice


def suggest(
    model: CadModel, book: KeypointBook, used: Collection[int], live: LiveAlignment
) -> Suggestion | None:
    """Choose among the visible keypoints; among corners of the surface if none is left.

    Parameters
    ----------
    model : CadModel
    book : KeypointBook
    used : collection of int
        Semantic ids of those that are marked.
    live : LiveAlignment
    """
    result, camera = live.cautious, live.camera
    if result is None or camera is None or result.covariance is None:
        return None
    own = [point for number, point in book if number not in used]
    gaps = np.linalg.norm(model.sample_points[:, None] - book.xyz(used), axis=2)
    apart = (gaps > _APART * model.diagonal).all(axis=1)
    corners = [point for point, far in zip(model.samples, apart.tolist(), strict=True) if far]
    for candidates in (own, corners):
        if not candidates:
            continue
        points = np.array([point.xyz for point in candidates])
        seen = np.flatnonzero(model.visible(points, camera, result.alignment))
        advice = best_next(
            points[seen],
            camera,
            result.alignment,
            result.covariance,
            sigma=live.sigma,
            known_axis=result.known_axis,
        )
        if advice is not None:
            chosen = seen[advice.row]
            ((u, v),) = camera.project(result.alignment.apply(points[chosen : chosen + 1])).tolist()
            return Suggestion(candidates[chosen], (u, v), advice)
    return None
