"""Residuals of the sightings of one pose and their derivatives."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import inlined, kernel
from cadalign.solvers.evidence import loss_and_root
from cadalign.solvers.joint.evidence import Evidence, Sightings, State, unstretched


@inlined
def _is_equation(second_weight: float, depth_weight: float, q: int) -> bool:
    """True if equation ``q`` of a sighting counts: along the first axis, the second, in depth."""
    if q == 0:
        return True
    return second_weight > 0.0 if q == 1 else depth_weight > 0.0


@kernel
def count_equations(sightings: Sightings, n: int) -> int:
    """Number of equations that sighting n gives: a contour point one, a keypoint two or three."""
    count = 0
    for q in range(3):
        if _is_equation(sightings.whitening[n, 2], sightings.depths[n, 1], q):
            count += 1
    return count


@kernel
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
    of `count_equations`, sighting after sighting. ``seen`` (7, N) receives, from column
    ``first_seen`` on, the vector by which the residual changes with the point in the rig's frame,
    the camera's z there over the depth (none for equations in depth), and the loss's root.
    """
    shape, sightings, rig = evidence.shape, evidence.sightings, evidence.rig
    rows[:] = 0.0
    modes, focals = shape.modes.shape[0], evidence.focals.low.shape[0]
    first = 6 + focals
    last = first + 3 + modes
    scale = np.exp(state.log_scales)
    stretched = np.empty(3)
    rotated = np.empty(3)
    by_camera = np.empty((3, 3))
    by_rig = np.empty(3)
    by_model = np.empty(3)
    residual = np.empty(3)
    by_focal = np.empty(3)
    cost = 0.0
    last_point = -1
    column = 0
    for n in chosen:
        i, v = sightings.point[n], sightings.image[n]
        camera, pose = rig.cam_from_rig[v], state.poses[rig.pose[v]]
        if i != last_point:
            for a in range(3):
                stretched[a] = scale[a] * unstretched(shape, state, i, a)
            for r in range(3):
                rotated[r] = 0.0
                for a in range(3):
                    rotated[r] += pose[3 * r + a] * stretched[a]
            last_point = i
        x, y, z = _apply(camera, rotated[0] + pose[9], rotated[1] + pose[10], rotated[2] + pose[11])
        if not z > 0:
            return np.inf
        group = evidence.focals.group[v]
        log_ratio = state.log_focals[group] if group >= 0 else 0.0
        ratio = np.exp(log_ratio)
        slope_u, slope_w = sightings.slopes[n, 0], sightings.slopes[n, 1]
        u, w = x / z, y / z
        # In pixels over the reference focal length.
        du = ratio * u - sightings.rays[n, 0] - log_ratio * slope_u
        dw = ratio * w - sightings.rays[n, 1] - log_ratio * slope_w
        a0, a1, a2 = sightings.whitening[n, 0], sightings.whitening[n, 1], sightings.whitening[n, 2]
        depth_weight = sightings.depths[n, 1]
        residual[0], residual[1] = a0 * du + a1 * dw, a2 * dw
        residual[2] = depth_weight * (z - sightings.depths[n, 0])
        square = residual[0] ** 2 + residual[1] ** 2
        part, root = loss_and_root(sightings.loss[n], sightings.loss_scale[n], square)
        depth_part, depth_root = loss_and_root(
            sightings.loss[n], sightings.loss_scale[n], residual[2] ** 2
        )
        cost += part + depth_part
        a0, a1, a2 = root * a0, root * a1, root * a2
        by_focal[0] = a0 * (ratio * u - slope_u) + a1 * (ratio * w - slope_w)
        by_focal[1], by_focal[2] = a2 * (ratio * w - slope_w), 0.0
        e, f, h = ratio * a0 / z, ratio * a1 / z, ratio * a2 / z
        by_camera[0, 0], by_camera[0, 1], by_camera[0, 2] = e, f, -(e * u + f * w)
        by_camera[1, 0], by_camera[1, 1], by_camera[1, 2] = 0.0, h, -h * w
        by_camera[2, 0], by_camera[2, 1], by_camera[2, 2] = 0.0, 0.0, depth_root * depth_weight
        residual[0] *= root
        residual[1] *= root
        residual[2] *= depth_root
        for q in range(3):
            if not _is_equation(sightings.whitening[n, 2], depth_weight, q):
                continue
            for a in range(3):
                by_rig[a] = (
                    by_camera[q, 0] * camera[a]
                    + by_camera[q, 1] * camera[3 + a]
                    + by_camera[q, 2] * camera[6 + a]
                )
            for a in range(3):
                by_model[a] = (
                    by_rig[0] * pose[a] + by_rig[1] * pose[3 + a] + by_rig[2] * pose[6 + a]
                )
            rows[0, column] = rotated[1] * by_rig[2] - rotated[2] * by_rig[1]
            rows[1, column] = rotated[2] * by_rig[0] - rotated[0] * by_rig[2]
            rows[2, column] = rotated[0] * by_rig[1] - rotated[1] * by_rig[0]
            if group >= 0:
                rows[6 + group, column] = by_focal[q]
            for a in range(3):
                rows[3 + a, column] = by_rig[a]
                rows[first + a, column] = by_model[a] * stretched[a] * evidence.scales.free[a]
                by_model[a] *= scale[a]
                rows[last + 1 + a, column] = by_model[a]
                seen[a, first_seen + column] = by_rig[a]
                # What lies farther is seen smaller; a depth is not.
                seen[3 + a, first_seen + column] = camera[6 + a] / z if q < 2 else 0.0
            for k in range(modes):
                rows[first + 3 + k, column] = (
                    by_model[0] * shape.modes[k, i, 0]
                    + by_model[1] * shape.modes[k, i, 1]
                    + by_model[2] * shape.modes[k, i, 2]
                )
            rows[last, column] = residual[q]
            column += 1
    return cost


@inlined
def _apply(camera: FloatArray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A point of the rig's frame in a camera's."""
    return (
        camera[0] * x + camera[1] * y + camera[2] * z + camera[9],
        camera[3] * x + camera[4] * y + camera[5] * z + camera[10],
        camera[6] * x + camera[7] * y + camera[8] * z + camera[11],
    )
