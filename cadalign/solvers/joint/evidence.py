"""Evidence and state of the joint system: poses, focal lengths, log scales and shape.

A point of the object is ``x_i = diag(exp(log_scales)) @ (mean_i + sum_k c_k modes_ki + d_i)``, in
the model's frame. The coefficients c have a standard normal prior; a displacement d_i has the
standard deviation ``spread_i``. A sighting measures the ray of a point in one view, its depth
there, or both. For a contour point, only the error along the contour's normal counts. Views of a
rig share one pose through known ``cam_from_rig``; other views have their own pose. Views of one
camera share its focal length.

The order of the unknowns is: six for every pose (rotation vector applied in the rig's frame,
translation), then the border, which all views share: log focal lengths, three log scales,
coefficients. Displacements are eliminated.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.compile import inline, kernel
from cadalign.solvers.constants import ScalePrior
from cadalign.solvers.linalg import Triple

Table = TypeVar("Table", bound=tuple[Any, ...])


class Shape(NamedTuple):
    """Mean points (m, 3), modes (K, m, 3) for unit coefficients, spread (m,) of displacements."""

    mean: FloatArray
    modes: FloatArray
    spread: FloatArray


class Sightings(NamedTuple):
    """N measurements of points in images, with the indices ``point`` and ``image`` (N,).

    ``rays`` (N, 2) are normalised image coordinates, with ``whitening`` (N, 3) as in
    `KeypointEvidence`, and ``loss`` and ``loss_scale`` (N,). The columns of ``depths`` (N, 3) are
    the depth, its inverse standard deviation (0 for none), and the scale of its Cauchy loss (0 for
    the ray's loss).
    """

    point: IntArray
    image: IntArray
    rays: FloatArray
    whitening: FloatArray
    depths: FloatArray
    loss: IntArray
    loss_scale: FloatArray


class Rig(NamedTuple):
    """Cameras (V, 12), rotation row by row and translation, and the index of their pose (V,).

    A view without evidence has the pose -1. Depths are measured along ``axes`` (V, 3) of the
    camera frames.
    """

    cam_from_rig: FloatArray
    pose: IntArray
    axes: FloatArray

    @property
    def is_shared(self) -> BoolArray:
        """True for the views (V,) that share their pose with another view."""
        counts = np.bincount(self.pose[self.pose >= 0])
        return np.asarray((self.pose >= 0) & (counts[self.pose] > 1))


class Focals(NamedTuple):
    """F unknown focal lengths, as log ratios to the focal lengths that gave the rays.

    ``group`` (V,) is the index of each view's focal length, or -1. A log ratio lies between ``low``
    and ``high`` (F,), with a Gaussian prior of mean ``center`` (F,) and inverse variance ``weight``
    (F,), 0 for none.
    """

    group: IntArray
    low: FloatArray
    high: FloatArray
    center: FloatArray
    weight: FloatArray


class Directions(NamedTuple):
    """Unit vectors ``model``, ``camera`` (D, 3) in views (D,), ``whitening`` (D, 3, 3) [1/rad]."""

    model: FloatArray
    camera: FloatArray
    image: IntArray
    whitening: FloatArray


class Offsets(NamedTuple):
    """Distances ``value`` (L,) between two points, along a ``direction`` (L, 3) of the model.

    ``ends`` (L, 2) are indices of points, or -1 for the center of the camera ``image`` (L,).
    Without a camera, ``image`` is -1. ``weight`` (L,) is the inverse standard deviation.
    """

    ends: IntArray
    image: IntArray
    direction: FloatArray
    value: FloatArray
    weight: FloatArray


class ScalePriors(NamedTuple):
    """Priors of log scales; ``free`` (3,) is 1 for an estimated one, 0 for a fixed one.

    ``precision`` (3, 3) is the inverse covariance of a Gaussian. ``bound`` is a prior on each log
    scale, or, if all three are free, on its difference from their mean.
    """

    free: FloatArray
    precision: FloatArray
    bound: ScalePrior


class Evidence(NamedTuple):
    """All evidence and priors of one object.

    ``blocks`` are tables of further evidence, at most one of each type, `Directions` and `Offsets`
    first; `cadalign.solvers.joint.rows` defines a block.
    """

    shape: Shape
    sightings: Sightings
    rig: Rig
    focals: Focals
    scales: ScalePriors
    blocks: tuple[Any, ...]

    @property
    def directions(self) -> Directions:
        return cast(Directions, self.blocks[0])

    @property
    def offsets(self) -> Offsets:
        return cast(Offsets, self.blocks[1])

    def add_block(self, block: Any) -> Evidence:
        """Replace the block of the same type, or append a block of a new type."""
        kinds = [type(each) for each in self.blocks]
        if type(block) not in kinds:
            return self._replace(blocks=(*self.blocks, block))
        place = kinds.index(type(block))
        return self._replace(blocks=(*self.blocks[:place], block, *self.blocks[place + 1 :]))


class State(NamedTuple):
    """Poses (P, 12), log focals (F,), log scales (3,), coefficients (K,), displacements (m, 3)."""

    poses: FloatArray
    log_focals: FloatArray
    log_scales: FloatArray
    coefficients: FloatArray
    displacements: FloatArray


@kernel
def unpack_state(shape: Shape, focals: int, row: FloatArray) -> State:
    """Views of the parts of a packed state."""
    modes, points = shape.modes.shape[0], shape.mean.shape[0]
    a = row.shape[0] - 3 * points
    b = a - modes
    c = b - 3
    d = c - focals
    return State(
        row[:d].reshape((d // 12, 12)), row[d:c], row[c:b], row[b:a], row[a:].reshape((points, 3))
    )


@kernel
def remove_displacements(state: State) -> State:
    still = np.zeros_like(state.displacements)
    return State(state.poses, state.log_focals, state.log_scales, state.coefficients.copy(), still)


def kept_rows(table: Table, kept: BoolArray | IntArray) -> Table:
    """Select rows of a table of columns, such as `Sightings`."""
    columns: list[Any] = [np.ascontiguousarray(column[kept]) for column in table]
    return type(table)(*columns)


def stack_tables(tables: Sequence[Table]) -> Table:
    """Concatenate tables of the same type."""
    return type(tables[0])(*map(np.concatenate, zip(*tables, strict=True)))


def pack(state: State) -> FloatArray:
    return np.concatenate([np.ravel(part) for part in state])


def log_focals_of(evidence: Evidence, state: State) -> FloatArray:
    """Log ratio (V,) of each view's focal length to its rays'; 0 if the focal length is known."""
    return np.append(state.log_focals, 0.0)[evidence.focals.group]  # group -1 takes the last


def distances_of(evidence: Evidence, poses: FloatArray, points: FloatArray) -> FloatArray:
    """Distances (L,) that poses (P, 12) and points (m, 3) predict for the offsets."""
    offsets, rig = evidence.offsets, evidence.rig
    cameras, pose = rig.cam_from_rig[offsets.image], poses[rig.pose[offsets.image]]
    turned = np.einsum("lji,lj->li", cameras[:, :9].reshape(-1, 3, 3), cameras[:, 9:])
    in_model = -np.einsum("lji,lj->li", pose[:, :9].reshape(-1, 3, 3), pose[:, 9:] + turned)
    places = np.where((offsets.ends < 0)[:, :, None], in_model[:, None], points[offsets.ends])
    return np.asarray(((places[:, 1] - places[:, 0]) * offsets.direction).sum(axis=1))


def points_of(shape: Shape, state: State) -> FloatArray:
    """Points (m, 3) of a shape in the model's frame."""
    varied = np.tensordot(state.coefficients, shape.modes, 1)
    return np.asarray(np.exp(state.log_scales) * (shape.mean + state.displacements + varied))


def seen_in_cameras(
    evidence: Evidence, poses: FloatArray, points: FloatArray, image: IntArray
) -> FloatArray:
    """Transform model points (N, 3) to the cameras of views ``image`` (N,), by poses (P, 12)."""
    rig = evidence.rig
    for motion in (poses[rig.pose[image]], rig.cam_from_rig[image]):
        turned = np.einsum("nij,nj->ni", motion[:, :9].reshape(-1, 3, 3), points)
        points = turned + motion[:, 9:]
    return points


def depths_along_axes(
    evidence: Evidence, poses: FloatArray, points: FloatArray, image: IntArray
) -> FloatArray:
    """Depths (N,) along the rig's axes; parameters as for `seen_in_cameras`."""
    seen = seen_in_cameras(evidence, poses, points, image)
    return np.asarray((seen * evidence.rig.axes[image]).sum(axis=1))


@inline
def exp_triple(logs: FloatArray) -> Triple:
    return np.exp(logs[0]), np.exp(logs[1]), np.exp(logs[2])


@inline
def stretched_point(shape: Shape, state: State, scale: Triple, i: int) -> Triple:
    return (
        scale[0] * coordinate_of(shape, state, i, 0),
        scale[1] * coordinate_of(shape, state, i, 1),
        scale[2] * coordinate_of(shape, state, i, 2),
    )


@inline
def coordinate_of(shape: Shape, state: State, i: int, a: int) -> float:
    """Coordinate a of point i before the stretch."""
    value = shape.mean[i, a] + state.displacements[i, a]
    for k in range(shape.modes.shape[0]):
        value += state.coefficients[k] * shape.modes[k, i, a]
    return float(value)
