"""Equations of the joint system: sightings, blocks of further evidence, and priors.

A block is a NamedTuple of columns that registers a member of both families below. An equation of a
block is a residual and its derivatives (6 + b,) by one pose, log focal lengths, log scales and
coefficients. The residual must be linear in the coefficients, and ignores displacements.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import borrow, inline, kernel, kernel_family, unrolled
from cadalign.solvers.constants import CAUCHY
from cadalign.solvers.evidence import excess_of, loss_and_root, weigh_error, weight_slope
from cadalign.solvers.joint.arrow import Arrow, add_rows, border_start
from cadalign.solvers.joint.evidence import (
    Directions,
    Evidence,
    Focals,
    Offsets,
    ScalePriors,
    Shape,
    State,
    coordinate_of,
    exp_triple,
    remove_displacements,
    stretched_point,
)
from cadalign.solvers.linalg import cross, dot, multiply, triple
from cadalign.solvers.projection import ray_of, ray_slopes, shift, turn, turn_back, write_motion

equations_of = kernel_family("equations_of")
"""``(block)``: number of equations of a block."""
write_equation = kernel_family("write_equation")
"""``(block, evidence, state, q, row)``: write the derivatives (6 + b,) of equation q.

``row`` is zero on entry. Returns a `BlockEquation`; the state's displacements are zero.
"""


class BlockEquation(NamedTuple):
    """A whitened residual of one pose, with its ``cost`` and weight by the loss.

    ``root`` is the square root of the weight, ``fall`` its `weight_slope`.
    """

    pose: int
    residual: float
    cost: float
    root: float
    fall: float


@kernel
def count_block_equations(evidence: Evidence) -> int:
    count = 0
    for block in unrolled(evidence.blocks):
        count += equations_of(block)
    return count


@kernel
def write_block_row(evidence: Evidence, state: State, q: int, row: FloatArray) -> BlockEquation:
    """Write the derivatives (6 + b,) of equation ``q``, counted over all blocks."""
    row[:] = 0.0
    first = 0
    found = BlockEquation(0, 0.0, 0.0, 1.0, 0.0)
    for block in unrolled(evidence.blocks):
        count = equations_of(block)
        if first <= q < first + count:
            found = write_equation(block, evidence, state, q - first, row)
        first += count
    return found


@inline
def plain_equation(pose: int, residual: float) -> BlockEquation:
    """An equation with squared loss."""
    return BlockEquation(pose, residual, residual * residual, 1.0, 0.0)


@equations_of.of(Directions)
@inline
def _equations_of_directions(directions: Directions) -> int:
    return 3 * int(directions.image.shape[0])


@write_equation.of(Directions)
@kernel
def _write_direction(
    directions: Directions, evidence: Evidence, state: State, q: int, row: FloatArray
) -> BlockEquation:
    """Write one of the three equations of a known direction, such as gravity."""
    d, w = q // 3, q % 3
    v = directions.image[d]
    rig = evidence.rig
    camera, pose = rig.cam_from_rig[v], state.poses[rig.pose[v]]
    rotated = turn(pose, triple(directions.model[d]))
    (x, y, z), known = turn(camera, rotated), directions.camera[d]
    whitening = triple(directions.whitening[d, w])
    row[0], row[1], row[2] = cross(rotated, turn_back(camera, whitening))
    residual = dot(whitening, (x - known[0], y - known[1], z - known[2]))
    return plain_equation(rig.pose[v], residual)


@equations_of.of(Offsets)
@inline
def _equations_of_offsets(offsets: Offsets) -> int:
    return int(offsets.value.shape[0])


@write_equation.of(Offsets)
@kernel
def _write_offset(
    offsets: Offsets, evidence: Evidence, state: State, j: int, row: FloatArray
) -> BlockEquation:
    """Write the equation of a known distance along a direction of the model.

    The center of a camera in the model's frame is ``-R' q``, with the pose (R, t), the camera
    (C, c) in the rig and ``q = t + C' c``. Its coordinate along the direction d is ``-(R d) . q``.
    """
    rig = evidence.rig
    v, weight = offsets.image[j], offsets.weight[j]
    p = 0 if v < 0 else rig.pose[v]
    value = -offsets.value[j]
    for end in range(2):
        sign = 2.0 * end - 1.0
        i = offsets.ends[j, end]
        if i < 0:
            camera, pose = rig.cam_from_rig[v], state.poses[p]
            turned = turn(pose, triple(offsets.direction[j]))
            q = shift(pose, turn_back(camera, triple(camera[9:])))
            value -= sign * dot(turned, q)
            by_turn = cross(turned, q)
            for r in range(3):
                row[r] = -sign * weight * by_turn[r]
                row[3 + r] = -sign * weight * turned[r]
            continue
        for a in range(3):
            along = sign * offsets.direction[j, a]
            if along != 0.0:
                stretched = np.exp(state.log_scales[a]) * coordinate_of(evidence.shape, state, i, a)
                value += along * stretched
                _add_shape(evidence.shape, state, i, a, weight * along, row)
    return plain_equation(p, value * weight)


@inline
def _add_shape(shape: Shape, state: State, i: int, a: int, slope: float, row: FloatArray) -> None:
    """Add derivatives by scale and coefficients of ``slope`` times coordinate a of point i."""
    modes = shape.modes.shape[0]
    first = row.shape[0] - modes - 3
    scale = slope * np.exp(state.log_scales[a])
    row[first + a] += scale * coordinate_of(shape, state, i, a)
    for k in range(modes):
        row[first + 3 + k] += scale * shape.modes[k, i, a]


@borrow
def write_rows(
    evidence: Evidence,
    state: State,
    chosen: IntArray,
    rows: FloatArray,
    seen: FloatArray,
    first_seen: int,
) -> float:
    """Write whitened, loss-weighted derivatives and residuals of sightings; returns the cost.

    The ``chosen`` sightings belong to one pose. Rows of ``rows`` (6 + b + 4, C) are derivatives by
    this pose and the border, the residual, and derivatives by the point's displacement; columns are
    equations. ``seen`` (8, N) receives, from column ``first_seen`` on, the residual's slope by the
    point (3) and the camera's z axis over the depth (3, 0 for a residual of depth), both in the
    rig's frame; the residual times `weight_slope`; and the derivative by the log focal length.
    """
    shape, sightings, rig = evidence.shape, evidence.sightings, evidence.rig
    rows[:] = 0.0
    first = 6 + evidence.focals.low.shape[0]
    last = first + 3 + shape.modes.shape[0]
    scale = exp_triple(state.log_scales)
    cost = 0.0
    column = 0
    for n in chosen:
        i, v = sightings.point[n], sightings.image[n]
        camera, motion = rig.cam_from_rig[v], state.poses[rig.pose[v]]
        point = stretched_point(shape, state, scale, i)
        turned = turn(motion, point)
        in_camera, axis = shift(camera, turn(camera, shift(motion, turned))), triple(rig.axes[v])
        place = ray_of(in_camera)
        u, w, depth = place
        if not depth > 0:
            return np.inf
        group = evidence.focals.group[v]
        log_ratio = state.log_focals[group] if group >= 0 else 0.0
        ratio = np.exp(log_ratio)
        # Rays for the reference focal length, also their derivatives by the log focal length.
        by_log_u, by_log_w = ratio * u, ratio * w
        du, dw = by_log_u - sightings.rays[n, 0], by_log_w - sightings.rays[n, 1]
        loss, loss_scale = sightings.loss[n], sightings.loss_scale[n]
        error = weigh_error(triple(sightings.whitening[n]), du, dw, loss, loss_scale)
        a, b, c = error.whitening
        weight = sightings.depths[n, 1]
        rz = weight * (dot(axis, in_camera) - sightings.depths[n, 0])
        if sightings.depths[n, 2] > 0.0:
            depth_loss, depth_scale = CAUCHY, sightings.depths[n, 2]
        else:
            depth_loss, depth_scale = loss, loss_scale
        depth_part, depth_root = loss_and_root(depth_loss, depth_scale, rz * rz)
        cost += error.cost + depth_part
        by_u, by_w = ray_slopes(place, (ratio * a, ratio * b, ratio * c))
        counts = True, c > 0.0, weight > 0.0
        slopes = by_u, by_w, multiply(axis, depth_root * weight)
        residuals = error.u, error.v, depth_root * rz
        fall = weight_slope(loss, loss_scale, error.root, error.u**2 + error.v**2)
        depth_fall = weight_slope(depth_loss, depth_scale, depth_root, residuals[2] ** 2)
        falls = fall, fall, depth_fall
        by_focal = a * by_log_u + b * by_log_w, c * by_log_w, 0.0
        for q in range(3):
            if not counts[q]:
                continue
            by_rig = turn_back(camera, slopes[q])
            by_model = turn_back(motion, by_rig)
            write_motion(turned, by_rig, rows, column)
            if group >= 0:
                rows[6 + group, column] = by_focal[q]
            seen[6, first_seen + column] = falls[q] * residuals[q]
            seen[7, first_seen + column] = by_focal[q] if group >= 0 else 0.0
            for k in range(3):
                rows[first + k, column] = by_model[k] * point[k] * evidence.scales.free[k]
                rows[last + 1 + k, column] = by_model[k] * scale[k]
                seen[k, first_seen + column] = by_rig[k]
                # Rays shrink with the depth; a residual of depth does not.
                seen[3 + k, first_seen + column] = camera[6 + k] / depth if q < 2 else 0.0
            for k in range(shape.modes.shape[0]):
                rows[first + 3 + k, column] = (
                    by_model[0] * scale[0] * shape.modes[k, i, 0]
                    + by_model[1] * scale[1] * shape.modes[k, i, 1]
                    + by_model[2] * scale[2] * shape.modes[k, i, 2]
                )
            rows[last, column] = residuals[q]
            column += 1
    return cost


@kernel
def add_blocks(evidence: Evidence, state: State, arrow: Arrow, products: FloatArray) -> float:
    """Add priors and blocks; returns their cost. For ``products`` see `add_rows`."""
    cost = _add_priors(evidence.focals, evidence.scales, state, arrow)
    column = np.empty(products.shape[0])
    row, rows, still = column[:-1], column.reshape((-1, 1)), remove_displacements(state)
    for q in range(count_block_equations(evidence)):
        equation = write_block_row(evidence, still, q, row)
        cost += equation.cost
        row *= equation.root
        column[-1] = equation.root * equation.residual
        add_rows(arrow, equation.pose, rows, 1, products)
    return cost


@kernel
def bounded_scales(free: FloatArray) -> FloatArray:
    """Matrix (3, 3) from log scales to bounded values; without their mean if all are free."""
    rows = np.zeros((3, 3))
    mean = np.floor((free[0] + free[1] + free[2]) / 3.0) / 3.0
    for a in range(3):
        for b in range(3):
            rows[a, b] = (free[a] if a == b else 0.0) - mean
    return rows


@kernel
def _add_priors(focals: Focals, scales: ScalePriors, state: State, arrow: Arrow) -> float:
    """Add the priors on focal lengths, log scales and coefficients."""
    border, gradient = arrow.border, arrow.gradient[border_start(arrow) :]
    first = focals.low.shape[0]
    cost = 0.0
    for f in range(first):
        value = state.log_focals[f] - focals.center[f]
        cost += focals.weight[f] * value * value
        gradient[f] += focals.weight[f] * value
        border[f, f] += focals.weight[f]
    for a in range(3):
        for b in range(3):
            weight = scales.precision[a, b]
            cost += weight * state.log_scales[a] * state.log_scales[b]
            gradient[first + a] += weight * state.log_scales[b]
            border[first + a, first + b] += weight
    bound, rows = scales.bound, bounded_scales(scales.free)
    for a in range(3):
        bounded = 0.0
        for b in range(3):
            bounded += rows[a, b] * state.log_scales[b]
        if abs(bounded) >= bound.width:
            excess = excess_of(bounded, bound.width)
            cost += bound.weight * excess * excess
            for b in range(3):
                gradient[first + b] += bound.weight * excess * rows[a, b]
                for c in range(3):
                    border[first + b, first + c] += bound.weight * rows[a, b] * rows[a, c]
    for k in range(state.coefficients.shape[0]):
        value = state.coefficients[k]
        cost += value * value
        gradient[first + 3 + k] += value
        border[first + 3 + k, first + 3 + k] += 1.0
    return cost
