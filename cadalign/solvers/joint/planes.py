"""Evidence about the distance of the object's points from planes. Displacements don't count."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import inlined, kernel
from cadalign.solvers.evidence import loss_and_root
from cadalign.solvers.joint.evidence import Evidence, State


@kernel
def add_planes(
    evidence: Evidence, state: State, hessian: FloatArray, gradient: FloatArray
) -> float:
    """Add points that lie in planes known in a camera; returns their cost.

    The residual is ``normal . X - offset`` of the point X in the camera's frame.
    """
    planes, rig = evidence.planes, evidence.rig
    unknowns = gradient.shape[0]
    row = np.empty(unknowns)
    stretched, rotated, normal = np.empty(3), np.empty(3), np.empty(3)
    cost = 0.0
    for j in range(planes.point.shape[0]):
        v = planes.image[j]
        camera, pose = rig.cam_from_rig[v], state.poses[rig.pose[v]]
        _stretch(evidence, state, planes.point[j], stretched)
        value = -planes.offset[j]
        for r in range(3):
            normal[r] = 0.0
            for c in range(3):
                normal[r] += planes.normal[j, c] * camera[3 * c + r]
            value += planes.normal[j, r] * camera[9 + r]
        for r in range(3):
            rotated[r] = 0.0
            for a in range(3):
                rotated[r] += pose[3 * r + a] * stretched[a]
            value += normal[r] * (rotated[r] + pose[9 + r])
        value *= planes.weight[j]
        part, root = loss_and_root(planes.loss[j], planes.loss_scale[j], value * value)
        cost += part
        row[:] = 0.0
        p = 6 * rig.pose[v]
        weight = root * planes.weight[j]
        row[p] = weight * (rotated[1] * normal[2] - rotated[2] * normal[1])
        row[p + 1] = weight * (rotated[2] * normal[0] - rotated[0] * normal[2])
        row[p + 2] = weight * (rotated[0] * normal[1] - rotated[1] * normal[0])
        for r in range(3):
            row[p + 3 + r] = weight * normal[r]
        for a in range(3):
            slope = weight * (
                normal[0] * pose[a] + normal[1] * pose[3 + a] + normal[2] * pose[6 + a]
            )
            _add_shape(evidence, state, planes.point[j], a, slope, stretched[a], row)
        _accumulate(row, root * value, hessian, gradient)
    return cost


@kernel
def add_heights(
    evidence: Evidence, state: State, hessian: FloatArray, gradient: FloatArray
) -> float:
    """Add heights of cameras above the plane through a point, across a direction of the model.

    The height is ``-direction . (x + R' q)`` with the stretched point x and the camera's place
    ``-q`` in the rig's frame, which the pose (R, t) leads to. Returns the cost.
    """
    heights, rig = evidence.heights, evidence.rig
    row = np.empty(gradient.shape[0])
    stretched, up, q = np.empty(3), np.empty(3), np.empty(3)
    cost = 0.0
    for j in range(heights.point.shape[0]):
        v = heights.image[j]
        camera, pose = rig.cam_from_rig[v], state.poses[rig.pose[v]]
        _stretch(evidence, state, heights.point[j], stretched)
        value = heights.value[j]
        for r in range(3):
            up[r] = 0.0
            q[r] = pose[9 + r]
            for a in range(3):
                up[r] += pose[3 * r + a] * heights.direction[j, a]
                q[r] += camera[3 * a + r] * camera[9 + a]
            value += up[r] * q[r] + heights.direction[j, r] * stretched[r]
        weight = heights.weight[j]
        value *= weight
        cost += value * value
        row[:] = 0.0
        p = 6 * rig.pose[v]
        row[p] = weight * (up[1] * q[2] - up[2] * q[1])
        row[p + 1] = weight * (up[2] * q[0] - up[0] * q[2])
        row[p + 2] = weight * (up[0] * q[1] - up[1] * q[0])
        for a in range(3):
            row[p + 3 + a] = weight * up[a]
            slope = weight * heights.direction[j, a]
            _add_shape(evidence, state, heights.point[j], a, slope, stretched[a], row)
        _accumulate(row, value, hessian, gradient)
    return cost


@inlined
def _stretch(evidence: Evidence, state: State, i: int, stretched: FloatArray) -> None:
    """Write point i, stretched but not displaced."""
    shape = evidence.shape
    for a in range(3):
        value = shape.mean[i, a]
        for k in range(shape.modes.shape[0]):
            value += state.coefficients[k] * shape.modes[k, i, a]
        stretched[a] = np.exp(state.log_scales[a]) * value


@inlined
def _add_shape(
    evidence: Evidence,
    state: State,
    i: int,
    a: int,
    slope: float,
    stretched: float,
    row: FloatArray,
) -> None:
    """Add the derivatives by scale and modes of ``slope`` times coordinate a of point i."""
    modes = evidence.shape.modes.shape[0]
    first = row.shape[0] - modes - 3
    row[first + a] += slope * stretched
    scale = np.exp(state.log_scales[a])
    for k in range(modes):
        row[first + 3 + k] += slope * scale * evidence.shape.modes[k, i, a]


@inlined
def _accumulate(row: FloatArray, value: float, hessian: FloatArray, gradient: FloatArray) -> None:
    """Add one equation to the upper triangle of the normal equations."""
    for k in range(row.shape[0]):
        if row[k] != 0.0:
            gradient[k] += row[k] * value
            for m in range(k, row.shape[0]):
                hessian[k, m] += row[k] * row[m]
