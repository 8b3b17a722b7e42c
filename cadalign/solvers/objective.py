"""The whitened reprojection error, its prior, and their derivatives.

A pose is packed into 15 numbers: rotation row by row (9), translation (3), scale (3). The unknowns
are a rotation vector applied in the camera frame, the translation, and log s_y and log s_z.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import fast_sums, kernel
from cadalign.solvers.constants import CAUCHY, HUBER, LINEAR, UNKNOWNS

BLOCK = 32


class Objective(NamedTuple):
    """What an alignment is measured against.

    Parameters
    ----------
    points : (n, 3) float
        Model points.
    rays : (n, 2) float
        Observed normalised image coordinates.
    whitening : (1 or n, 3) float
        (a, b, c) such that (a du + b dv, c dv) has unit covariance for an error (du, dv).
    loss, loss_scale : int, float
        The loss on the length of a whitened residual, and where it starts to bend.
    prior_weight : float
        Inverse variance of the Gaussian prior on both log scales; 0 for none.
    free : (8,) float
        0 for an unknown that keeps its value, 1 for the others.
    """

    points: FloatArray
    rays: FloatArray
    whitening: FloatArray
    loss: int
    loss_scale: float
    prior_weight: float
    free: FloatArray


@kernel
def evaluate(
    objective: Objective,
    pose: FloatArray,
    rows: FloatArray,
    hessian: FloatArray,
    gradient: FloatArray,
) -> float:
    """Build the Gauss-Newton system of all free unknowns at a pose; returns the cost.

    ``rows`` (9, 2 * BLOCK) is scratch space; ``hessian`` (8, 8) and ``gradient`` (8,) receive
    J' W J and J' W r with the prior, and unit rows for unknowns that are not free. The cost is the
    sum of losses and prior, infinite if a point lies behind the camera.
    """
    hessian[:] = 0.0
    gradient[:] = 0.0
    cost = 0.0
    for start in range(0, objective.points.shape[0], BLOCK):
        size = min(BLOCK, objective.points.shape[0] - start)
        cost += jacobian_rows(objective, pose, start, size, rows)
        if not cost < np.inf:
            return np.inf
        _add_products(rows, 2 * size, hessian, gradient)
    for k in range(UNKNOWNS):
        for m in range(k):
            hessian[k, m] = hessian[m, k]
    for k in range(2):
        log_scale = np.log(pose[13 + k])
        cost += objective.prior_weight * log_scale * log_scale
        gradient[6 + k] += objective.prior_weight * log_scale
        hessian[6 + k, 6 + k] += objective.prior_weight
    for k in range(UNKNOWNS):
        if objective.free[k] == 0.0:
            gradient[k] = 0.0
            for m in range(UNKNOWNS):
                hessian[k, m] = hessian[m, k] = 0.0
            hessian[k, k] = 1.0
    return float(cost)


@kernel
def jacobian_rows(
    objective: Objective,
    pose: FloatArray,
    start: int,
    size: int,
    rows: FloatArray,
) -> float:
    """Write whitened, loss-weighted derivatives and residuals of a block of points.

    Row k < 8 of ``rows`` is unknown k, row 8 the residual; the block's u equations stand before
    its v equations. Returns the block's cost, infinite if a point lies behind the camera.
    """
    points, rays, whitening = objective.points, objective.rays, objective.whitening
    loss, loss_scale = objective.loss, objective.loss_scale
    r00, r01, r02 = pose[0], pose[1], pose[2]
    r10, r11, r12 = pose[3], pose[4], pose[5]
    r20, r21, r22 = pose[6], pose[7], pose[8]
    tx, ty, tz = pose[9], pose[10], pose[11]
    each = whitening.shape[0] > 1
    wa, wb, wc = whitening[0, 0], whitening[0, 1], whitening[0, 2]
    cost = 0.0
    nearest = np.inf
    for b in range(size):
        i = start + b
        x = points[i, 0] * pose[12]
        y = points[i, 1] * pose[13]
        z = points[i, 2] * pose[14]
        ax, ay, az = r01 * y, r11 * y, r21 * y
        bx, by, bz = r02 * z, r12 * z, r22 * z
        px = r00 * x + ax + bx
        py = r10 * x + ay + by
        pz = r20 * x + az + bz
        depth = pz + tz
        nearest = min(nearest, depth)
        inverse = 1.0 / depth
        u = (px + tx) * inverse
        v = (py + ty) * inverse
        du = u - rays[i, 0]
        dv = v - rays[i, 1]
        if each:
            wa, wb, wc = whitening[i, 0], whitening[i, 1], whitening[i, 2]
        ru = wa * du + wb * dv
        rv = wc * dv
        square = ru * ru + rv * rv
        root = 1.0
        if loss == LINEAR:
            cost += square
        elif loss == HUBER:
            length = np.sqrt(square)
            if length > loss_scale:
                root = np.sqrt(loss_scale / length)
                cost += (2.0 * length - loss_scale) * loss_scale
            else:
                cost += square
        else:
            ratio = square / (loss_scale * loss_scale)
            root = np.sqrt(1.0 / (1.0 + ratio))
            cost += loss_scale * loss_scale * np.log1p(ratio)
        # Derivatives of (u, v) by the camera-frame point, whitened: (e, f, -g) and (0, h, -k).
        e = root * wa * inverse
        f = root * wb * inverse
        g = e * u + f * v
        h = root * wc * inverse
        k = h * v
        c = size + b
        rows[0, b] = -f * pz - g * py
        rows[1, b] = e * pz + g * px
        rows[2, b] = f * px - e * py
        rows[3, b] = e
        rows[4, b] = f
        rows[5, b] = -g
        rows[6, b] = e * ax + f * ay - g * az
        rows[7, b] = e * bx + f * by - g * bz
        rows[8, b] = root * ru
        rows[0, c] = -h * pz - k * py
        rows[1, c] = k * px
        rows[2, c] = h * px
        rows[3, c] = 0.0
        rows[4, c] = h
        rows[5, c] = -k
        rows[6, c] = h * ay - k * az
        rows[7, c] = h * by - k * bz
        rows[8, c] = root * rv
    return cost if nearest > 0 else np.inf


@fast_sums
def _add_products(
    rows: FloatArray, columns: int, hessian: FloatArray, gradient: FloatArray
) -> None:
    """Add the rows' inner products to the upper triangle of J' W J and to J' W r."""
    for k in range(UNKNOWNS):
        for m in range(k, UNKNOWNS + 1):
            total = 0.0
            for c in range(columns):
                total += rows[k, c] * rows[m, c]
            if m < UNKNOWNS:
                hessian[k, m] += total
            else:
                gradient[k] += total


@kernel
def evaluate_cost(objective: Objective, pose: FloatArray) -> float:
    """The cost of a pose, as `evaluate` returns it, without derivatives."""
    points, rays, whitening = objective.points, objective.rays, objective.whitening
    each = whitening.shape[0] > 1
    bend = objective.loss_scale * objective.loss_scale
    cost = objective.prior_weight * (np.log(pose[13]) ** 2 + np.log(pose[14]) ** 2)
    for i in range(points.shape[0]):
        x = points[i, 0] * pose[12]
        y = points[i, 1] * pose[13]
        z = points[i, 2] * pose[14]
        depth = pose[6] * x + pose[7] * y + pose[8] * z + pose[11]
        if not depth > 0:
            return np.inf
        du = (pose[0] * x + pose[1] * y + pose[2] * z + pose[9]) / depth - rays[i, 0]
        dv = (pose[3] * x + pose[4] * y + pose[5] * z + pose[10]) / depth - rays[i, 1]
        w = i if each else 0
        ru = whitening[w, 0] * du + whitening[w, 1] * dv
        rv = whitening[w, 2] * dv
        square = ru * ru + rv * rv
        if objective.loss == HUBER and square > bend:
            square = (2.0 * np.sqrt(square) - objective.loss_scale) * objective.loss_scale
        elif objective.loss == CAUCHY:
            square = bend * np.log1p(square / bend)
        cost += square
    return float(cost)
