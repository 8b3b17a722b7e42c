"""Alignments that a mask alone allows, told apart by clicks.

Each predicts where a keypoint is in the photo. A click makes those that predict it elsewhere less
likely, and is best at the keypoint that they predict most differently.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.estimation.model import Model
from cadalign.estimation.prior import prior_of
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import Alternative
from cadalign.geometry.camera import Camera
from cadalign.shapes.model import ShapeModel

_CLICK = 0.01  # standard deviation of a click about a candidate's keypoint, of the longer side
_RULED_OUT = 0.01  # probability
_MOST_OFF = 5.0  # standard deviations of a click from the keypoint of a candidate that is kept


@dataclass(frozen=True, eq=False)
class MaskCandidates:
    """Alignments of a model to a mask, the likeliest first."""

    result: Result
    """The estimate from the mask alone."""
    every: tuple[Alternative, ...]
    rows: Mapping[Hashable, int]
    """Rows of the candidates' points by the keypoints' ids."""
    spread: FloatArray
    """(m,), standard deviations of the points about the object's own [model units]."""
    camera: Camera

    @classmethod
    def of(cls, model: Model | ShapeModel, camera: Camera, result: Result) -> MaskCandidates:
        """The candidates that a result from a mask alone states."""
        best = Alternative(result.alignment, 1.0, camera, result.points_3d, result.bounds)
        rows = {label: row for row, label in enumerate(result.ids)}
        spread = _spread_of(model, len(result.ids))
        return cls(result, (best, *result.alternatives), rows, spread, camera)

    def predicted(
        self, ids: Sequence[Hashable], points: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Places (k, n, 2) of keypoints by each candidate, and standard deviations (k, n) [px].

        Those that the candidates do not have are points (n, 3) of the model. Places behind the
        camera are NaN.
        """
        known = self._rows_of(ids)
        click = _CLICK * max(self.camera.width, self.camera.height)
        spread = np.append(self.spread, self.spread.max(initial=0.0))[known]
        places, sigmas = np.full((len(self.every), len(known), 2), np.nan), []
        for uv, each in zip(places, self.every, strict=True):
            in_camera = each.alignment.apply(self.points_of(each, ids, points))
            ahead = self.camera.sees(in_camera)
            uv[ahead] = self.camera.project(in_camera[ahead])
            distance = np.linalg.norm(in_camera, axis=1)
            size = float(np.linalg.norm(each.alignment.scale)) / np.sqrt(3)
            sigmas.append(np.hypot(click, self.camera.fx * size * spread / distance))
        return places, np.array(sigmas)

    def points_of(
        self, each: Alternative, ids: Sequence[Hashable], points: FloatArray
    ) -> FloatArray:
        """A candidate's keypoints (n, 3); those that it does not have are the given ones."""
        known = self._rows_of(ids)
        own = np.vstack([each.points_3d, np.zeros(3)])[known]
        return np.where(known[:, None] >= 0, own, points)

    def _rows_of(self, ids: Sequence[Hashable]) -> IntArray:
        return np.array([self.rows.get(label, -1) for label in ids], dtype=np.int64)

    def probabilities(
        self, ids: Sequence[Hashable], points: FloatArray, pixels: FloatArray
    ) -> FloatArray:
        """Probabilities (k,) after clicks (n, 2) on keypoints; 0 for those that are ruled out."""
        prior = np.array([each.relative_likelihood for each in self.every])
        return updated(prior, *self.predicted(ids, points), np.reshape(pixels, (-1, 2)))


def updated(
    chances: FloatArray, places: FloatArray, sigmas: FloatArray, pixels: FloatArray
) -> FloatArray:
    """Probabilities (k,) after clicks (n, 2), where each candidate predicts places (k, n, 2)."""
    off = np.linalg.norm(places - pixels, axis=2) / sigmas
    kept = (chances > 0) & (off < _MOST_OFF).all(axis=1)
    if not kept.any():
        return np.zeros(len(chances))
    logs = np.log(chances, where=kept, out=np.full(len(kept), -np.inf))
    logs[kept] -= (off**2 / 2 + 2 * np.log(sigmas)).sum(axis=1)[kept]
    found = np.exp(logs - logs.max())
    found[found < _RULED_OUT * found.sum()] = 0.0
    return np.asarray(found / found.sum())


def best_click(
    chances: FloatArray, places: FloatArray, sigmas: FloatArray, seen: BoolArray
) -> int | None:
    """The keypoint, of n, whose click tells candidates apart best; None if none does.

    It leaves the least confusion in expectation: of two candidates, the overlap of what they
    predict, its Bhattacharyya coefficient. ``seen`` (k, n) marks the keypoints that are visible.
    """
    first, second = np.triu_indices(len(chances), 1)
    squares = sigmas[first] ** 2 + sigmas[second] ** 2
    gaps = np.linalg.norm(places[first] - places[second], axis=2)
    overlap = 2 * sigmas[first] * sigmas[second] / squares * np.exp(-(gaps**2) / (4 * squares))
    overlap = np.nan_to_num(overlap, nan=0.0)  # one of them has it behind the camera
    gain = ((chances[first] * chances[second]) @ (1 - overlap)) * (chances @ seen)
    if not len(gain) or not gain.max() > 0:
        return None
    # Rounded, so that keypoints that differ by rounding alone are chosen by their order.
    return int(np.argmax(np.round(gain / gain.max(), 9)))


def clicks_needed(
    chances: FloatArray, places: FloatArray, sigmas: FloatArray, seen: BoolArray
) -> int | None:
    """Clicks that leave one candidate, whichever is right; None where they do not suffice.

    They are those of `best_click` in turn, each where the right candidate predicts it.
    """
    most = 0
    for right in np.flatnonzero(chances):
        left, free, clicks = chances, seen & seen[right], 0
        while np.count_nonzero(left) > 1:
            row = best_click(left, places, sigmas, free)
            if row is None:
                return None
            clicked = places[right, [row]]
            left = updated(left, places[:, [row]], sigmas[:, [row]], clicked)
            free = free & (np.arange(free.shape[1]) != row)
            clicks += 1
        most = max(most, clicks)
    return most


def _spread_of(model: Model | ShapeModel, count: int) -> FloatArray:
    """Standard deviations (count,) of an object's keypoints along an axis [model units]."""
    prior = prior_of(model)
    parts = list(zip(prior.weights, prior.components, strict=True))
    mean = sum(weight * part.mean[:count] for weight, part in parts)
    squares = np.zeros(count)
    for weight, part in parts:
        own = (part.modes[:, :count] ** 2).sum(axis=0) + part.spread[:count, None] ** 2
        squares += weight * (own + (part.mean[:count] - mean) ** 2).mean(axis=1)
    return np.sqrt(squares)
