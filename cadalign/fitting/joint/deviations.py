"""Covariance of what a joint estimate is asked for, from that of its unknowns."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.solvers.joint.evidence import Evidence, State


def pose_and_lengths(evidence: Evidence, state: State, unknowns: FloatArray) -> FloatArray:
    """Covariance (9, 9) of the first camera's pose and the log lengths of the box."""
    shape, rig = evidence.shape, evidence.rig
    rotation = rig.cam_from_rig[0][:9].reshape(3, 3)
    first = 6 * int(rig.pose.max() + 1)
    rows = np.zeros((9, len(unknowns)))
    pose = 6 * int(rig.pose[0])
    rows[:3, pose : pose + 3] = rotation
    rows[3:6, pose + 3 : pose + 6] = rotation
    modes = shape.modes[:, -1] - shape.modes[:, -2]
    extent = shape.mean[-1] - shape.mean[-2] + state.coefficients @ modes
    safe = np.where(extent > 0, extent, np.inf)
    rows[6:, first : first + 3] = np.eye(3)
    rows[6:, first + 3 :] = (modes / safe).T
    covariance = np.asarray(rows @ unknowns @ rows.T)
    covariance[[6, 7, 8], [6, 7, 8]] += (shape.spread[-2:] ** 2).sum() / safe**2
    return covariance
