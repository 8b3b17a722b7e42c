"""Evidence with the rows of outlines, and states with the unknowns of these.

What is measured at points of a surface is evidence as any other: these points stand between the
keypoints and the box's corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.estimation.contours.contour import Sight
from cadalign.estimation.contours.outline import (
    REGISTRATION,
    Noise,
    Outline,
    OutlineSource,
    Track,
)
from cadalign.estimation.contours.surface import PosedSurface, Surface
from cadalign.estimation.estimates import poses_of
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.solvers.constants import CAUCHY
from cadalign.solvers.joint.covariance import scaled_information
from cadalign.solvers.joint.evidence import (
    Evidence,
    Shape,
    Sightings,
    State,
    log_focals_of,
    stacked,
)
from cadalign.solvers.joint.search import displaced_modes, objective_of, refine_joint

OWN_MODES = 3
"""Unknowns of a contour: its offset outwards, its registration along x and along y."""
_LEAST_INFORMATION = 1e-12  # about a direction of the unknowns, relative


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
    along = float(direction @ step) / distance
    across = place + step - along * place
    return np.asarray(distance * np.exp(along) * across / np.linalg.norm(across))


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


class OutlineRows(NamedTuple):
    """Points of a surface in one view, with their modes, and what was measured at each.

    ``mean`` (n, 3) and ``modes`` (K, n, 3) are as in `Shape`. ``sightings`` has a row for each
    point. ``own`` (3, n, 3) are the contour's own modes, which move these points alone.
    """

    mean: FloatArray
    modes: FloatArray
    sightings: Sightings
    own: FloatArray


class PosedOutlines(NamedTuple):
    """The outlines of a surface at a place: its sights in the views, and what these measure."""

    place: Place
    posed: PosedSurface
    sights: list[Sight]
    outlines: list[Outline | None]


class Augmented(NamedTuple):
    """Evidence with rows of outlines.

    The ``state`` of this evidence is that of the ``place``, with so many points more as ``rows``
    have.
    """

    evidence: Evidence
    state: State
    place: Place
    rows: list[OutlineRows | None]
    points: slice

    @property
    def objective(self) -> float:
        """-2 log likelihood, up to a constant of the noise."""
        return objective_of(self.evidence, self.state)

    def refined(self, iterations: int) -> Augmented | None:
        """The place of the least objective, where every point of the surface stays."""
        least, _, state = refine_joint(self.evidence, iterations, self.state)
        if not least < np.inf:
            return None
        last = len(state.coefficients) - self.place.own.size
        bare = state._replace(
            coefficients=state.coefficients[:last],
            displacements=np.delete(state.displacements, self.points, axis=0),
        )
        place = Place(bare, state.coefficients[last:].reshape(self.place.own.shape))
        return self._replace(state=state, place=place)


class ContourProblem(NamedTuple):
    """Evidence, of so many keypoints, and the surface whose outline ``sources`` measure."""

    evidence: Evidence
    keypoints: int
    sources: Sequence[OutlineSource]
    surface: Surface

    @property
    def is_comparable(self) -> bool:
        """True if costs at several places compare."""
        return all(source.is_comparable for source in self.sources)

    @property
    def learning(self) -> IntArray:
        """Numbers of the sources that learn their offset."""
        return np.flatnonzero([source.learns_offset for source in self.sources])

    def camera_at(self, source: OutlineSource, state: State) -> Camera:
        """The camera of a source with the focal length of a state."""
        image, camera = source.image, source.camera
        if self.evidence.focals.group[image] < 0:
            return camera
        ratio = float(np.exp(log_focals_of(self.evidence, state)[image]))
        return camera.with_focal(camera.fx * ratio)

    def look(self, place: Place, tracks: Sequence[Track]) -> PosedOutlines:
        """Measure the outlines at a place."""
        posed = self.surface.at(self.evidence.shape, place.state)
        poses, sights, outlines = poses_of(self.evidence, place.state), [], []
        for source, track, own in zip(self.sources, tracks, place.own, strict=True):
            camera = self.camera_at(source, place.state)
            right, down = (REGISTRATION * own[1:]).tolist()
            camera = replace(camera, cx=camera.cx + right, cy=camera.cy + down)
            sights.append(Sight(posed.caster, camera, poses[source.image]))
            outlines.append(source.outline(sights[-1], posed, track))
        return PosedOutlines(place, posed, sights, outlines)

    def augmented(self, look: PosedOutlines, tracks: Sequence[Track]) -> Augmented | None:
        """The evidence with what was measured; None where there is nothing."""
        rows = [
            outline and rows_of(source, outline, track.noise, look.posed, sight)
            for source, outline, track, sight in zip(
                self.sources, look.outlines, tracks, look.sights, strict=True
            )
        ]
        total = sum(len(each.mean) for each in rows if each is not None)
        if not total:
            return None
        state, first = look.place.state, self.keypoints
        full = state._replace(
            coefficients=np.concatenate([state.coefficients, look.place.own.ravel()]),
            displacements=_with_room(state.displacements, first, total),
        )
        evidence = _with_rows(self.evidence, first, rows, total)
        return Augmented(evidence, full, look.place, rows, slice(first, first + total))


def rows_of(
    source: OutlineSource, outline: Outline, noise: Noise, surface: PosedSurface, sight: Sight
) -> OutlineRows:
    """The samples of an outline that were found, in the form of the evidence.

    At the state of the ``sight`` the residuals are the distances that were found, whatever the
    normals are. The contour's own modes move its points outwards, to the right and down.
    """
    kept = np.flatnonzero(outline.found)
    points, across, count = outline.points[kept], outline.across[kept], len(kept)
    given, camera = source.camera, sight.camera
    focal, root = np.array([given.fx, given.fy]), np.sqrt(noise.correlation)
    step = across / (across**2).sum(axis=1, keepdims=True)
    seen, ratio = sight.pose.apply(points), camera.fx / given.fx
    rays = ratio * seen[:, :2] / seen[:, 2:]
    rays += np.subtract((camera.cx, camera.cy), (given.cx, given.cy)) / focal
    rays += outline.places[kept, None] * step
    moved = np.zeros((OWN_MODES, count, 3))
    moved[0, :, :2] = noise.offset * step
    for axis in range(2):
        moved[1 + axis, :, axis] = REGISTRATION / focal[axis]
    moved *= seen[:, 2:] / ratio
    weights = 1 / (noise.sigma * outline.sigmas[kept] * root)
    return OutlineRows(
        *surface.rows(points, outline.face[kept]),
        Sightings(
            np.arange(count),
            np.full(count, source.image),
            rays,
            np.column_stack([across * weights[:, None], np.zeros(count)]),
            np.zeros((count, 3)),
            np.full(count, CAUCHY),
            np.full(count, noise.loss_scale / root),
            np.zeros((count, 2)),
        ),
        moved @ sight.pose.rotation / sight.pose.scale,
    )


def _with_rows(
    evidence: Evidence, keypoints: int, measured: Sequence[OutlineRows | None], total: int
) -> Evidence:
    """The evidence with what was measured at ``total`` points, and the contours' own modes."""
    shape, last = evidence.shape, len(evidence.shape.modes)
    mean = _with_room(shape.mean, keypoints, total)
    modes = np.zeros((last + OWN_MODES * len(measured), *mean.shape))
    modes[:last, :keypoints] = shape.modes[:, :keypoints]
    modes[:last, keypoints + total :] = shape.modes[:, keypoints:]

    def moved(points: IntArray) -> IntArray:
        return np.where(points >= keypoints, points + total, points)

    offsets = evidence.offsets
    sightings = [evidence.sightings._replace(point=moved(evidence.sightings.point))]
    first = keypoints
    for number, rows in enumerate(measured):
        if rows is None:
            continue
        there, place = slice(first, first + len(rows.mean)), last + OWN_MODES * number
        mean[there] = rows.mean
        modes[: len(rows.modes), there] = rows.modes  # none for a rigid surface
        modes[place : place + OWN_MODES, there] = rows.own
        sightings.append(rows.sightings._replace(point=np.arange(there.start, there.stop)))
        first = there.stop
    whole = evidence._replace(
        shape=Shape(mean, modes, _with_room(shape.spread, keypoints, total)),
        sightings=stacked(sightings),
    )
    return whole.with_block(offsets._replace(ends=moved(offsets.ends)))


def _with_room(rows: FloatArray, first: int, count: int) -> FloatArray:
    """Rows (m, ...) with ``count`` rows of zeros before that of number ``first``."""
    return np.concatenate([rows[:first], np.zeros((count, *rows.shape[1:])), rows[first:]])


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
