"""Boxes of objects from their keypoints: what linear shapes cannot tell.

The faces of a box are where the outermost keypoints are, or a margin beyond. Which keypoint that is
changes from object to object, so that a box that is linear in the shape errs by more than its
keypoints do. The linear box is still what tells of parts that no given keypoint belongs to.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray, as_floats, read_only
from cadalign.errors import InputError
from cadalign.shapes.gaussians import Gaussians
from cadalign.shapes.parts import BOX_ROWS

_EXCEEDED = 95.0  # percentile of the linear box's errors
_OUTWARD = np.array([[-1.0], [1.0]])


@dataclass(frozen=True, eq=False)
class BoxMargins:
    """Distances between the faces of objects' boxes, their keypoints, and linear boxes.

    Raises InputError if a shape is wrong, or a value is NaN, infinite or, of the tolerances,
    negative.

    Examples
    --------
    A face a little beyond the keypoints is where these end; one that is far beyond is another
    part's:

    >>> rule = BoxMargins(np.zeros((2, 3)), np.full((2, 3), 0.1))
    >>> seen = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    >>> rule.bounds(np.array([[-0.05, 0.0, -0.5], [1.0, 1.05, 1.0]]), seen).tolist()
    [[-0.0, -0.0, -0.5], [1.0, 1.0, 1.0]]
    """

    margins: FloatArray
    """(2, 3), median distance of the least and the greatest face along x, y, z beyond the outermost
    keypoint [model units]."""
    tolerances: FloatArray
    """(2, 3), how far beyond the true face the linear box, given all keypoints, lies in one
    held-out object of twenty [model units]."""

    def __post_init__(self) -> None:
        for name in ("margins", "tolerances"):
            value = as_floats(getattr(self, name), name=name, shape=(2, 3))
            object.__setattr__(self, name, read_only(value))
        if (self.tolerances < 0).any():
            raise InputError("a distance is negative", where="tolerances")

    def bounds(self, linear: FloatArray, seen: FloatArray) -> FloatArray:
        """The box (2, 3) of an object, from the linear box and the given keypoints (n, 3)."""
        reached = _OUTWARD * np.array([seen.min(axis=0), seen.max(axis=0)]) + self.margins
        outward = _OUTWARD * linear
        return np.asarray(
            _OUTWARD * np.where(outward > reached + self.tolerances, outward, reached)
        )


def margins_of(rows: FloatArray) -> FloatArray:
    """Distances of the faces beyond the outermost keypoints of models (N, m + 2, 3); (N, 2, 3)."""
    points, boxes = rows[:, :-BOX_ROWS], rows[:, -BOX_ROWS:]
    reached = np.stack([np.nanmin(points, axis=1), np.nanmax(points, axis=1)], axis=1)
    return np.asarray(_OUTWARD * (boxes - reached))


def excesses_of(rows: FloatArray, mixture: Gaussians) -> FloatArray:
    """Distances of linear boxes beyond the true faces of models that were held out, (N, 2, 3)."""
    found = np.full((len(rows), BOX_ROWS, 3), np.nan)
    first = rows[0].size - 3 * BOX_ROWS
    for place, row in enumerate(rows):
        entries = np.flatnonzero(np.isfinite(row.ravel()[:first]))
        best, linear = -np.inf, np.full(3 * BOX_ROWS, np.nan)
        for weight, mean, covariance in zip(
            mixture.weights, mixture.means, mixture.covariances, strict=True
        ):
            gap = row.ravel()[entries] - mean[entries]
            own = covariance[entries[:, None], entries]
            solved = np.linalg.solve(own, gap)
            score = 2 * np.log(weight) - gap @ solved - np.linalg.slogdet(own)[1]
            if score > best:
                best, linear = score, mean[first:] + covariance[first:, entries] @ solved
        found[place] = _OUTWARD * (linear.reshape(BOX_ROWS, 3) - row[-BOX_ROWS:])
    return found


def learn_margins(rows: FloatArray, excesses: FloatArray) -> BoxMargins | None:
    """Margins from models and their linear boxes' errors; None where no model has a box."""
    has_box = np.isfinite(rows[:, -BOX_ROWS:]).all(axis=(1, 2))
    if not has_box.any():
        return None
    return BoxMargins(
        np.median(margins_of(rows[has_box]), axis=0),
        np.maximum(np.percentile(excesses[has_box], _EXCEEDED, axis=0), 0.0),
    )
