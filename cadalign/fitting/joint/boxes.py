"""The box of an estimated shape, whose faces are where keypoints are or the linear box is.

A face that an outermost keypoint determines moves with it: its row of the shape becomes that of the
keypoint, shifted by the margin.
"""

from __future__ import annotations

import numpy as np

from cadalign.shapes.box_margins import BoxMargins
from cadalign.solvers.joint.evidence import Evidence, State, points_of
from cadalign.solvers.marginal.problem import Mixture, Seen, shape_at
from cadalign.solvers.marginal.search import ViewMinima


def with_box(
    evidence: Evidence, state: State, keypoints: int, margins: BoxMargins
) -> tuple[Evidence, State]:
    """Evidence and state whose box has those faces that outermost keypoints determine at these.

    Such a face varies with its keypoint. The box remains the linear one where measured lengths or
    heights determine it.
    """
    shape = evidence.shape
    if len(evidence.lengths.value) or len(evidence.heights.value) or not len(shape.modes):
        return evidence, state
    points = points_of(shape, state) / np.exp(state.log_scales)
    rows = np.unique(evidence.sightings.point)
    rows = rows[rows < keypoints]
    bounds = margins.bounds(points[-2:], points[rows])
    mean, modes = shape.mean.copy(), shape.modes.copy()
    displacements = state.displacements.copy()
    outermost = rows[np.array([points[rows].argmin(axis=0), points[rows].argmax(axis=0)])]
    for face, axis in np.argwhere(bounds != points[-2:]).tolist():
        row, own = face - 2, outermost[face, axis]
        mean[row, axis] = mean[own, axis] + bounds[face, axis] - points[own, axis]
        modes[:, row, axis] = modes[:, own, axis]
        displacements[row, axis] = displacements[own, axis]
    placed = evidence._replace(shape=shape._replace(mean=mean, modes=modes))
    return placed, state._replace(displacements=displacements)


def with_boxes(
    mixture: Mixture, seen: Seen, minima: ViewMinima, count: int, margins: BoxMargins
) -> tuple[Mixture, ViewMinima]:
    """A component for each of the first minima, with the box that `with_box` gives."""
    if not mixture.covariances.any():
        return mixture, minima
    component = minima.component[:count]
    means, covariances = mixture.means[component], mixture.covariances[component]
    rows, axes = np.unique(seen.points), np.arange(3)
    box = 3 * means.shape[1] - np.arange(6, 0, -1).reshape(2, 3)
    for k in range(count):
        points = shape_at(mixture, component[k], seen, minima.forces[k])
        bounds = margins.bounds(points[-2:], points[rows])
        determined = bounds != points[-2:]
        outermost = rows[np.array([points[rows].argmin(axis=0), points[rows].argmax(axis=0)])]
        own = np.where(determined, 3 * outermost + axes, box)
        means[k, -2:] = means[k].ravel()[own]
        means[k, -2:] += np.where(determined, bounds - points[outermost, axes], 0.0)
        covariances[k, box.ravel()] = covariances[k, own.ravel()]
        covariances[k, :, box.ravel()] = covariances[k, :, own.ravel()]
    numbers = np.arange(count, dtype=minima.component.dtype)
    placed = Mixture(means, covariances, mixture.penalties[component])
    return placed, minima._replace(component=numbers)
