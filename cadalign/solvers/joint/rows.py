"""Residuals of the sightings of one pose and their derivatives."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import borrowing, inlined
from cadalign.solvers.evidence import loss_and_root
from cadalign.solvers.joint.evidence import Evidence, Shape, Sightings, State, unstretched
from cadalign.solvers.linalg import Triple
from cadalign.solvers.projection import ray_slopes, see, shift, turn, turn_back, write_motion


@borrowing
def count_equations(sightings: Sightings, n: int) -> int:
    """Number of equations that sighting n gives: a contour point one, a keypoint two or three."""
    return 1 + int(sightings.whitening[n, 2] > 0.0) + int(sightings.depths[n, 1] > 0.0)


@inlined
def exp_of(logs: FloatArray) -> Triple:
    """The scales of their logarithms (3,)."""
    return np.exp(logs[0]), np.exp(logs[1]), np.exp(logs[2])


@inlined
def stretched_point(shape: Shape, state: State, scale: Triple, i: int) -> Triple:
    """Point i in the model's frame."""
    return (
        scale[0] * unstretched(shape, state, i, 0),
        scale[1] * unstretched(shape, state, i, 1),
        scale[2] * unstretched(shape, state, i, 2),
    )


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
    of `count_equations`, sighting after sighting. ``seen`` (6, N) receives, from column
    ``first_seen`` on, the vector by which the residual changes with the point in the rig's frame,
    and the camera's z there over the depth (none for equations in depth).
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
        a, b, c = sightings.whitening[n, 0], sightings.whitening[n, 1], sightings.whitening[n, 2]
        weight = sightings.depths[n, 1]
        ru, rw, rz = a * du + b * dw, c * dw, weight * (depth - sightings.depths[n, 0])
        loss, loss_scale = sightings.loss[n], sightings.loss_scale[n]
        part, root = loss_and_root(loss, loss_scale, ru * ru + rw * rw)
        depth_part, depth_root = loss_and_root(loss, loss_scale, rz * rz)
        cost += part + depth_part
        by_u, by_w = ray_slopes(place, (ratio * root * a, ratio * root * b, ratio * root * c))
        counts = True, c > 0.0, weight > 0.0
        slopes = by_u, by_w, (0.0, 0.0, depth_root * weight)
        residuals = root * ru, root * rw, depth_root * rz
        by_focal = root * (a * by_log_u + b * by_log_w), root * c * by_log_w, 0.0
        for q in range(3):
            if not counts[q]:
                continue
            by_rig = turn_back(camera, slopes[q])
            by_model = turn_back(motion, by_rig)
            write_motion(turned, by_rig, rows, column)
            if group >= 0:
                rows[6 + group, column] = by_focal[q]
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
