"""Room for the normal equations of the joint system, and what they are computed with."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import kernel
from cadalign.solvers.joint.arrow import Arrow, empty_arrow
from cadalign.solvers.joint.evidence import Evidence, count_poses
from cadalign.solvers.joint.rows import count_equations


class JointEquations(NamedTuple):
    """Normal equations, and scratch space.

    ``gradient`` is that of the ``arrow``; ``factor`` is for the damped one. The sightings of pose p
    are ``order[first[p]:first[p + 1]]``, point after point. ``rows`` and ``seen`` are those of
    `write_rows`. Of one pose, the equations of point i are the ``columns[i]`` (2,) of the rows,
    first and behind the last, none of several poses. ``log_determinant`` (1,) is that of the
    covariances by which eliminated displacements widened the equations; ``slopes`` (m, 3) are half
    the derivatives of the whole log determinant by the points before the stretch.
    """

    arrow: Arrow
    gradient: FloatArray
    factor: Arrow
    order: IntArray
    first: IntArray
    columns: IntArray
    rows: FloatArray
    seen: FloatArray
    products: FloatArray
    log_determinant: FloatArray
    slopes: FloatArray


@kernel
def joint_room(evidence: Evidence) -> JointEquations:
    """Room for the normal equations."""
    sightings, rig = evidence.sightings, evidence.rig
    poses, points = count_poses(evidence), evidence.shape.mean.shape[0]
    border = evidence.focals.low.shape[0] + 3 + evidence.shape.modes.shape[0]
    order = np.argsort(rig.pose[sightings.image] * points + sightings.point, kind="mergesort")
    first = np.zeros(poses + 1, dtype=np.int64)
    counts = np.zeros(poses, dtype=np.int64)
    columns = np.zeros((points, 2), dtype=np.int64)
    for n in order:
        i, p = sightings.point[n], rig.pose[sightings.image[n]]
        if poses == 1 and columns[i, 1] == 0:
            columns[i, 0] = counts[0]
        first[p + 1] += 1
        counts[p] += count_equations(sightings, n)
        if poses == 1:
            columns[i, 1] = counts[0]
    for p in range(poses):
        first[p + 1] += first[p]
    arrow = empty_arrow(poses, border)
    return JointEquations(
        arrow,
        arrow.gradient,
        empty_arrow(poses, border),
        order,
        first,
        columns,
        np.zeros((6 + border + 4, counts.max())),
        np.zeros((6, counts.sum())),
        np.zeros((7 + border, 7 + border)),
        np.zeros(1),
        np.zeros((points, 3)),
    )


@kernel
def with_turns(one: JointEquations) -> tuple[JointEquations, JointEquations]:
    """Equations, and others that take turns with them and share scratch space."""
    arrow = empty_arrow(one.arrow.blocks.shape[0], one.arrow.border.shape[0])
    return one, JointEquations(
        arrow,
        arrow.gradient,
        one.factor,
        one.order,
        one.first,
        one.columns,
        one.rows.copy(),
        one.seen,
        one.products,
        np.zeros(1),
        one.slopes.copy(),
    )
