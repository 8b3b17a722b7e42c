"""Evidence of what was measured at points of a surface, and estimates with it.

What rims and lines across an outline measure at points of surfaces is evidence as any other: these
points stand between the keypoints and the box's corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.estimation.contours.surface import PosedSurface, Surface
from cadalign.estimation.estimates import poses_of
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import rotation_from_vector, vector_from_rotation
from cadalign.solvers.joint.covariance import information_of, scaled_information
from cadalign.solvers.joint.evidence import (
    Evidence,
    Shape,
    Sightings,
    State,
    log_focals_of,
    stacked,
)
from cadalign.solvers.joint.search import displaced_modes, reduced, refine_joint

OWN_MODES = 3
"""Unknowns of a contour: its offset outwards, its registration along x and along y."""
_LEAST_INFORMATION = 1e-12  # about a direction of the unknowns, relative

Shown = TypeVar("Shown")


class Measured(NamedTuple):
    """Points of a surface in one view, with their modes, and what was measured at each.

    ``mean`` (n, 3) and ``modes`` (K, n, 3) are as in `Shape`. ``sightings`` has a row for each
    point, whose number follows. ``own`` (k, n, 3) are further modes of the shape, that move these
    points alone.
    """

    mean: FloatArray
    modes: FloatArray
    sightings: Sightings
    own: FloatArray


class Place(NamedTuple):
    """A state of the evidence, and the coefficients (V, 3) of the contours' own modes.

    Steps change the directions and the logarithms of the distances of objects: where the size is
    hardly known, distance and stretch rise by one factor, which is no straight line otherwise.
    """

    state: State
    own: FloatArray

    @classmethod
    def of(cls, state: State, contours: int = 0) -> Place:
        """The place of a state, nothing known of the contours' own modes."""
        return cls(state, np.zeros((contours, OWN_MODES)))

    def towards(self, other: Place, share: float) -> Place:
        """The place a share of the way to another one."""
        a, b = self.state, other.state
        poses = a.poses.copy()
        for pose, start, end in zip(poses, a.poses, b.poses, strict=True):
            pose[9:] = shifted(start[9:], share * shift_to(start[9:], end[9:]))
            turn = end[:9].reshape(3, 3) @ start[:9].reshape(3, 3).T
            part = rotation_from_vector(share * vector_from_rotation(turn))
            pose[:9] = (part @ start[:9].reshape(3, 3)).ravel()
        rest = [x + share * (y - x) for x, y in zip(a[1:], b[1:], strict=True)]
        return Place(State(poses, *rest), self.own + share * (other.own - self.own))

    def moved(self, step: FloatArray) -> Place:
        """The place after a step (U,) of poses, focal lengths, scales and own modes."""
        state, count = self.state, len(self.state.poses)
        poses = state.poses.copy()
        ends = np.cumsum([6 * count, len(state.log_focals), 3])
        steps, focals, scales, own = np.split(step, ends)
        for pose, part in zip(poses, steps.reshape(-1, 6), strict=True):
            pose[:9] = (rotation_from_vector(part[:3]) @ pose[:9].reshape(3, 3)).ravel()
            pose[9:] = shifted(pose[9:], part[3:])
        moved = state._replace(
            poses=poses,
            log_focals=state.log_focals + focals,
            log_scales=state.log_scales + scales,
        )
        return Place(moved, self.own + own.reshape(self.own.shape))


def shifted(place: FloatArray, step: FloatArray) -> FloatArray:
    """A place (3,) after a step, whose part along the direction changes the logarithm."""
    distance = float(np.linalg.norm(place))
    if not distance > 0:
        return place + step
    direction = place / distance
    along = float(direction @ step)
    across = step - along * direction
    angle = float(np.linalg.norm(across)) / distance
    turned = np.cos(angle) * direction + np.sinc(angle / np.pi) * across / distance
    return np.asarray(distance * np.exp(along / distance) * turned)


def shift_to(place: FloatArray, other: FloatArray) -> FloatArray:
    """The step that `shifted` takes from a place to another one."""
    distance, far = float(np.linalg.norm(place)), float(np.linalg.norm(other))
    if not distance > 0 or not far > 0:
        return other - place
    direction, goal = place / distance, other / far
    across = goal - (goal @ direction) * direction
    sine = float(np.linalg.norm(across))
    angle = np.arctan2(sine, goal @ direction)
    across *= angle / sine if sine > 0 else 0.0
    return np.asarray(distance * (np.log(far / distance) * direction + across))


class Sought(NamedTuple, Generic[Shown]):
    """Evidence, of so many keypoints, and the surface that is sought in ``views``.

    These are contours of masks or photos.
    """

    evidence: Evidence
    keypoints: int
    views: list[Shown]
    surface: Surface

    def at(self, state: State) -> tuple[PosedSurface, list[Alignment]]:
        """The surface, and the alignments in all views."""
        return self.surface.at(self.evidence.shape, state), poses_of(self.evidence, state)

    def camera_at(self, image: int, camera: Camera, state: State) -> Camera:
        """The camera of view number ``image`` with the focal length of a state."""
        if self.evidence.focals.group[image] < 0:
            return camera
        ratio = float(np.exp(log_focals_of(self.evidence, state)[image]))
        return camera.with_focal(camera.fx * ratio)

    def joined(self, place: Place, rows: Sequence[Measured]) -> Joined:
        """The evidence with what was measured at a place; contours' own modes are the last ones."""
        state, first, count = place.state, self.keypoints, sum(len(each.mean) for each in rows)
        full = state._replace(
            coefficients=np.concatenate([state.coefficients, place.own.ravel()]),
            displacements=np.insert(state.displacements, [first] * count, 0.0, axis=0),
        )
        evidence = _with_measured(self.evidence, first, rows, count, place.own.size)
        return Joined(evidence, full, place, slice(first, first + count))


class Joined(NamedTuple):
    """Evidence with what was measured at points of a surface.

    The ``state`` of this evidence is that of the ``place``, with the rows ``measured`` more among
    its points.
    """

    evidence: Evidence
    state: State
    place: Place
    measured: slice

    def refined(self, iterations: int) -> tuple[float, Joined] | None:
        """The cost, and the place of the least cost, where every point of the surface stays."""
        cost, _, state = refine_joint(self.evidence, iterations, self.state)
        if not cost < np.inf:
            return None
        last = len(state.coefficients) - self.place.own.size
        bare = state._replace(
            coefficients=state.coefficients[:last],
            displacements=np.delete(state.displacements, self.measured, axis=0),
        )
        place = Place(bare, state.coefficients[last:].reshape(self.place.own.shape))
        return cost, self._replace(state=state, place=place)


def _with_measured(
    evidence: Evidence,
    keypoints: int,
    measured: Sequence[Measured],
    total: int,
    further: int,
) -> Evidence:
    """The evidence with what was measured at ``total`` points, and so many ``further`` modes.

    Contours take them in turns: each has its own, or all have the same ones.
    """
    shape, last, room = evidence.shape, len(evidence.shape.modes), [keypoints] * total
    mean = np.insert(shape.mean, room, 0.0, axis=0)
    modes = np.zeros((last + further, *mean.shape))
    modes[:last] = np.insert(shape.modes, room, 0.0, axis=1)

    def moved(points: IntArray) -> IntArray:
        return np.where(points >= keypoints, points + total, points)

    depths = evidence.image_depths
    sightings = [evidence.sightings._replace(point=moved(evidence.sightings.point))]
    first = keypoints
    for number, (points, own_modes, rows, own) in enumerate(measured):
        there = slice(first, first + len(points))
        mean[there] = points
        modes[: len(own_modes), there] = own_modes  # none for a rigid surface
        place = last + number * len(own) % further
        modes[place : place + len(own), there] = own
        sightings.append(rows._replace(point=np.arange(there.start, there.stop)))
        first = there.stop
    return evidence._replace(
        shape=Shape(mean, modes, np.insert(shape.spread, room, 0.0)),
        offsets=evidence.offsets._replace(ends=moved(evidence.offsets.ends)),
        image_depths=depths._replace(point=moved(depths.point)),
        sightings=stacked(sightings),
    )


def with_displacement_modes(evidence: Evidence, state: State) -> tuple[Evidence, State]:
    """The same with the points' own displacements as modes, which a warped surface follows."""
    shape, rows = evidence.shape, np.flatnonzero(evidence.shape.spread > 0)
    if not len(rows):
        return evidence, state
    modes = displaced_modes(shape, rows)
    moved = state.displacements[rows] / shape.spread[rows, None]
    return (
        evidence._replace(shape=Shape(shape.mean, modes, np.zeros_like(shape.spread))),
        state._replace(
            coefficients=np.concatenate([state.coefficients, moved.ravel()]),
            displacements=np.zeros_like(state.displacements),
        ),
    )


def cost_of(evidence: Evidence, state: State) -> float:
    """Cost of all evidence."""
    return information_of(*reduced(evidence, state))[0]


def solved(information: FloatArray, right: FloatArray) -> FloatArray:
    """The covariance times columns (U, k), of unknowns of which next to nothing may be known."""
    matrix, sizes = scaled_information(information)
    matrix = matrix + _LEAST_INFORMATION * np.eye(len(sizes))
    return np.asarray(np.linalg.solve(matrix, right / sizes[:, None]) / sizes[:, None])


def weakest_steps(information: FloatArray, count: int) -> list[FloatArray]:
    """Steps (U,) of one standard deviation along the directions of which least is known."""
    matrix, sizes = scaled_information(information)
    values, vectors = np.linalg.eigh(matrix)
    roots = np.sqrt(np.maximum(values[:count], _LEAST_INFORMATION))
    return list((vectors[:, :count] / roots / sizes[:, None]).T)
