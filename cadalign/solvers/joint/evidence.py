"""Joint estimation of poses, log scales, focal lengths and shape from everything that is known.

A point of the object is ``x_i = diag(exp(log_scales)) @ (mean_i + sum_k c_k modes_ki + d_i)``, in
the model's frame. The coefficients c have a standard normal prior, a displacement d_i has the
standard deviation ``spread_i``. A sighting of a point is its ray in one view, its depth there, or
both; a contour point is one whose ray counts along the contour's normal only. Views share one pose
through known ``cam_from_rig``, or have one each; views of one camera share its focal length.

The unknowns stand in this order: six for every pose (a rotation vector applied in the rig's frame,
the translation), then the border that all views share: log focal lengths, three log scales, the
coefficients. Displacements are eliminated.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.compile import inlined, kernel
from cadalign.solvers.constants import ScalePrior
from cadalign.solvers.linalg import Triple

Table = TypeVar("Table", bound=tuple[Any, ...])


class Shape(NamedTuple):
    """Mean (m, 3) of the points, modes (K, m, 3) of unit deviation, displacements' spread (m,)."""

    mean: FloatArray
    modes: FloatArray
    spread: FloatArray


class Sightings(NamedTuple):
    """Measurements of points in images, N of them, numbered by ``point`` and ``image`` (N,).

    ``rays`` (N, 2) are normalised, with ``whitening`` (N, 3) as in `KeypointEvidence`; ``depths``
    (N, 3) are depths, inverse deviations, 0 where there is none, and scales of Cauchy's loss, 0 for
    that of the ray. ``loss``, ``loss_scale`` (N,) are those of each residual's length.
    """

    point: IntArray
    image: IntArray
    rays: FloatArray
    whitening: FloatArray
    depths: FloatArray
    loss: IntArray
    loss_scale: FloatArray


class Rig(NamedTuple):
    """Cameras (V, 12), rotation row by row and translation, and the pose (V,) each belongs to.

    The pose of a view without evidence is -1. Depths are along the ``axes`` (V, 3) in the cameras.
    """

    cam_from_rig: FloatArray
    pose: IntArray
    axes: FloatArray

    @property
    def is_shared(self) -> BoolArray:
        """True for the views (V,) whose pose is that of other views, too."""
        counts = np.bincount(self.pose[self.pose >= 0])
        return np.asarray((self.pose >= 0) & (counts[self.pose] > 1))


class Focals(NamedTuple):
    """F focal lengths to estimate, relative to the rays'; ``group`` (V,) is each view's, or -1.

    Logarithms lie between ``low`` and ``high`` (F,), with a Gaussian prior of mean ``center`` (F,)
    and inverse variance ``weight`` (F,), 0 for none.
    """

    group: IntArray
    low: FloatArray
    high: FloatArray
    center: FloatArray
    weight: FloatArray


class Directions(NamedTuple):
    """Unit vectors ``model`` and ``camera`` (D, 3) in views, ``whitening`` (D, 3, 3) [1/rad]."""

    model: FloatArray
    camera: FloatArray
    image: IntArray
    whitening: FloatArray


class Offsets(NamedTuple):
    """Distances ``value`` (L,) along a ``direction`` (L, 3) of the model between two of its points.

    ``ends`` (L, 2) numbers these, -1 for the place of the camera ``image`` (L,), -1 where there is
    none. ``weight`` (L,) is the inverse standard deviation.
    """

    ends: IntArray
    image: IntArray
    direction: FloatArray
    value: FloatArray
    weight: FloatArray


class ScalePriors(NamedTuple):
    """Log scales: 1 in ``free`` (3,) where estimated, and their priors.

    ``precision`` (3, 3) is the inverse covariance of a Gaussian, and ``bound`` the prior on each of
    them; where all are free, on each about their mean.
    """

    free: FloatArray
    precision: FloatArray
    bound: ScalePrior


class Evidence(NamedTuple):
    """Everything that is known about one object.

    The ``blocks`` are tables of evidence beside sightings, one of a kind, those of directions and
    offsets first; `cadalign.solvers.joint.rows` says what a block is.
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

    def with_block(self, block: Any) -> Evidence:
        """The evidence with a block in the place of that of its kind, or as one more."""
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
    """The parts of a state that is a row of numbers; they share its memory."""
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
    """Some rows of a table of columns, such as `Sightings`."""
    columns: list[Any] = [np.ascontiguousarray(column[kept]) for column in table]
    return type(table)(*columns)


def stack_tables(tables: Sequence[Table]) -> Table:
    """The rows of all tables, one after the other."""
    return type(tables[0])(*map(np.concatenate, zip(*tables, strict=True)))


def packed(state: State) -> FloatArray:
    return np.concatenate([np.ravel(part) for part in state])


def log_focals_of(evidence: Evidence, state: State) -> FloatArray:
    """Log focal length (V,) of every view over that of its rays; 0 where it is known."""
    return np.append(state.log_focals, 0.0)[evidence.focals.group]  # the last, for -1


def distances_of(evidence: Evidence, poses: FloatArray, points: FloatArray) -> FloatArray:
    """Distances (L,) of the evidence's offsets, under poses (P, 12) of the points (m, 3)."""
    offsets, rig = evidence.offsets, evidence.rig
    cameras, pose = rig.cam_from_rig[offsets.image], poses[rig.pose[offsets.image]]
    turned = np.einsum("lji,lj->li", cameras[:, :9].reshape(-1, 3, 3), cameras[:, 9:])
    in_model = -np.einsum("lji,lj->li", pose[:, :9].reshape(-1, 3, 3), pose[:, 9:] + turned)
    places = np.where((offsets.ends < 0)[:, :, None], in_model[:, None], points[offsets.ends])
    return np.asarray(((places[:, 1] - places[:, 0]) * offsets.direction).sum(axis=1))


def points_of(shape: Shape, state: State) -> FloatArray:
    """The points (m, 3) in the model's frame."""
    varied = np.tensordot(state.coefficients, shape.modes, 1)
    return np.asarray(np.exp(state.log_scales) * (shape.mean + state.displacements + varied))


def seen_in_cameras(
    evidence: Evidence, poses: FloatArray, points: FloatArray, image: IntArray
) -> FloatArray:
    """Points (N, 3) of the model in the cameras (N,) of views, under poses (P, 12)."""
    rig = evidence.rig
    for motion in (poses[rig.pose[image]], rig.cam_from_rig[image]):
        turned = np.einsum("nij,nj->ni", motion[:, :9].reshape(-1, 3, 3), points)
        points = turned + motion[:, 9:]
    return points


def depths_along_axes(
    evidence: Evidence, poses: FloatArray, points: FloatArray, image: IntArray
) -> FloatArray:
    """Depths (N,) of points as `seen_in_cameras` takes them."""
    seen = seen_in_cameras(evidence, poses, points, image)
    return np.asarray((seen * evidence.rig.axes[image]).sum(axis=1))


@inlined
def exp_of(logs: FloatArray) -> Triple:
    return np.exp(logs[0]), np.exp(logs[1]), np.exp(logs[2])


@inlined
def stretched_point(shape: Shape, state: State, scale: Triple, i: int) -> Triple:
    """Point i in the model's frame."""
    return (
        scale[0] * unstretched(shape, state, i, 0),
        scale[1] * unstretched(shape, state, i, 1),
        scale[2] * unstretched(shape, state, i, 2),
    )


@inlined
def unstretched(shape: Shape, state: State, i: int, a: int) -> float:
    """Coordinate a of point i before the stretch."""
    value = shape.mean[i, a] + state.displacements[i, a]
    for k in range(shape.modes.shape[0]):
        value += state.coefficients[k] * shape.modes[k, i, a]
    return float(value)
