"""Evidence that no image point gives: priors, known directions, known lengths."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.solvers.joint.evidence import Evidence, State


@kernel
def add_priors(
    evidence: Evidence, state: State, hessian: FloatArray, gradient: FloatArray
) -> float:
    """Add the priors on log scales and coefficients; returns their cost."""
    modes = evidence.shape.modes.shape[0]
    first = gradient.shape[0] - modes - 3
    cost = 0.0
    for a in range(3):
        for b in range(3):
            weight = evidence.scales.precision[a, b]
            cost += weight * state.log_scales[a] * state.log_scales[b]
            gradient[first + a] += weight * state.log_scales[b]
            if a <= b:
                hessian[first + a, first + b] += weight
    for k in range(modes):
        value = state.coefficients[k]
        cost += value * value
        gradient[first + 3 + k] += value
        hessian[first + 3 + k, first + 3 + k] += 1.0
    return cost


@kernel
def add_directions(
    evidence: Evidence, state: State, hessian: FloatArray, gradient: FloatArray
) -> float:
    """Add directions known in a camera, such as gravity; returns their cost.

    The residual is the whitened difference of two unit vectors: its length is 2 sin(angle / 2).
    """
    directions, rig = evidence.directions, evidence.rig
    cost = 0.0
    row, seen, by_rig = np.empty(3), np.empty(3), np.empty(3)
    for d in range(directions.image.shape[0]):
        v = directions.image[d]
        p, camera, pose = rig.pose[v], rig.cam_from_rig[v], state.poses[rig.pose[v]]
        rotated = np.zeros(3)
        for r in range(3):
            for a in range(3):
                rotated[r] += pose[3 * r + a] * directions.model[d, a]
        for c in range(3):
            seen[c] = -directions.camera[d, c]
            for r in range(3):
                seen[c] += camera[3 * c + r] * rotated[r]
        for w in range(3):
            whitening = directions.whitening[d, w]
            value = whitening[0] * seen[0] + whitening[1] * seen[1] + whitening[2] * seen[2]
            cost += value * value
            for r in range(3):
                by_rig[r] = (
                    whitening[0] * camera[r]
                    + whitening[1] * camera[3 + r]
                    + whitening[2] * camera[6 + r]
                )
            row[0] = rotated[1] * by_rig[2] - rotated[2] * by_rig[1]
            row[1] = rotated[2] * by_rig[0] - rotated[0] * by_rig[2]
            row[2] = rotated[0] * by_rig[1] - rotated[1] * by_rig[0]
            for k in range(3):
                gradient[6 * p + k] += row[k] * value
                for m in range(k, 3):
                    hessian[6 * p + k, 6 * p + m] += row[k] * row[m]
    return cost


@kernel
def add_lengths(
    evidence: Evidence, state: State, hessian: FloatArray, gradient: FloatArray
) -> float:
    """Add known lengths along the model's axes; returns their cost. Displacements don't count."""
    lengths, shape = evidence.lengths, evidence.shape
    unknowns = gradient.shape[0]
    modes = shape.modes.shape[0]
    first = unknowns - modes - 3
    cost = 0.0
    row = np.empty(modes + 1)
    for j in range(lengths.axis.shape[0]):
        low, high, a = lengths.points[j, 0], lengths.points[j, 1], lengths.axis[j]
        scale = np.exp(state.log_scales[a])
        extent = shape.mean[high, a] - shape.mean[low, a]
        for k in range(modes):
            row[1 + k] = scale * (shape.modes[k, high, a] - shape.modes[k, low, a])
            extent += state.coefficients[k] * row[1 + k] / scale
        row[0] = scale * extent
        value = (row[0] - lengths.value[j]) * lengths.weight[j]
        cost += value * value
        for k in range(modes + 1):
            row[k] *= lengths.weight[j]
        for k in range(modes + 1):
            at = first + a if k == 0 else first + 2 + k
            gradient[at] += row[k] * value
            for m in range(k, modes + 1):
                hessian[at, first + a if m == 0 else first + 2 + m] += row[k] * row[m]
    return cost
