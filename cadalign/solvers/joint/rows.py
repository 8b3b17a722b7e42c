"""Residuals of all sightings and their derivatives by all unknowns."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import inlined, kernel
from cadalign.solvers.evidence import loss_and_root
from cadalign.solvers.joint.evidence import Evidence, Sightings, State


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
def write_rows(evidence: Evidence, state: State, rows: FloatArray, unknowns: int) -> float:
    """Write whitened, loss-weighted derivatives and residuals of all sightings; returns the cost.

    Rows of ``rows`` (U + 4, C) are the unknowns, the residual, and the displacement of the point;
    columns are those of `count_equations`, sighting after sighting.
    """
    shape, sightings, rig = evidence.shape, evidence.sightings, evidence.rig
    rows[:] = 0.0
    modes = shape.modes.shape[0]
    first_scale = unknowns - modes - 3
    scale = np.exp(state.log_scales)
    stretched = np.empty(3)
    rotated = np.empty(3)
    by_camera = np.empty((3, 3))
    by_rig = np.empty(3)
    by_model = np.empty(3)
    residual = np.empty(3)
    cost = 0.0
    last = -1
    column = 0
    for n in range(sightings.point.shape[0]):
        i, v = sightings.point[n], sightings.image[n]
        camera, p = rig.cam_from_rig[v], rig.pose[v]
        pose = state.poses[p]
        if i != last:
            for a in range(3):
                value = shape.mean[i, a]
                for k in range(modes):
                    value += state.coefficients[k] * shape.modes[k, i, a]
                stretched[a] = scale[a] * value
            last = i
        for r in range(3):
            rotated[r] = 0.0
            for a in range(3):
                rotated[r] += pose[3 * r + a] * (stretched[a] + state.displacements[i, a])
        x, y, z = _apply(camera, rotated[0] + pose[9], rotated[1] + pose[10], rotated[2] + pose[11])
        if not z > 0:
            return np.inf
        u, w = x / z, y / z
        du, dw = u - sightings.rays[n, 0], w - sightings.rays[n, 1]
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
        e, f, h = root * a0 / z, root * a1 / z, root * a2 / z
        by_camera[0, 0], by_camera[0, 1], by_camera[0, 2] = e, f, -(e * u + f * w)
        by_camera[1, 0], by_camera[1, 1], by_camera[1, 2] = 0.0, h, -h * w
        by_camera[2, 0], by_camera[2, 1], by_camera[2, 2] = 0.0, 0.0, depth_root * depth_weight
        residual[0] *= root
        residual[1] *= root
        residual[2] *= depth_root
        for q in range(3):
            if not _is_equation(a2, depth_weight, q):
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
            rows[6 * p, column] = rotated[1] * by_rig[2] - rotated[2] * by_rig[1]
            rows[6 * p + 1, column] = rotated[2] * by_rig[0] - rotated[0] * by_rig[2]
            rows[6 * p + 2, column] = rotated[0] * by_rig[1] - rotated[1] * by_rig[0]
            for a in range(3):
                rows[6 * p + 3 + a, column] = by_rig[a]
                rows[first_scale + a, column] = by_model[a] * stretched[a] * evidence.scales.free[a]
                rows[unknowns + 1 + a, column] = by_model[a]
                by_model[a] *= scale[a]
            for k in range(modes):
                rows[first_scale + 3 + k, column] = (
                    by_model[0] * shape.modes[k, i, 0]
                    + by_model[1] * shape.modes[k, i, 1]
                    + by_model[2] * shape.modes[k, i, 2]
                )
            rows[unknowns, column] = residual[q]
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
