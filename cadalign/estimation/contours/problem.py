"""Evidence with the rows of outlines at a state.

What is measured at points of a surface is evidence as any other: these points stand between the
keypoints and the box's corners. The contours' own modes are the shape's last.
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
from cadalign.solvers.constants import CAUCHY
from cadalign.solvers.joint.evidence import (
    Evidence,
    Shape,
    Sightings,
    State,
    log_focals_of,
    stacked,
)
from cadalign.solvers.joint.search import displaced_modes

OWN_MODES = 3
"""Unknowns of a contour: its offset outwards, its registration along x and along y."""


class OutlineProblem(NamedTuple):
    """Evidence of so many ``keypoints``, and the surface whose outline ``sources`` measure."""

    evidence: Evidence
    keypoints: int
    sources: Sequence[OutlineSource]
    surface: Surface

    @classmethod
    def of(
        cls,
        evidence: Evidence,
        state: State,
        keypoints: int,
        sources: Sequence[OutlineSource],
        surface: Surface,
    ) -> tuple[OutlineProblem, State]:
        evidence, state = with_displacement_modes(evidence, state)
        shape, own = evidence.shape, np.zeros(OWN_MODES * len(sources))
        modes = np.concatenate([shape.modes, np.zeros((len(own), *shape.mean.shape))])
        with_own = evidence._replace(shape=shape._replace(modes=modes))
        start = state._replace(coefficients=np.append(state.coefficients, own))
        return cls(with_own, keypoints, sources, surface), start

    def own_of(self, state: State) -> FloatArray:
        """Coefficients (V, 3) of the contours' own modes."""
        count = OWN_MODES * len(self.sources)
        return state.coefficients[-count:].reshape(-1, OWN_MODES)

    def offsets(self, state: State, tracks: Sequence[Track]) -> list[float]:
        own = self.own_of(state)[:, 0].tolist()
        return [each * track.noise.offset for each, track in zip(own, tracks, strict=True)]

    def sights(self, state: State, posed: PosedSurface) -> list[Sight]:
        """The posed surface as the sources see it, with focal lengths and registrations."""
        ratios = np.exp(log_focals_of(self.evidence, state)).tolist()
        poses, found = poses_of(self.evidence, state), []
        for source, own in zip(self.sources, self.own_of(state), strict=True):
            camera, ratio = source.camera, ratios[source.image]
            if ratio != 1.0:
                camera = camera.with_focal(camera.fx * ratio)
            right, down = (REGISTRATION * own[1:]).tolist()
            camera = replace(camera, cx=camera.cx + right, cy=camera.cy + down)
            found.append(Sight(posed.caster, camera, poses[source.image]))
        return found

    def with_outlines(
        self,
        state: State,
        posed: PosedSurface,
        sights: Sequence[Sight],
        outlines: Sequence[Outline | None],
        tracks: Sequence[Track],
    ) -> tuple[Evidence, State] | None:
        """The evidence and its state with what was measured; None where there is nothing."""
        rows = [
            self._rows_of(number, outline, track.noise, posed, sight)
            for number, (outline, track, sight) in enumerate(
                zip(outlines, tracks, sights, strict=True)
            )
            if outline is not None and outline.found.any()
        ]
        if not rows:
            return None
        shape, first = self.evidence.shape, self.keypoints
        means, modes, sightings = zip(*rows, strict=True)
        places = np.full(sum(map(len, means)), first)
        mean = np.insert(shape.mean, places, np.concatenate(means), axis=0)
        moved = np.insert(shape.modes, places, np.concatenate(modes, axis=1), axis=1)
        own = stacked(sightings)._replace(point=first + np.arange(len(places)))
        evidence = self._with_room(len(places))
        evidence = evidence._replace(
            shape=Shape(mean, moved, np.insert(shape.spread, places, 0.0)),
            sightings=stacked([evidence.sightings, own]),
        )
        return evidence, state._replace(displacements=np.zeros_like(mean))

    def _with_room(self, count: int) -> Evidence:
        """The evidence with the numbers that points have behind so many more of outlines."""

        def moved(points: IntArray) -> IntArray:
            return np.where(points >= self.keypoints, points + count, points)

        given = self.evidence
        sightings, offsets = given.sightings, given.offsets
        whole = given._replace(sightings=sightings._replace(point=moved(sightings.point)))
        return whole.with_block(offsets._replace(ends=moved(offsets.ends)))

    def _rows_of(
        self, number: int, outline: Outline, noise: Noise, surface: PosedSurface, sight: Sight
    ) -> tuple[FloatArray, FloatArray, Sightings]:
        """Mean (n, 3), modes (K, n, 3) and sightings of the samples that a source found.

        At the state of the ``sight`` the residuals are the distances that were found, whatever the
        normals.
        """
        source = self.sources[number]
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
        mean, modes = surface.rows(points, outline.face[kept])
        every = np.zeros((len(self.evidence.shape.modes), count, 3))
        every[: len(modes)] = modes  # none for a rigid surface
        own = len(every) - OWN_MODES * (len(self.sources) - number)
        every[own : own + OWN_MODES] = moved @ sight.pose.rotation / sight.pose.scale
        weights = 1 / (noise.sigma * outline.sigmas[kept] * root)
        sightings = Sightings(
            np.arange(count),
            np.full(count, source.image),
            rays,
            np.column_stack([across * weights[:, None], np.zeros(count)]),
            np.zeros((count, 3)),
            np.full(count, CAUCHY),
            np.full(count, noise.loss_scale / root),
            np.zeros((count, 2)),
        )
        return mean, every, sightings


def with_displacement_modes(evidence: Evidence, state: State) -> tuple[Evidence, State]:
    """The same with the points' own displacements as modes, which a warped surface follows."""
    shape, rows = evidence.shape, np.flatnonzero(evidence.shape.spread > 0)
    modes = displaced_modes(shape, rows)
    moved = state.displacements[rows] / shape.spread[rows, None]
    return (
        evidence._replace(shape=Shape(shape.mean, modes, np.zeros_like(shape.spread))),
        state._replace(
            coefficients=np.concatenate([state.coefficients, moved.ravel()]),
            displacements=np.zeros_like(state.displacements),
        ),
    )
