"""Rounds that bring a model's outline to that of photos, together with all other evidence.

Each round predicts the outline at the present estimate, learns the colours on both sides of it, and
takes the places where lines across it leave the object as rows of the evidence (`photo_lines.py`).
Rounds begin with long lines of blurred colours and end with short ones at full resolution; lengths
far above the last step are left out. The last rounds count with the noise that the residuals show.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.contours.measured import Joined, Measured, Place, Sought, solved
from cadalign.estimation.contours.photo_lines import (
    Outline,
    PhotoPyramid,
    outline_of,
    silhouette_of,
)
from cadalign.estimation.contours.surface import PosedSurface
from cadalign.estimation.contours.view_contour import (
    contour_rows,
    correlation_length,
    trimmed_deviation,
)
from cadalign.estimation.estimates import poses_of
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.solvers.joint.covariance import information_of
from cadalign.solvers.joint.evidence import Evidence, State

_COARSE, _FINE = (0.16, 0.08), (0.04, 0.02)  # reaches of lines, relative to the silhouette's size
_LEAST_REACH = 5.0  # [px]
_ROUNDS = 3  # of every reach, at most
_LAST_ROUNDS = 3  # with the noise that is learned, at most
_FORESIGHT = 4.0  # reach of lines that a step may need, relative to the last one
_REACH_CELLS = 6.4  # of a silhouette in which lines are sought, that these reach across
_FEWEST_CELLS, _MOST_CELLS = 80, 220  # along the longer side of a silhouette
_ITERATIONS = 8  # of a round, whose outline is not that of its end
_FIRST_CORRELATION = 4.0  # lines
_LEAST_CORRELATION = 12.0  # lines: pixels and blur displace neighbours alike
_LEAST_FACTOR = 0.5
_LEAST_FREEDOM = 0.1  # share of the residuals' degrees of freedom that the unknowns leave
_LOSS_SCALE = 2.4  # in standard deviations
_LEAST_OUTLIER = 2.0  # in standard deviations
# Standard deviations [px] of what all of an outline has in common: an offset outwards, and, where
# light and blur differ from side to side, shifts to the right and down.
_OWN_SIGMAS = (0.4, 0.3, 0.3)


class LineNoise(NamedTuple):
    """Factor of the standard deviations of a photo's lines, and neighbours that count as one."""

    factor: float = 1.0
    correlation: float = _FIRST_CORRELATION


Pictured = Sought[PhotoPyramid]
"""Evidence with photos, and the surface whose outline is sought in these."""


class Approach(NamedTuple):
    """A place, and the outlines from which the last step led there.

    An outline is None where a photo shows none; ``joined`` is the evidence with them, and
    ``step`` the root mean square by which the outline moved, relative to the silhouette's size, in
    the photo where it moved most.
    """

    place: Place
    outlines: tuple[Outline | None, ...] = ()
    joined: Joined | None = None
    step: float = np.inf

    def is_close(self, reach: float) -> bool:
        """True if the next step will be much smaller than half a ``reach``."""
        return _FORESIGHT * self.step < reach / 2


def approach(
    pictured: Pictured, start: Approach, reaches: Sequence[float] = _COARSE
) -> Approach | None:
    """Rounds with lines of the given reaches; None where no photo shows an outline."""
    here: Approach | None = start
    noises = [LineNoise()] * len(pictured.views)
    for reach in reaches:
        for _ in range(_ROUNDS):
            if here is None:
                return None
            if here.is_close(reach):
                break
            here = _round(pictured, here.place, reach, noises)
    return here


def finish(pictured: Pictured, start: Approach) -> Approach | None:
    """Rounds with short lines, the last ones at the noise that the residuals show."""
    here, noises = approach(pictured, start, _FINE), [LineNoise()] * len(pictured.views)
    for number in range(_LAST_ROUNDS):
        if here is None:
            return None
        if number and here.is_close(_FINE[-1]):
            break
        noises = [*map(noise_of_lines, here.outlines, here.place.own)]
        here = _round(pictured, here.place, _FINE[-1], noises)
    return None if here is None else _widened(pictured, here, noises)


def _round(
    pictured: Pictured, place: Place, share: float, noises: list[LineNoise]
) -> Approach | None:
    """One step, with the outline that the present state has."""
    posed, poses = pictured.at(place.state)
    cells = round(min(max(_REACH_CELLS / share, _FEWEST_CELLS), _MOST_CELLS))
    outlines: list[Outline | None] = []
    rows = []
    for photo, noise in zip(pictured.views, noises, strict=True):
        camera = pictured.camera_at(photo.image, photo.camera, place.state)
        pose, outline = poses[photo.image], None
        silhouette = silhouette_of(posed, camera, pose, cells)
        if silhouette is not None:
            outline = outline_of(photo, silhouette, max(share * silhouette.size, _LEAST_REACH))
        if outline is not None and outline.is_told.any():
            rows.append(_rows(photo, outline, noise, posed, pose, camera))
            outlines.append(outline)
        else:
            outlines.append(None)
    if not rows:
        return None
    shown = np.array([outline is not None for outline in outlines])
    refined = pictured.joined(place._replace(own=place.own[shown]), rows).refined(_ITERATIONS)
    if refined is None:
        return None
    own, (_, joined) = np.zeros_like(place.own), refined
    own[shown] = joined.place.own
    there = Place(joined.place.state, own)
    return Approach(there, tuple(outlines), joined, _step(pictured, outlines, rows, there.state))


def _step(
    pictured: Pictured, outlines: list[Outline | None], rows: list[Measured], state: State
) -> float:
    """The largest step of an outline to another state, as `Approach` has it."""
    poses, steps = poses_of(pictured.evidence, state), []
    shown = [each for each in zip(pictured.views, outlines, strict=True) if each[1] is not None]
    for (photo, outline), measured in zip(shown, rows, strict=True):
        silhouette, told = cast(Outline, outline).silhouette, cast(Outline, outline).is_told
        own = state.coefficients[: len(measured.modes)]  # none for a rigid surface
        points = measured.mean + np.tensordot(own, measured.modes, axes=1)
        camera = pictured.camera_at(photo.image, photo.camera, state)
        moved = camera.project(poses[photo.image].apply(points)) - silhouette.contour.points[told]
        along = (moved * silhouette.contour.normals[told]).sum(axis=1)
        steps.append(float(np.sqrt((along**2).mean())) / silhouette.size)
    return max(steps)


def _rows(
    photo: PhotoPyramid,
    outline: Outline,
    noise: LineNoise,
    surface: PosedSurface,
    pose: Alignment,
    camera: Camera,
) -> Measured:
    """The lines that have a place, in the form of the evidence."""
    told, silhouette, given = outline.is_told, outline.silhouette, photo.camera
    rays, _ = given.normalize_where_valid(silhouette.contour.points[told])
    slopes = np.array([[given.fx], [given.fy]]) * given.distortion_jacobian(rays)
    root = np.sqrt(noise.correlation)
    return contour_rows(
        photo.image,
        surface,
        pose,
        silhouette.points[told],
        silhouette.face[told],
        across=np.einsum("ni,nij->nj", silhouette.across[told], slopes),
        places=outline.places[told],
        weights=1 / (noise.factor * outline.sigmas[told] * root),
        loss_scale=_LOSS_SCALE / root,
        own=_OWN_SIGMAS,
        cameras=(given, camera),
    )


def noise_of_lines(outline: Outline | None, own: FloatArray) -> LineNoise:
    """The noise that the residuals of an outline show, beside what all of it has in common."""
    if outline is None:
        return LineNoise()
    residuals, told = outline.in_sigmas(common_places(outline, own)), outline.is_told
    factor = max(trimmed_deviation(residuals[told], _LEAST_OUTLIER), _LEAST_FACTOR)
    influence = residuals / (1 + (residuals / (_LOSS_SCALE * factor)) ** 2)
    length = correlation_length(outline.silhouette.contour, influence, told)
    return LineNoise(factor, max(length, _LEAST_CORRELATION))


def _widened(pictured: Pictured, here: Approach, noises: list[LineNoise]) -> Approach:
    """The same, with the noise of lines as large as it is if unknowns fitted a part of it.

    Their residuals have as many degrees of freedom less as the lines determine unknowns.
    """
    joined = cast(Joined, here.joined)
    sightings, state = joined.evidence.sightings, joined.state
    is_line = np.arange(len(sightings.point)) >= len(pictured.evidence.sightings.point)

    def weighted(factor: float) -> Evidence:
        whitening = np.where(is_line[:, None], factor, 1.0) * sightings.whitening
        return joined.evidence._replace(sightings=sightings._replace(whitening=whitening))

    (_, whole), (_, rest) = (information_of(weighted(lines), state) for lines in (1.0, 0.0))
    fitted = float(np.trace(solved(whole, whole - rest)))
    count = sum(
        float(outline.is_told.sum()) / noise.correlation
        for outline, noise in zip(here.outlines, noises, strict=True)
        if outline is not None
    )
    factor = np.sqrt(max(1 - fitted / max(count, 1.0), _LEAST_FREEDOM))
    return here._replace(joined=joined._replace(evidence=weighted(factor)))


def common_places(outline: Outline, own: FloatArray) -> FloatArray:
    """Places (S,) [px] outwards to which the coefficients ``own`` (3,) take an outline."""
    offset, *shift = own * _OWN_SIGMAS
    return np.asarray(offset + outline.silhouette.contour.normals @ shift)
