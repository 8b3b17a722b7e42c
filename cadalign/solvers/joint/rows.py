"""Residuals of all evidence and their derivatives, which the normal equations are made of.

Sightings write rows of one pose. Directions, offsets and depths are equations about one pose and
the border: a row (6 + b,) of derivatives by the pose, the log focals, the log scales and the
coefficients, and a residual, which is linear in the coefficients. Displacements don't count.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import borrowing, inlined, kernel
from cadalign.solvers.constants import CAUCHY
from cadalign.solvers.evidence import beyond, fall_of_weight, loss_and_root, weigh_error
from cadalign.solvers.joint.arrow import Arrow, add_rows, border_start
from cadalign.solvers.joint.evidence import (
    DEPTH_LOSS_SCALE,
    Directions,
    Evidence,
    Focals,
    Rig,
    ScalePriors,
    Shape,
    State,
    exp_of,
    stretched_point,
    undisplaced,
    unstretched,
)
from cadalign.solvers.linalg import cross, dot, triple
from cadalign.solvers.projection import ray_slopes, see, shift, turn, turn_back, write_motion


@borrowing
def write_rows(
    evidence: Evidence,
    state: State,
    chosen: IntArray,
    rows: FloatArray,
    seen: FloatArray,
    first_seen: int,
) -> float:
    """Write whitened, loss-weighted derivatives and residuals of sightings; returns the cost.

    The ``chosen`` sightings are of one pose. Rows of ``rows`` (6 + b + 4, C) are the unknowns of
    that pose and of the border, the residual, and the displacement of the point; columns are those
    of the sightings, one after the other. ``seen`` (8, N) receives, from column
    ``first_seen`` on, the vector by which the residual changes with the point in the rig's frame,
    the camera's z there over the depth (none for equations in depth), the residual times
    `fall_of_weight`, and the derivative by the log focal length.
    """
    shape, sightings, rig = evidence.shape, evidence.sightings, evidence.rig
    rows[:] = 0.0
    first = 6 + evidence.focals.low.shape[0]
    last = first + 3 + shape.modes.shape[0]
    scale = exp_of(state.log_scales)
    cost = 0.0
    column = 0
    for n in chosen:
        i, v = sightings.point[n], sightings.image[n]
        camera, motion = rig.cam_from_rig[v], state.poses[rig.pose[v]]
        point = stretched_point(shape, state, scale, i)
        turned = turn(motion, point)
        place = see(shift(camera, turn(camera, shift(motion, turned))))
        u, w, depth = place
        if not depth > 0:
            return np.inf
        group = evidence.focals.group[v]
        log_ratio = state.log_focals[group] if group >= 0 else 0.0
        ratio = np.exp(log_ratio)
        # In pixels over the reference focal length; by its logarithm.
        by_log_u, by_log_w = ratio * u - sightings.slopes[n, 0], ratio * w - sightings.slopes[n, 1]
        du = ratio * u - sightings.rays[n, 0] - log_ratio * sightings.slopes[n, 0]
        dw = ratio * w - sightings.rays[n, 1] - log_ratio * sightings.slopes[n, 1]
        loss, loss_scale = sightings.loss[n], sightings.loss_scale[n]
        error = weigh_error(triple(sightings.whitening[n]), du, dw, loss, loss_scale)
        a, b, c = error.whitening
        weight = sightings.depths[n, 1]
        rz = weight * (depth - sightings.depths[n, 0])
        depth_part, depth_root = loss_and_root(loss, loss_scale, rz * rz)
        cost += error.cost + depth_part
        by_u, by_w = ray_slopes(place, (ratio * a, ratio * b, ratio * c))
        counts = True, c > 0.0, weight > 0.0
        slopes = by_u, by_w, (0.0, 0.0, depth_root * weight)
        residuals = error.u, error.v, depth_root * rz
        fall = fall_of_weight(loss, loss_scale, error.root, error.u**2 + error.v**2)
        depth_fall = fall_of_weight(loss, loss_scale, depth_root, residuals[2] ** 2)
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
                # What lies farther is seen smaller; a depth is not.
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
    """Add all evidence but sightings; returns its cost. ``products`` are as of `add_rows`."""
    cost = _add_priors(evidence.focals, evidence.scales, state, arrow)
    column = np.empty(products.shape[0])
    row, rows, still = column[:-1], column.reshape((-1, 1)), undisplaced(state)
    for q in range(count_block_equations(evidence)):
        equation = write_block_row(evidence, still, q, row)
        cost += equation.cost
        row *= equation.root
        column[-1] = equation.root * equation.residual
        add_rows(arrow, equation.pose, rows, 1, products)
    return cost


@kernel
def bounded_scales(free: FloatArray) -> FloatArray:
    """Rows (3, 3) by which log scales, those ``free`` (3,) 1, give what their bound is on."""
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
            excess = beyond(bounded, bound.width)
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


class BlockEquation(NamedTuple):
    """An equation about one pose and the border: its whitened residual and the loss on that.

    The loss gives the ``cost``, the ``root`` of the residual's weight, and `fall_of_weight`.
    """

    pose: int
    residual: float
    cost: float
    root: float
    fall: float


@inlined
def count_block_equations(evidence: Evidence) -> int:
    """Number of the equations that `write_block_row` writes."""
    directions, offsets, depths = evidence.directions, evidence.offsets, evidence.image_depths
    return int(3 * directions.image.shape[0] + offsets.value.shape[0] + depths.value.shape[0])


@kernel
def write_block_row(evidence: Evidence, state: State, q: int, row: FloatArray) -> BlockEquation:
    """Write derivatives (6 + b,) of the residual of direction, offset or depth number ``q``.

    Directions come first, with three equations each. The state has no displacements.
    """
    row[:] = 0.0
    offset = q - 3 * evidence.directions.image.shape[0]
    depth = offset - evidence.offsets.value.shape[0]
    if depth >= 0:
        pose, residual = _write_depth(evidence, state, depth, row)
        cost, root = loss_and_root(CAUCHY, DEPTH_LOSS_SCALE, residual * residual)
        weighted = root * root * residual * residual
        fall = fall_of_weight(CAUCHY, DEPTH_LOSS_SCALE, root, weighted)
        return BlockEquation(pose, residual, cost, root, fall)
    if offset >= 0:
        pose, residual = _write_offset(evidence, state, offset, row)
    else:
        rig, poses = evidence.rig, state.poses
        pose, residual = _write_direction(evidence.directions, rig, poses, q // 3, q % 3, row)
    return BlockEquation(pose, residual, residual * residual, 1.0, 0.0)


@inlined
def _write_direction(
    directions: Directions, rig: Rig, poses: FloatArray, d: int, w: int, row: FloatArray
) -> tuple[int, float]:
    """Write equation w of a direction known in a camera, such as gravity; pose and residual.

    The residual is the whitened difference of two unit vectors: its length is 2 sin(angle / 2).
    """
    v = directions.image[d]
    camera, pose = rig.cam_from_rig[v], poses[rig.pose[v]]
    rotated = turn(pose, triple(directions.model[d]))
    (x, y, z), known = turn(camera, rotated), directions.camera[d]
    whitening = triple(directions.whitening[d, w])
    row[0], row[1], row[2] = cross(rotated, turn_back(camera, whitening))
    return rig.pose[v], dot(whitening, (x - known[0], y - known[1], z - known[2]))


@inlined
def _write_offset(evidence: Evidence, state: State, j: int, row: FloatArray) -> tuple[int, float]:
    """Write the equation of a known distance along a direction of the model; pose and residual.

    A camera's place in the model's frame is ``-R' q``, with the pose (R, t), the camera's (C, c) in
    the rig and ``q = t + C' c``: along the direction d it is ``-(R d) . q``.
    """
    offsets, rig = evidence.offsets, evidence.rig
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
                stretched = np.exp(state.log_scales[a]) * unstretched(evidence.shape, state, i, a)
                value += along * stretched
                _add_shape(evidence.shape, state, i, a, weight * along, row)
    return p, value * weight


@inlined
def _write_depth(evidence: Evidence, state: State, j: int, row: FloatArray) -> tuple[int, float]:
    """Write the equation of a point's depth in a view; pose and residual."""
    depths, rig = evidence.image_depths, evidence.rig
    scale = exp_of(state.log_scales)
    v, i, weight = depths.image[j], depths.point[j], depths.weight[j]
    camera, pose = rig.cam_from_rig[v], state.poses[rig.pose[v]]
    rotated = turn(pose, stretched_point(evidence.shape, state, scale, i))
    _, _, depth = shift(camera, turn(camera, shift(pose, rotated)))
    by_rig = turn_back(camera, (0.0, 0.0, weight))
    by_turn, by_model = cross(rotated, by_rig), turn_back(pose, by_rig)
    for k in range(3):
        row[k], row[3 + k] = by_turn[k], by_rig[k]
        _add_shape(evidence.shape, state, i, k, by_model[k], row)
    return rig.pose[v], (depth - depths.value[j]) * weight


@inlined
def _add_shape(shape: Shape, state: State, i: int, a: int, slope: float, row: FloatArray) -> None:
    """Add the derivatives by scale and modes of ``slope`` times coordinate a of point i."""
    modes = shape.modes.shape[0]
    first = row.shape[0] - modes - 3
    scale = slope * np.exp(state.log_scales[a])
    row[first + a] += scale * unstretched(shape, state, i, a)
    for k in range(modes):
        row[first + 3 + k] += scale * shape.modes[k, i, a]
