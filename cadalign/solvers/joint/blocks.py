"""Blocks of evidence beside sightings: tables of equations about one pose and the border.

An equation is a row (6 + b,) of derivatives by the pose, the log focals, the log scales and the
coefficients, and a residual that is linear in the coefficients. Displacements don't count. A block
is a NamedTuple of columns with a member of the two families here; `Evidence.blocks` has one of each
kind.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import KernelFamily, inlined, kernel, unrolled
from cadalign.solvers.joint.evidence import (
    Directions,
    Evidence,
    Offsets,
    Shape,
    State,
    unstretched,
)
from cadalign.solvers.linalg import cross, dot, triple
from cadalign.solvers.projection import shift, turn, turn_back

equations_of = KernelFamily("equations_of")
"""``(block)``: the number of its equations."""
write_equation = KernelFamily("write_equation")
"""``(block, evidence, state, q, row)``: write derivatives (6 + b,) of the residual of equation q.

The row is zero before. Returns a `BlockEquation`; the state has no displacements.
"""


class BlockEquation(NamedTuple):
    """An equation about one pose and the border: its whitened residual and the loss on that.

    The loss gives the ``cost``, the ``root`` of the residual's weight, and `fall_of_weight`.
    """

    pose: int
    residual: float
    cost: float
    root: float
    fall: float


@kernel
def count_block_equations(evidence: Evidence) -> int:
    """Number of the equations of all blocks."""
    count = 0
    for block in unrolled(evidence.blocks):
        count += equations_of(block)
    return count


@kernel
def write_block_row(evidence: Evidence, state: State, q: int, row: FloatArray) -> BlockEquation:
    """Write derivatives (6 + b,) of the residual of equation ``q``, block after block."""
    row[:] = 0.0
    first = 0
    found = BlockEquation(0, 0.0, 0.0, 1.0, 0.0)
    for block in unrolled(evidence.blocks):
        count = equations_of(block)
        if first <= q < first + count:
            found = write_equation(block, evidence, state, q - first, row)
        first += count
    return found


@inlined
def plain_equation(pose: int, residual: float) -> BlockEquation:
    """An equation whose residual counts by its square."""
    return BlockEquation(pose, residual, residual * residual, 1.0, 0.0)


@equations_of.of(Directions)
@inlined
def _equations_of_directions(directions: Directions) -> int:
    return 3 * int(directions.image.shape[0])


@write_equation.of(Directions)
@kernel
def _write_direction(
    directions: Directions, evidence: Evidence, state: State, q: int, row: FloatArray
) -> BlockEquation:
    """Write an equation of a direction known in a camera, such as gravity; there are three of each.

    The residual is the whitened difference of two unit vectors: its length is 2 sin(angle / 2).
    """
    d, w = q // 3, q % 3
    v = directions.image[d]
    rig = evidence.rig
    camera, pose = rig.cam_from_rig[v], state.poses[rig.pose[v]]
    rotated = turn(pose, triple(directions.model[d]))
    (x, y, z), known = turn(camera, rotated), directions.camera[d]
    whitening = triple(directions.whitening[d, w])
    row[0], row[1], row[2] = cross(rotated, turn_back(camera, whitening))
    residual = dot(whitening, (x - known[0], y - known[1], z - known[2]))
    return plain_equation(rig.pose[v], residual)


@equations_of.of(Offsets)
@inlined
def _equations_of_offsets(offsets: Offsets) -> int:
    return int(offsets.value.shape[0])


@write_equation.of(Offsets)
@kernel
def _write_offset(
    offsets: Offsets, evidence: Evidence, state: State, j: int, row: FloatArray
) -> BlockEquation:
    """Write the equation of a known distance along a direction of the model.

    A camera's place in the model's frame is ``-R' q``, with the pose (R, t), the camera's (C, c) in
    the rig and ``q = t + C' c``: along the direction d it is ``-(R d) . q``.
    """
    rig = evidence.rig
    v, weight = offsets.image[j], offsets.weight[j]
    p = 0 if v < 0 else rig.pose[v]
    value = -offsets.value[j]
    for end in range(2):
        sign = 2.0 * end - 1.0
        i = offsets.ends[j, end]
        if i < 0:
            camera, pose = rig.cam_from_rig[v], state.poses[p]
            turned = turn(pose, triple(offsets.direction[j]))
            q = shift(pose, turn_back(camera, triple(camera[9:])))
            value -= sign * dot(turned, q)
            by_turn = cross(turned, q)
            for r in range(3):
                row[r] = -sign * weight * by_turn[r]
                row[3 + r] = -sign * weight * turned[r]
            continue
        for a in range(3):
            along = sign * offsets.direction[j, a]
            if along != 0.0:
                stretched = np.exp(state.log_scales[a]) * unstretched(evidence.shape, state, i, a)
                value += along * stretched
                _add_shape(evidence.shape, state, i, a, weight * along, row)
    return plain_equation(p, value * weight)


@inlined
def _add_shape(shape: Shape, state: State, i: int, a: int, slope: float, row: FloatArray) -> None:
    """Add the derivatives by scale and modes of ``slope`` times coordinate a of point i."""
    modes = shape.modes.shape[0]
    first = row.shape[0] - modes - 3
    scale = slope * np.exp(state.log_scales[a])
    row[first + a] += scale * unstretched(shape, state, i, a)
    for k in range(modes):
        row[first + 3 + k] += scale * shape.modes[k, i, a]
