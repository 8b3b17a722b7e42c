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
    own = (shape.spread[-2:] ** 2).sum()
    explained = _explained_by_corners(evidence, own)
    rows[6:] *= 1 - explained[:, None]
    covariance = np.asarray(rows @ unknowns @ rows.T)
    covariance[[6, 7, 8], [6, 7, 8]] += own * (1 - explained) / safe**2
    return covariance


def _explained_by_corners(evidence: Evidence, own: float) -> FloatArray:
    """Share (3,) of a measured length's residual that the corners' own displacements explain.

    The weight of a length counts these, of variance ``own``, as part of its noise.
    """
    explained = np.zeros(3)
    explained[evidence.lengths.axis] = np.minimum(own * evidence.lengths.weight**2, 1.0)
    return explained


def widened(evidence: Evidence, state: State, factor: float) -> tuple[Evidence, State]:
    """The same points under a prior of wider deviations."""
    if factor == 1:
        return evidence, state
    shape = evidence.shape
    wide = shape._replace(modes=factor * shape.modes, spread=factor * shape.spread)
    return evidence._replace(shape=wide), state._replace(coefficients=state.coefficients / factor)


def is_exact(evidence: Evidence) -> bool:
    """True if the shape is known but for its scales."""
    return not (len(evidence.shape.modes) or evidence.shape.spread.any())


def curvature_of_rotations(covariance: FloatArray) -> FloatArray:
    """Covariance (3, 3) that a linearisation leaves out of large rotation errors.

    Where turns about two axes are uncertain, their order turns the object about the third: of
    rotation vectors a and b, exp(a) exp(b) has the vector a + b + a x b / 2 + ... (Baker, Campbell,
    Hausdorff). For independent a and b of covariance C the second-order term has the covariance
    adj(C) / 2. It matters beyond some 20 degrees: for slender objects, which may roll and tilt.

    Parameters
    ----------
    covariance : (3, 3) float
        Of the rotation vector [rad squared].

    Examples
    --------
    >>> curvature_of_rotations(np.diag([0.01, 0.25, 0.64])).diagonal().round(4).tolist()
    [0.08, 0.0032, 0.0012]
    """
    variances, axes = np.linalg.eigh(covariance)
    x, y, z = np.maximum(variances, 0.0)
    return np.asarray((axes * [y * z, x * z, x * y]) @ axes.T / 2)
