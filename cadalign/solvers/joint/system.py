"""Normal equations of a joint estimate: derivatives of all sightings, priors, elimination."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import fast_sums, inlined, kernel
from cadalign.solvers.evidence import loss_and_root
from cadalign.solvers.joint.evidence import Evidence, State, count_unknowns
from cadalign.solvers.joint.priors import add_directions, add_lengths, add_priors
from cadalign.solvers.linalg import cholesky


class System(NamedTuple):
    """Normal equations of U unknowns, with the displacements eliminated.

    ``rows`` (U + 4, N3) holds the derivatives by the unknowns, the residuals, and the derivatives
    by the displacement of the point; ``hessian`` (U, U), ``gradient`` (U,); ``coupling`` (m, 3, U)
    and ``own`` (m, 3, 4), the Cholesky factor and the gradient of each displacement.
    """

    rows: FloatArray
    hessian: FloatArray
    gradient: FloatArray
    coupling: FloatArray
    own: FloatArray


@kernel
def empty_system(evidence: Evidence) -> System:
    """Room for the normal equations."""
    points, modes = evidence.shape.mean.shape[0], evidence.shape.modes.shape[0]
    unknowns = count_unknowns(evidence, modes)
    height = 3 * evidence.sightings.point.shape[0]
    return System(
        np.empty((unknowns + 4, height)),
        np.empty((unknowns, unknowns)),
        np.empty(unknowns),
        np.empty((points, 3, unknowns)),
        np.empty((points, 3, 4)),
    )


@kernel
def evaluate_joint(evidence: Evidence, state: State, system: System) -> float:
    """Write the normal equations at a state; returns the cost, infinite behind a camera."""
    cost = _write_rows(evidence, state, system)
    if not cost < np.inf:
        return np.inf
    unknowns = system.gradient.shape[0]
    _products(system.rows, unknowns, system.hessian, system.gradient)
    cost += add_priors(evidence, state, system.hessian, system.gradient)
    cost += add_directions(evidence, state, system.hessian, system.gradient)
    cost += add_lengths(evidence, state, system.hessian, system.gradient)
    for k in range(unknowns):
        for m in range(k):
            system.hessian[k, m] = system.hessian[m, k]
    first = unknowns - evidence.shape.modes.shape[0] - 3
    for a in range(3):
        if evidence.scales.free[a] == 0.0:
            k = first + a
            system.gradient[k] = 0.0
            for m in range(unknowns):
                system.hessian[k, m] = system.hessian[m, k] = 0.0
            system.hessian[k, k] = 1.0
            system.rows[k] = 0.0
    return cost + _eliminate(evidence, state, system)


@kernel
def _write_rows(evidence: Evidence, state: State, system: System) -> float:
    """Write whitened, loss-weighted derivatives and residuals of all sightings; returns the cost.

    Sighting n has the columns 3 n (first image equation), 3 n + 1 (second) and 3 n + 2 (depth).
    """
    shape, sightings, rig = evidence.shape, evidence.sightings, evidence.rig
    rows = system.rows
    rows[:] = 0.0
    unknowns = system.gradient.shape[0]
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
            column = 3 * n + q
            if q == 2 and depth_weight == 0.0:
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
                rows[first_scale + a, column] = by_model[a] * stretched[a]
                rows[unknowns + 1 + a, column] = by_model[a]
                by_model[a] *= scale[a]
            for k in range(modes):
                mode = shape.modes[k, i]
                rows[first_scale + 3 + k, column] = (
                    by_model[0] * mode[0] + by_model[1] * mode[1] + by_model[2] * mode[2]
                )
            rows[unknowns, column] = residual[q]
    return cost


@inlined
def _apply(camera: FloatArray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A point of the rig's frame in a camera's."""
    return (
        camera[0] * x + camera[1] * y + camera[2] * z + camera[9],
        camera[3] * x + camera[4] * y + camera[5] * z + camera[10],
        camera[6] * x + camera[7] * y + camera[8] * z + camera[11],
    )


@fast_sums
def _products(rows: FloatArray, unknowns: int, hessian: FloatArray, gradient: FloatArray) -> None:
    """Write the upper triangle of J' W J and J' W r."""
    columns = rows.shape[1]
    for k in range(unknowns):
        for m in range(k, unknowns + 1):
            total = 0.0
            for c in range(columns):
                total += rows[k, c] * rows[m, c]
            if m < unknowns:
                hessian[k, m] = total
            else:
                gradient[k] = total


@kernel
def _eliminate(evidence: Evidence, state: State, system: System) -> float:
    """Eliminate the displacements; returns the cost of their prior."""
    spread, sightings, rows = evidence.shape.spread, evidence.sightings, system.rows
    unknowns = system.gradient.shape[0]
    cost = 0.0
    n = 0
    count = sightings.point.shape[0]
    while n < count:
        i = sightings.point[n]
        end = n
        while end < count and sightings.point[end] == i:
            end += 1
        if spread[i] > 0:
            weight = spread[i] ** -2
            own, coupling = system.own[i], system.coupling[i]
            for a in range(3):
                d = state.displacements[i, a]
                cost += weight * d * d
                total = weight * d
                for c in range(3 * n, 3 * end):
                    total += rows[unknowns + 1 + a, c] * rows[unknowns, c]
                own[a, 3] = total
                for b in range(a + 1):
                    total = weight if a == b else 0.0
                    for c in range(3 * n, 3 * end):
                        total += rows[unknowns + 1 + a, c] * rows[unknowns + 1 + b, c]
                    own[a, b] = total
                for k in range(unknowns):
                    total = 0.0
                    for c in range(3 * n, 3 * end):
                        total += rows[unknowns + 1 + a, c] * rows[k, c]
                    coupling[a, k] = total
            _subtract(own, coupling, system.hessian, system.gradient)
        n = end
    return cost


@kernel
def _subtract(
    own: FloatArray, coupling: FloatArray, hessian: FloatArray, gradient: FloatArray
) -> None:
    """Take the part of one displacement out of the normal equations.

    ``own`` becomes its Cholesky factor L and L^-1 g, ``coupling`` becomes L^-1 C.
    """
    cholesky(own, 3, 0.0)
    unknowns = gradient.shape[0]
    for a in range(3):
        for b in range(a):
            own[a, 3] -= own[a, b] * own[b, 3]
        own[a, 3] /= own[a, a]
        for k in range(unknowns):
            total = coupling[a, k]
            for b in range(a):
                total -= own[a, b] * coupling[b, k]
            coupling[a, k] = total / own[a, a]
    for k in range(unknowns):
        c0, c1, c2 = coupling[0, k], coupling[1, k], coupling[2, k]
        gradient[k] -= c0 * own[0, 3] + c1 * own[1, 3] + c2 * own[2, 3]
        if c0 == 0.0 and c1 == 0.0 and c2 == 0.0:
            continue
        for m in range(unknowns):
            hessian[k, m] -= c0 * coupling[0, m] + c1 * coupling[1, m] + c2 * coupling[2, m]
