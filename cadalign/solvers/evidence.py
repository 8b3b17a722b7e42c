"""Blocks of evidence about an alignment: their costs and normal equations.

A block is a NamedTuple of data with two kernels. One returns the cost at a pose. The other also
adds J' W J to the upper triangle of a ``hessian`` (U, U) and J' W r to a ``gradient`` (U,), ordered
as in `cadalign.solvers.unknowns`. `cadalign.solvers.alignment` sums the blocks.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import borrow, inline, kernel
from cadalign.solvers.constants import HUBER, LINEAR, UNKNOWNS, ScalePrior
from cadalign.solvers.linalg import Triple, add_products, copy_into
from cadalign.solvers.projection import Scalars, project_point, scalars_of, write_derivatives

BLOCK = 32
"""Number of points whose derivatives are buffered before their products are summed."""


class KeypointEvidence(NamedTuple):
    """Model points (n, 3), observed rays (n, 2), and the loss of their whitened residuals.

    With a row (a, b, c) of ``whitening`` (1 or n, 3), an error (du, dv) of a ray has the whitened
    residual (a du + b dv, c dv), of unit covariance. ``loss_scale`` is the length at which the loss
    departs from squares.
    """

    points: FloatArray
    rays: FloatArray
    whitening: FloatArray
    loss: int
    loss_scale: float


@inline
def add_keypoints(
    keypoints: KeypointEvidence,
    pose: FloatArray,
    rows: FloatArray,
    hessian: FloatArray,
    gradient: FloatArray,
) -> float:
    """Add the keypoints' equations; returns their cost. ``rows`` (9, 2 * BLOCK) is scratch."""
    cost = 0.0
    for start in range(0, keypoints.points.shape[0], BLOCK):
        size = min(BLOCK, keypoints.points.shape[0] - start)
        cost += _write_rows(keypoints, pose, start, size, rows)
        if not cost < np.inf:
            return np.inf
        add_products(rows, 2 * size, hessian, gradient)
    return cost


@borrow
def _write_rows(
    keypoints: KeypointEvidence, pose: FloatArray, start: int, size: int, rows: FloatArray
) -> float:
    """Write derivatives and, in the last row, residuals: all u, then all v; returns the cost."""
    points, rays, whitening = keypoints.points, keypoints.rays, keypoints.whitening
    scalars = scalars_of(pose)
    loss, loss_scale = keypoints.loss, keypoints.loss_scale
    each = whitening.shape[0] > 1
    weights = (whitening[0, 0], whitening[0, 1], whitening[0, 2])
    cost = 0.0
    nearest = np.inf
    for b in range(size):
        i = start + b
        point = (points[i, 0], points[i, 1], points[i, 2])
        if each:
            weights = (whitening[i, 0], whitening[i, 1], whitening[i, 2])
        u, v, depth = project_point(scalars, point)
        nearest = min(nearest, depth)
        seen = weigh_error(weights, u - rays[i, 0], v - rays[i, 1], loss, loss_scale)
        cost += seen.cost
        write_derivatives(scalars, point, seen.whitening, rows, b, size + b)
        rows[UNKNOWNS, b] = seen.u
        rows[UNKNOWNS, size + b] = seen.v
    return cost if nearest > 0 else np.inf


class Weight(NamedTuple):
    """Cost of a ray's error, and the square ``root`` of its weight.

    The whitened residual (u, v) and the whitening are multiplied by this root.
    """

    cost: float
    root: float
    u: float
    v: float
    whitening: Triple


@inline
def weigh_error(weights: Triple, du: float, dv: float, loss: int, loss_scale: float) -> Weight:
    """Whiten an error (du, dv) of a ray, and weight it by the loss."""
    u, v = weights[0] * du + weights[1] * dv, weights[2] * dv
    cost, root = loss_and_root(loss, loss_scale, u * u + v * v)
    whitening = root * weights[0], root * weights[1], root * weights[2]
    return Weight(cost, root, root * u, root * v, whitening)


@inline
def loss_and_root(loss: int, scale: float, square: float) -> tuple[float, float]:
    """Loss of a squared residual, and the square root of the residual's weight."""
    if loss == LINEAR:
        return square, 1.0
    if loss == HUBER:
        length = np.sqrt(square)
        if length > scale:
            return (2.0 * length - scale) * scale, np.sqrt(scale / length)
        return square, 1.0
    ratio = square / (scale * scale)
    return scale * scale * np.log1p(ratio), np.sqrt(1.0 / (1.0 + ratio))


@inline
def weight_slope(loss: int, scale: float, root: float, square: float) -> float:
    """Change of log(root) per r' dr, with the weight's ``root`` and weighted residuals r."""
    if loss == LINEAR or root == 1.0:
        return 0.0
    return -0.5 / square if loss == HUBER else -1.0 / (scale * scale)


@inline
def squared_error(keypoints: KeypointEvidence, pose: Scalars, i: int) -> float:
    """Squared whitened residual of keypoint i; infinite behind the camera."""
    points, rays, whitening = keypoints.points, keypoints.rays, keypoints.whitening
    w = i if whitening.shape[0] > 1 else 0
    weights = (whitening[w, 0], whitening[w, 1], whitening[w, 2])
    point = (points[i, 0], points[i, 1], points[i, 2])
    u, v, depth = project_point(pose, point)
    square = weigh_error(weights, u - rays[i, 0], v - rays[i, 1], LINEAR, 1.0).cost
    return square if depth > 0 else np.inf


@borrow
def keypoint_cost(keypoints: KeypointEvidence, pose: FloatArray) -> float:
    """Cost of the keypoints; infinite if a point lies behind the camera."""
    scalars = scalars_of(pose)
    cost = 0.0
    for i in range(keypoints.points.shape[0]):
        square = squared_error(keypoints, scalars, i)
        cost += loss_and_root(keypoints.loss, keypoints.loss_scale, square)[0]
    return cost


@kernel
def take_keypoints(keypoints: KeypointEvidence, chosen: IntArray) -> KeypointEvidence:
    """Select the keypoints with the indices ``chosen`` (k,)."""
    count = chosen.shape[0]
    each = keypoints.whitening.shape[0] > 1
    points = np.empty((count, 3))
    rays = np.empty((count, 2))
    whitening = np.empty((count if each else 1, 3))
    for k in range(count):
        copy_into(points[k], keypoints.points[chosen[k]])
        copy_into(rays[k], keypoints.rays[chosen[k]])
    for k in range(whitening.shape[0]):
        copy_into(whitening[k], keypoints.whitening[chosen[k] if each else 0])
    return KeypointEvidence(points, rays, whitening, keypoints.loss, keypoints.loss_scale)


@inline
def excess_of(value: float, width: float) -> float:
    return value - min(max(value, -width), width)


@inline
def add_scale_prior(
    prior: ScalePrior, pose: FloatArray, hessian: FloatArray, gradient: FloatArray
) -> float:
    """Add the prior on the log scales; returns its cost."""
    cost = 0.0
    for k in range(2):
        log_scale = np.log(pose[13 + k])
        if abs(log_scale) >= prior.width:
            excess = excess_of(log_scale, prior.width)
            cost += prior.weight * excess * excess
            gradient[6 + k] += prior.weight * excess
            hessian[6 + k, 6 + k] += prior.weight
    return cost


@kernel
def whole_information(prior: ScalePrior) -> float:
    """Inverse variance of the prior, including its flat part."""
    flank, width = 1.0 / np.sqrt(prior.weight), prior.width
    half = flank * np.sqrt(np.pi / 2.0)  # area of one flank relative to the flat density
    square = width**3 / 3.0 + half * (width**2 + flank**2) + 2.0 * width * flank**2
    return float((width + half) / square)


@inline
def score_of_distance(distance: float) -> float:
    """-2 log of the translation prior |t|^-3, uniform in direction and log distance."""
    return float(6.0 * np.log(distance))
