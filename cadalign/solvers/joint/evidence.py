"""Joint estimation of poses, log scales and shape from everything that is known about an object.

A point of the object is ``x_i = diag(exp(log_scales)) @ (mean_i + sum_k c_k modes_ki) + d_i``, in
the model's frame. The coefficients c have a standard normal prior; a displacement d_i has the
standard deviation ``spread_i`` and is eliminated from the normal equations. A sighting of a point
is its ray in one view, its depth there, or both; a contour point is one whose ray counts along the
contour's normal only. Views share one pose through known ``cam_from_rig``, or have one each.

The unknowns stand in this order: six for every pose (a rotation vector applied in the rig's frame,
the translation), three log scales, the coefficients.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import kernel


class Shape(NamedTuple):
    """Mean (m, 3) of the points, modes (K, m, 3) of unit deviation, displacements' spread (m,)."""

    mean: FloatArray
    modes: FloatArray
    spread: FloatArray


class Sightings(NamedTuple):
    """Measurements of points in images, N of them.

    ``point`` and ``image`` (N,) number point and view; ``rays`` (N, 2) are normalised, with
    ``whitening`` (N, 3) as in `cadalign.solvers.evidence.Keypoints`; ``depths`` (N, 2) holds depths
    and their inverse standard deviations, 0 where there is none. ``loss`` (N,) and ``loss_scale``
    (N,) say how the length of each residual counts. They are sorted by point.
    """

    point: IntArray
    image: IntArray
    rays: FloatArray
    whitening: FloatArray
    depths: FloatArray
    loss: IntArray
    loss_scale: FloatArray


class Rig(NamedTuple):
    """Cameras (V, 12), rotation row by row and translation, and the pose (V,) each belongs to."""

    cam_from_rig: FloatArray
    pose: IntArray


class Directions(NamedTuple):
    """Directions ``model`` (D, 3) seen as ``camera`` (D, 3) in a view.

    ``whitening`` (D, 3, 3) [1/rad] gives the difference of the unit vectors unit covariance.
    """

    model: FloatArray
    camera: FloatArray
    image: IntArray
    whitening: FloatArray


class Lengths(NamedTuple):
    """Differences of coordinate ``axis`` (L,) of two ``points`` (L, 2), and their ``weight``."""

    points: IntArray
    axis: IntArray
    value: FloatArray
    weight: FloatArray


class Heights(NamedTuple):
    """Heights ``value`` (H,) of the cameras ``image`` (H,) above planes through ``point`` (H,).

    The planes lie across ``direction`` (H, 3) of the model; ``weight`` (H,) is the inverse
    deviation.
    """

    point: IntArray
    image: IntArray
    direction: FloatArray
    value: FloatArray
    weight: FloatArray


class Planes(NamedTuple):
    """Planes ``normal . X = offset`` (N, 3), (N,) in a camera that points lie in.

    ``point``, ``image``, ``loss`` and ``loss_scale`` are as in `Sightings`; ``weight`` (N,) is the
    inverse deviation of ``normal . X``.
    """

    point: IntArray
    image: IntArray
    normal: FloatArray
    offset: FloatArray
    weight: FloatArray
    loss: IntArray
    loss_scale: FloatArray


class ScalePriors(NamedTuple):
    """Log scales: 1 in ``free`` (3,) where estimated, and the inverse covariance of their prior."""

    free: FloatArray
    precision: FloatArray


class Evidence(NamedTuple):
    """Everything that is known about one object."""

    shape: Shape
    sightings: Sightings
    rig: Rig
    directions: Directions
    lengths: Lengths
    heights: Heights
    planes: Planes
    scales: ScalePriors


class State(NamedTuple):
    """Poses (P, 12), log scales (3,), coefficients (K,) and displacements (m, 3)."""

    poses: FloatArray
    log_scales: FloatArray
    coefficients: FloatArray
    displacements: FloatArray


@kernel
def points_of(shape: Shape, state: State) -> FloatArray:
    """The points (m, 3) in the model's frame."""
    points = np.empty_like(shape.mean)
    for i in range(points.shape[0]):
        for a in range(3):
            value = shape.mean[i, a]
            for k in range(shape.modes.shape[0]):
                value += state.coefficients[k] * shape.modes[k, i, a]
            points[i, a] = np.exp(state.log_scales[a]) * value + state.displacements[i, a]
    return points


@kernel
def copy_state(state: State) -> State:
    """A copy that shares nothing."""
    return State(
        state.poses.copy(),
        state.log_scales.copy(),
        state.coefficients.copy(),
        state.displacements.copy(),
    )


@kernel
def count_unknowns(evidence: Evidence, modes: int) -> int:
    """Number of unknowns, without the displacements."""
    poses = 0
    for v in range(evidence.rig.pose.shape[0]):
        poses = max(poses, evidence.rig.pose[v] + 1)
    return 6 * poses + 3 + modes
