"""Points of surfaces as evidence: what rims and depth images measure at points of the shape.

These stand between the keypoints and the box's corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.solvers.joint.evidence import Evidence, Planes, Shape, Sightings, State


class PointRows(NamedTuple):
    """Mean (n, 3) and modes (K, n, 3) of points of a surface, as in `Shape`."""

    mean: FloatArray
    modes: FloatArray


class Measured(NamedTuple):
    """Points of a surface in one view, and what was measured at each.

    ``table`` has a row for each point, whose number follows. ``own`` (k, n, 3) are further modes of
    the shape, that move these points alone.
    """

    points: PointRows
    table: Sightings | Planes
    own: FloatArray | None = None


def count_of(measured: Sequence[Measured]) -> int:
    """Number of points of all views."""
    return sum(len(each.points.mean) for each in measured)


def with_measured(evidence: Evidence, keypoints: int, measured: Sequence[Measured]) -> Evidence:
    """The evidence with what was measured at points of surfaces.

    Modes that move the points of one view alone are the last ones, in the order of the views.
    """
    shape, total = evidence.shape, count_of(measured)
    last = len(shape.modes)
    further = sum(len(each.own) for each in measured if each.own is not None)
    end = keypoints + total
    mean = np.concatenate([shape.mean[:keypoints], np.zeros((total, 3)), shape.mean[keypoints:]])
    modes = np.zeros((last + further, len(mean), 3))
    modes[:last, :keypoints] = shape.modes[:, :keypoints]
    modes[:last, end:] = shape.modes[:, keypoints:]

    def moved(points: IntArray) -> IntArray:
        return np.where(points >= keypoints, points + total, points)

    tables: dict[str, list[Any]] = {
        name: [table._replace(point=moved(table.point))]
        for name, table in (("sightings", evidence.sightings), ("planes", evidence.planes))
    }
    first = keypoints
    for points, table, own in measured:
        there = slice(first, first + len(points.mean))
        mean[there] = points.mean
        modes[: len(points.modes), there] = points.modes  # none for a rigid surface
        if own is not None:
            modes[last : last + len(own), there] = own
            last += len(own)
        name = "sightings" if isinstance(table, Sightings) else "planes"
        tables[name].append(table._replace(point=np.arange(there.start, there.stop)))
        first = there.stop
    spread = np.concatenate([shape.spread[:keypoints], np.zeros(total), shape.spread[keypoints:]])
    return evidence._replace(
        shape=Shape(mean, modes, spread),
        offsets=evidence.offsets._replace(ends=moved(evidence.offsets.ends)),
        **{
            name: type(parts[0])(*map(np.concatenate, zip(*parts, strict=True)))
            for name, parts in tables.items()
        },
    )


def state_with_points(
    state: State, keypoints: int, total: int, more: FloatArray | None = None
) -> State:
    """A copy of a state for evidence with ``total`` more points, see `with_measured`.

    ``more`` are the coefficients of modes that move these alone.
    """
    still = state.displacements
    coefficients = [state.coefficients, np.empty(0) if more is None else more]
    return State(
        state.poses.copy(),
        state.log_focals.copy(),
        state.log_scales.copy(),
        np.concatenate(coefficients),
        np.concatenate([still[:keypoints], np.zeros((total, 3)), still[keypoints:]]),
    )


def state_without_points(
    state: State, keypoints: int, total: int, modes: int = 0
) -> tuple[State, FloatArray]:
    """Invert `state_with_points`: the state without ``total`` points, and the ``modes`` of these.

    The coefficients of modes that move them alone are (modes,).
    """
    still, own = state.displacements, len(state.coefficients) - modes
    bare = state._replace(
        coefficients=state.coefficients[:own].copy(),
        displacements=np.concatenate([still[:keypoints], still[keypoints + total :]]),
    )
    return bare, state.coefficients[own:].copy()


def with_displacement_modes(evidence: Evidence, state: State) -> tuple[Evidence, State]:
    """The same with the points' own displacements as modes, which a warped surface follows."""
    shape = evidence.shape
    rows = np.repeat(np.flatnonzero(shape.spread > 0), 3)
    if not len(rows):
        return evidence, state
    axes = np.tile(np.arange(3), len(rows) // 3)
    own = np.zeros((len(rows), *shape.mean.shape))
    own[np.arange(len(rows)), rows, axes] = shape.spread[rows]
    moved = state.displacements[rows, axes] / shape.spread[rows]
    return (
        evidence._replace(
            shape=Shape(shape.mean, np.concatenate([shape.modes, own]), np.zeros_like(shape.spread))
        ),
        state._replace(
            coefficients=np.concatenate([state.coefficients, moved]),
            displacements=np.zeros_like(state.displacements),
        ),
    )
