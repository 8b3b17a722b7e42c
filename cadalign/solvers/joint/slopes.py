"""The step that the joint equations predict, whose root is the optimum."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.solvers.joint.equations import joint_room
from cadalign.solvers.joint.evidence import Evidence
from cadalign.solvers.joint.system import Joint, evaluate_joint, move_joint
from cadalign.solvers.search import solve


@kernel
def joint_step(evidence: Evidence, integrates: bool, row: FloatArray) -> FloatArray:
    """Step (6 P + b,) of poses and border, then changes (3 m,) of the displacements.

    All that the objective holds counts, see `cadalign.solvers.joint.system`; not a number where the
    equations do not determine the unknowns.
    """
    system = Joint(evidence, integrates)
    equations = joint_room(evidence)
    size, first = equations.gradient.shape[0], row.shape[0] - 3 * evidence.shape.mean.shape[0]
    found = np.full(size + row.shape[0] - first, np.nan)
    step, moved = np.zeros(size), row.copy()
    if not evaluate_joint(system, row, equations) < np.inf:
        return found
    if np.isnan(solve(system, equations, 0.0, step)):
        return found
    move_joint(system, row, equations, 0.0, step, moved)
    found[:size] = step
    for k in range(first, row.shape[0]):
        found[size + k - first] = moved[k] - row[k]
    return found
