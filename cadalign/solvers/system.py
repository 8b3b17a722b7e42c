"""The interface of systems of unknowns: what refinement and search ask of each.

A system is a NamedTuple of all that is known about one object: evidence and priors. A state of it
is a row of numbers (D,), whose layout the system knows; a step is one of its unknowns (U,). Each of
the functions here is a family of kernels with a member for each system, in that system's module:

=========================  =====================================================================
`alignment.Objective`       pose and stretch from the keypoints of one view
`focal.FocalObjective`      the same, and the focal length
`marginal.equations.Posed`  a pose, the shape integrated out
`joint.system.Joint`        poses, scales, focal lengths and shape from all evidence
=========================  =====================================================================

Costs are -2 log of a likelihood times a prior, up to a constant; equations hold half the cost's
gradient, J' W r, and its Gauss-Newton matrix, J' W J. A cost is infinite behind a camera.
"""

from __future__ import annotations

from typing import Any

from cadalign.arrays import FloatArray
from cadalign.compile import KernelFamily


@KernelFamily
def room_of(system: Any) -> Any:
    """Room for the equations that steps are from and for those of a trial, which take turns.

    Their ``gradient`` has one entry for each unknown. They may share scratch space.
    """
    raise NotImplementedError


@KernelFamily
def evaluate(system: Any, state: FloatArray, equations: Any) -> float:
    """Write the normal equations at a proposed state; returns the cost."""
    raise NotImplementedError


@KernelFamily
def cost_at(system: Any, state: FloatArray) -> float:
    """The cost at a state, without derivatives."""
    raise NotImplementedError


@KernelFamily
def solve(system: Any, equations: Any, damping: float, step: FloatArray) -> float:
    """Write the damped Gauss-Newton step.

    Returns the decrease of the cost that the equations predict for it, NaN where they have no
    solution.
    """
    raise NotImplementedError


@KernelFamily
def move(
    system: Any,
    state: FloatArray,
    equations: Any,
    damping: float,
    step: FloatArray,
    moved: FloatArray,
) -> None:
    """Write the state that a step leads to; what the equations eliminate follows it."""
    raise NotImplementedError


@KernelFamily
def score_of(system: Any, state: FloatArray, cost: float) -> float:
    """-2 log of the evidence by Laplace's approximation, up to a constant.

    Infinite where the unknowns are not determined; ``cost`` where the system ranks by cost.
    """
    raise NotImplementedError


@KernelFamily
def are_same(system: Any, first: FloatArray, second: FloatArray) -> bool:
    """True if two states lie at the same minimum."""
    raise NotImplementedError


@KernelFamily
def is_estimate(system: Any, state: FloatArray) -> bool:
    """False for a state that no object has, such as one whose scales ran off to zero."""
    raise NotImplementedError


@KernelFamily
def integrating(system: Any, integrates: bool) -> Any:
    """The system with the shape integrated out of its objective, or with that of the cost alone.

    Systems that have no shape have no member.
    """
    raise NotImplementedError
