"""Rims as points of the shape, so that the joint kernels take them as contour sightings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.solvers.joint.evidence import Evidence, Shape, Sightings, State


class RimRows(NamedTuple):
    """Rims of one view that count: N points of the shape, each with its sighting.

    ``mean`` (N, 3) and ``modes`` (K, N, 3) as in `Shape`; ``offset_mode`` (N, 3) moves every rim
    outwards by one deviation of the offset that all of the contour has in common. ``rays`` (N, 2),
    ``whitening`` (N, 3), ``loss`` (N,) and ``loss_scale`` (N,) as in `Sightings`.
    """

    image: int
    mean: FloatArray
    modes: FloatArray
    offset_mode: FloatArray
    rays: FloatArray
    whitening: FloatArray
    loss: IntArray
    loss_scale: FloatArray


def with_points(
    evidence: Evidence, keypoints: int, mean: FloatArray, modes: FloatArray
) -> Evidence:
    """The evidence with more points (N, 3), between the keypoints and the box's corners.

    Of their ``modes`` (K, N, 3) the first are the shape's; further ones move them alone.
    """
    shape, total = evidence.shape, len(mean)
    all_modes = np.zeros((len(modes), len(shape.mean) + total, 3))
    own = all_modes[: len(shape.modes)]
    own[:, :keypoints] = shape.modes[:, :keypoints]
    own[:, keypoints + total :] = shape.modes[:, keypoints:]
    all_modes[:, keypoints : keypoints + total] = modes
    sightings, lengths = evidence.sightings, evidence.lengths
    heights, planes = evidence.heights, evidence.planes
    return evidence._replace(
        shape=Shape(
            np.concatenate([shape.mean[:keypoints], mean, shape.mean[keypoints:]]),
            all_modes,
            np.concatenate([shape.spread[:keypoints], np.zeros(total), shape.spread[keypoints:]]),
        ),
        sightings=sightings._replace(point=_moved(sightings.point, keypoints, total)),
        lengths=lengths._replace(points=_moved(lengths.points, keypoints, total)),
        heights=heights._replace(point=_moved(heights.point, keypoints, total)),
        planes=planes._replace(point=_moved(planes.point, keypoints, total)),
    )


def with_rims(evidence: Evidence, keypoints: int, rims: list[RimRows]) -> Evidence:
    """The evidence with rims; their points stand between the keypoints and the box's corners.

    Each view's rims have one more mode, the last ones of the shape in the order of the views.
    """
    own, views = len(evidence.shape.modes), len(rims)
    total = count_of(rims)
    modes = np.zeros((own + views, total, 3))
    start = 0
    for number, each in enumerate(rims):
        end = start + len(each.mean)
        modes[: len(each.modes), start:end] = each.modes  # none for a rigid surface
        modes[own + number, start:end] = each.offset_mode
        start = end
    mean = np.concatenate([np.empty((0, 3)), *(each.mean for each in rims)])
    extended = with_points(evidence, keypoints, mean, modes)
    old = extended.sightings
    sightings = Sightings(
        np.concatenate([old.point, keypoints + np.arange(total)]),
        np.concatenate([old.image, *(np.full(len(each.mean), each.image) for each in rims)]),
        np.concatenate([old.rays, *(each.rays for each in rims)]),
        np.concatenate([old.whitening, *(each.whitening for each in rims)]),
        np.concatenate([old.depths, np.zeros((total, 2))]),
        np.concatenate([old.loss, *(each.loss for each in rims)]),
        np.concatenate([old.loss_scale, *(each.loss_scale for each in rims)]),
    )
    return extended._replace(sightings=sightings)


def _moved(rows: IntArray, keypoints: int, total: int) -> IntArray:
    """Numbers of points when others are put behind the keypoints."""
    return np.where(rows >= keypoints, rows + total, rows)


def with_displacement_modes(evidence: Evidence, state: State) -> tuple[Evidence, State]:
    """The same with the points' own displacements as modes, which a warped surface follows."""
    shape = evidence.shape
    rows = np.repeat(np.flatnonzero(shape.spread > 0), 3)
    if not len(rows):
        return evidence, state
    axes = np.tile(np.arange(3), len(rows) // 3)
    own = np.zeros((len(rows), *shape.mean.shape))
    own[np.arange(len(rows)), rows, axes] = shape.spread[rows]
    moved = state.displacements[rows, axes] / np.exp(state.log_scales)[axes] / shape.spread[rows]
    return (
        evidence._replace(
            shape=Shape(shape.mean, np.concatenate([shape.modes, own]), np.zeros_like(shape.spread))
        ),
        state._replace(
            coefficients=np.concatenate([state.coefficients, moved]),
            displacements=np.zeros_like(state.displacements),
        ),
    )


def state_with_points(
    state: State, keypoints: int, total: int, more: FloatArray | None = None
) -> State:
    """A copy of a state for evidence with ``total`` more points, see `with_points`.

    ``more`` are the coefficients of modes that move these alone.
    """
    still = state.displacements
    coefficients = [state.coefficients, np.empty(0) if more is None else more]
    return State(
        state.poses.copy(),
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


def count_of(rims: list[RimRows]) -> int:
    """Number of rims of all views."""
    return sum(len(each.mean) for each in rims)
