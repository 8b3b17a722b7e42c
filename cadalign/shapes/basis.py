"""Shape components from means, modes and covariances, and mirror symmetry of a category."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats
from cadalign.errors import InputError
from cadalign.geometry.alignment import extent
from cadalign.shapes.parts import BOX_ROWS, ShapeComponent, check_box

_ROUNDS = 10  # most iterations of pairing keypoints and moving the mirror; usually 3


def component_of_basis(
    mean: npt.ArrayLike,
    modes: npt.ArrayLike,
    deviations: npt.ArrayLike,
    *,
    box: npt.ArrayLike | None,
    residual_sigma: float,
) -> ShapeComponent:
    """Make a component from a linear shape model; see `ShapeModel.from_basis`."""
    points = as_floats(mean, name="mean", shape=(None, 3))
    if not len(points):
        raise InputError("there are no keypoints", where="mean")
    directions = as_floats(modes, name="modes", shape=(None, len(points), 3))
    sigmas = as_floats(deviations, name="deviations", shape=(len(directions),))
    if (sigmas < 0).any():
        raise InputError(f"{sigmas.min():g} is negative", where="deviations")
    rows = np.vstack([points, extent(points) if box is None else check_box(box, "box")])
    scaled = sigmas[:, None, None] * directions
    extended = [np.vstack([mode, _corners(points, mode, rows[-BOX_ROWS:])]) for mode in scaled]
    return ShapeComponent(1.0, rows, _orthogonalise(np.array(extended), len(rows)), residual_sigma)


def component_of_covariance(
    mean: FloatArray, covariance: FloatArray, *, weight: float = 1.0, modes: int | None = None
) -> ShapeComponent:
    """Make a component whose modes are the main eigenvectors of a covariance.

    ``mean`` is (m + 2, 3), ``covariance`` (3 (m + 2), 3 (m + 2)). By default all modes of positive
    variance are used. The residual has the mean variance of the others, as in probabilistic PCA.
    """
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    count = int((values > 1e-15 * values[0]).sum())
    count = count if modes is None else min(count, modes)
    directions = (vectors[:, :count] * np.sqrt(values[:count])).T.reshape(count, *mean.shape)
    rest = values[count:]
    sigma = float(np.sqrt(rest.mean())) if len(rest) else 0.0
    if sigma:  # the residual also has a variance along the modes
        kept = np.sqrt(np.maximum(1 - sigma**2 / values[:count], 0.0))
        directions = directions * kept.reshape(-1, 1, 1)
    return ShapeComponent(weight, mean, directions, sigma)


def _corners(points: FloatArray, mode: FloatArray, corners: FloatArray) -> FloatArray:
    """Motion (2, 3) of the box's corners by the shift and axis stretch that fit a mode best."""
    centre = points.mean(axis=0)
    offsets = points - centre
    squares = (offsets**2).sum(axis=0)
    stretch = (offsets * mode).sum(axis=0) / np.where(squares > 0, squares, 1.0)
    return np.asarray(mode.mean(axis=0) + stretch * (corners - centre))


def _orthogonalise(modes: FloatArray, count: int) -> FloatArray:
    """Convert modes (K, count, 3) to orthogonal ones of the same covariance, longest first."""
    if not len(modes):
        return modes.reshape(0, count, 3)
    _, lengths, directions = np.linalg.svd(modes.reshape(len(modes), -1), full_matrices=False)
    keep = lengths > 1e-12 * max(float(lengths[0]), 1e-300)
    return np.asarray((lengths[keep, None] * directions[keep]).reshape(-1, count, 3))


class Mirror(NamedTuple):
    """A mirror plane perpendicular to an axis."""

    axis: int
    offset: float  # coordinate of the plane on the axis [model units]
    partners: tuple[int, ...]  # row of each keypoint's mirror image; a keypoint may be its own


def find_mirror(completed: FloatArray, axis: int) -> Mirror:
    """Find the mirror plane perpendicular to an axis that maps the models best to themselves.

    Alternates between the pairs of keypoints, which minimise the squared distances between mirrored
    keypoints and their partners over all models, and the plane's offset. ``completed`` (N, m + 2,
    3) are keypoints and box corners, none missing; ``axis`` is 0, 1 or 2.
    """
    from scipy.optimize import linear_sum_assignment

    points = completed[:, :-BOX_ROWS]
    offset = float(completed[:, -BOX_ROWS:, axis].mean())
    own = partner = np.arange(points.shape[1])
    for _ in range(_ROUNDS):
        mirrored = points.copy()
        mirrored[..., axis] = 2 * offset - mirrored[..., axis]
        gaps = ((mirrored[:, :, None] - points[:, None, :]) ** 2).sum(axis=3).mean(axis=0)
        _, found = linear_sum_assignment(gaps + gaps.T)
        # A mirror is its own inverse; longer cycles of keypoints are dropped.
        found = np.where(found[found] == own, found, own)
        midpoints = (points[..., axis] + points[:, found, axis]) / 2
        # The median, since keypoints without a partner may lie off the plane.
        offset = float(np.median(midpoints.mean(axis=0)))
        if (found == partner).all():
            break
        partner = found
    return Mirror(axis, offset, tuple(partner.tolist()))


def is_symmetry(completed: FloatArray, mirror: Mirror) -> bool:
    """True if the mirrored mean is as near to the mean as the models are; see `find_mirror`."""
    mean = completed.mean(axis=0, keepdims=True)
    return bool(np.abs(mirror_rows(mean, mirror) - mean).mean() <= np.abs(completed - mean).mean())


def mirror_rows(rows: FloatArray, mirror: Mirror) -> FloatArray:
    """Mirror models' keypoints and box corners, (N, m + 2, 3) float, NaN if missing."""
    exchanged = rows[:, [*mirror.partners, -BOX_ROWS, -1]]
    exchanged[..., mirror.axis] = -exchanged[..., mirror.axis]
    exchanged[:, [-BOX_ROWS, -1], mirror.axis] = exchanged[:, [-1, -BOX_ROWS], mirror.axis]
    exchanged[..., mirror.axis] += 2 * mirror.offset
    return exchanged
