"""Mirror symmetries of a category: finding them, and making shapes symmetric."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.shapes.basis import orthogonal
from cadalign.shapes.parts import AXES, BOX_ROWS, KeypointId, Reflection, ShapeComponent

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
    from scipy.optimize import linear_sum_assignment

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
    mirrored = mirrored_motions(rows, ids, reflection)
    mirrored[..., AXES.index(reflection.axis)] += 2 * reflection.offset
    return mirrored


def mirrored_motions(
    motions: FloatArray, ids: Sequence[KeypointId], reflection: Reflection
) -> FloatArray:
    """Mirror displacements of models' keypoints and box corners, (N, m + 2, 3) float."""
    axis = AXES.index(reflection.axis)
    exchanged = motions[:, [*reflection.partners(ids), -BOX_ROWS, -1]]
    exchanged[..., axis] = -exchanged[..., axis]
    exchanged[:, [-BOX_ROWS, -1], axis] = exchanged[:, [-1, -BOX_ROWS], axis]
    return exchanged


def symmetric_component(
    component: ShapeComponent, ids: Sequence[KeypointId], reflection: Reflection
) -> ShapeComponent:
    """Make a component symmetric: an object is as likely as its mirror image.

    Mean and covariance are the average of the component's own and of the mirrored ones.
    """
    mean, modes = component.mean, component.modes
    mirrored = mirrored_motions(modes, ids, reflection)
    return replace(
        component,
        mean=(mean + mirrored_rows(mean[None], ids, reflection)[0]) / 2,
        modes=orthogonal(np.concatenate([modes, mirrored]) / np.sqrt(2), len(mean)),
    )
