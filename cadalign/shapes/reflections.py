"""Mirror symmetries of a category, found from its models' keypoints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from cadalign.arrays import FloatArray
from cadalign.shapes.parts import AXES, BOX_ROWS, KeypointId, Reflection

_ROUNDS = 10  # of pairing keypoints and moving the mirror; 3 suffice as a rule


def find_reflection(completed: FloatArray, ids: Sequence[KeypointId], axis: int) -> Reflection:
    """Find the pairs of keypoints that a mirror across an axis exchanges best.

    Keypoints are paired such that the squared distances between the mirrored keypoints and their
    partners, over all models, are least, in turns with the place of the mirror.

    Parameters
    ----------
    completed : (N, m + 2, 3) float
        Keypoints and box corners of the models, none missing.
    ids : (m,) int or str
    axis : int
        0, 1 or 2: the axis across which the models are mirrored.
    """
    points = completed[:, :-BOX_ROWS]
    offset = float(completed[:, -BOX_ROWS:, axis].mean())
    partner = np.arange(len(ids))
    for _ in range(_ROUNDS):
        mirrored = points.copy()
        mirrored[..., axis] = 2 * offset - mirrored[..., axis]
        gaps = ((mirrored[:, :, None] - points[:, None, :]) ** 2).sum(axis=3).mean(axis=0)
        _, found = linear_sum_assignment(gaps + gaps.T)
        # A mirror undoes itself; a longer cycle of keypoints is none.
        found = np.where(found[found] == np.arange(len(ids)), found, np.arange(len(ids)))
        midpoints = (points[..., axis] + points[:, found, axis]) / 2
        # The median, since keypoints without a partner may lie off the mirror.
        offset = float(np.median(midpoints.mean(axis=0)))
        if (found == partner).all():
            break
        partner = found
    partners = enumerate(partner.tolist())
    pairs = tuple((ids[row], ids[other]) for row, other in partners if row < other)
    return Reflection(AXES[axis], offset, pairs)


def mirrored_rows(
    rows: FloatArray, ids: Sequence[KeypointId], reflection: Reflection
) -> FloatArray:
    """Mirror models' keypoints and box corners, (N, m + 2, 3) float, NaN where missing."""
    axis = AXES.index(reflection.axis)
    partner = reflection.partners(ids)
    exchanged = rows[:, [*partner, -BOX_ROWS, -1]]
    exchanged[..., axis] = 2 * reflection.offset - exchanged[..., axis]
    exchanged[:, [-BOX_ROWS, -1], axis] = exchanged[:, [-1, -BOX_ROWS], axis]
    return exchanged
