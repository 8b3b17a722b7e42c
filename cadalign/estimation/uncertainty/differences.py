"""Derivatives of joint estimates by their keypoints: of all evidence, views, shapes and cameras.

At the optimum the step of all unknowns that the equations predict is zero. Its derivatives by the
unknowns and by the data, from central differences of the equations themselves, give those of the
optimum: ``ds = -(dG/ds)^-1 dG/dd dd``. All that the objective holds counts: the determinant of what
is integrated out, weights of robust losses, the lens at other focal lengths. Contours and depth
images count by the points that they were matched with.

An estimated principal point solves one equation more: half the derivative of the cost by it and its
prior's are zero.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import DegenerateError
from cadalign.estimation.estimates import poses_of
from cadalign.estimation.problems import focal_slopes, rays_of, whitening_of
from cadalign.estimation.uncertainty.derivatives import loss_slopes
from cadalign.geometry.camera import Camera
from cadalign.solvers.joint.evidence import Evidence, State, log_focals_of, points_of, unpacked
from cadalign.solvers.joint.reduction import reduced_row, sighted_points
from cadalign.solvers.joint.search import has_latent
from cadalign.solvers.joint.slopes import joint_step
from cadalign.solvers.unknowns import move_rigid

_DIFFERENCE = 1e-5  # in standard deviations, radians, and shares of lengths


@dataclass(frozen=True, eq=False)
class SightedKeypoints:
    """Keypoints that an estimate rests on, which are the first k of its sightings.

    ``cameras`` (V,) are those of the views at the estimate, ``pixels`` (k, 2), ``covariances``
    (k, 2, 2) the keypoints' [px^2], and ``image`` (k,) their views.
    """

    cameras: Sequence[Camera]
    image: IntArray
    pixels: FloatArray
    covariances: FloatArray

    @classmethod
    def of(
        cls, evidence: Evidence, cameras: Sequence[Camera], pixels: FloatArray
    ) -> SightedKeypoints:
        """The keypoints at ``pixels``, with the covariances that the evidence has."""
        image = evidence.sightings.image[: len(pixels)]
        covariances = np.empty((len(pixels), 2, 2))
        for v, camera in enumerate(cameras):
            own = image == v
            rays = rays_of(np.require(pixels[own], requirements="W"), camera, clips=True)
            a, b, c = evidence.sightings.whitening[: len(pixels)][own].T
            zero = np.zeros_like(a)
            rows = np.stack([np.stack([a, b], axis=-1), np.stack([zero, c], axis=-1)], axis=-2)
            to_pixels = np.diag([camera.fx, camera.fy]) @ camera.distortion_jacobian(rays)
            from_pixels = rows @ np.linalg.inv(to_pixels)
            covariances[own] = np.linalg.inv(from_pixels.swapaxes(1, 2) @ from_pixels)
        return cls(cameras, image, pixels, covariances)

    def seen_in(self, evidence: Evidence, log_ratios: FloatArray) -> Evidence:
        """The evidence with these keypoints, from lenses at focal lengths times exp(log ratio).

        The rays remain relative to the cameras' focal lengths.
        """
        given = evidence.sightings
        rays, slopes = given.rays.copy(), given.slopes.copy()
        whitening = given.whitening.copy()
        for v, (camera, log_ratio) in enumerate(zip(self.cameras, log_ratios, strict=True)):
            own = np.flatnonzero(self.image == v)
            ratio = float(np.exp(log_ratio))
            lens = camera.with_focal(camera.fx * ratio) if log_ratio else camera
            pixels = np.ascontiguousarray(self.pixels[own])
            there = rays_of(pixels, lens, clips=True)
            whitening[own] = whitening_of(self.covariances[own], there, lens) / ratio
            if lens.distortion:
                slopes[own] = ratio * focal_slopes(pixels, lens, there)
            rays[own] = ratio * there - log_ratio * slopes[own]
        sightings = given._replace(rays=rays, whitening=whitening, slopes=slopes)
        return evidence._replace(sightings=sightings)

    def forces(self, evidence: Evidence, state: State) -> FloatArray:
        """Derivatives (k, 2) of half the cost by the keypoints' projections [1/px]."""
        points, count = points_of(evidence.shape, state), len(self.pixels)
        of_point, found = evidence.sightings.point[:count], np.zeros((count, 2))
        loss, bend = (int(evidence.sightings.loss[0]), float(evidence.sightings.loss_scale[0]))
        logs = log_focals_of(evidence, state)
        for v, (camera, pose) in enumerate(
            zip(self.cameras, poses_of(evidence, state), strict=True)
        ):
            own = self.image == v
            lens = camera.with_focal(camera.fx * float(np.exp(logs[v]))) if logs[v] else camera
            in_camera = points[of_point[own]] @ pose.rotation.T + pose.translation
            residuals = lens.project(in_camera) - self.pixels[own]
            forces = np.linalg.solve(self.covariances[own], residuals[..., None])[..., 0]
            first, _ = loss_slopes((forces * residuals).sum(axis=1), loss, bend)
            found[own] = first[:, None] * forces
        return found


class DataSlopes(NamedTuple):
    """Derivatives of u unknowns by the data of k keypoints.

    By pixels (u, k, 2), logarithms of the standard deviations (u, k), and the model's points
    (u, k, 3): of one that several views see, by all at once.
    """

    by_pixels: FloatArray
    by_log_sigma: FloatArray
    by_points: FloatArray


class _Parts(NamedTuple):
    """First rows of the parts of the unknowns; poses come first."""

    focals: int
    scales: int
    coefficients: int
    displacements: int


class _Place(NamedTuple):
    """Place of the equations' evaluation; the principal point is ``shift`` (2,) off [px]."""

    evidence: Evidence
    row: FloatArray
    keypoints: SightedKeypoints
    shift: FloatArray


@dataclass(frozen=True, eq=False)
class JointOptimum:
    """The optimum of all evidence, in modes that the evidence tells apart.

    ``row`` is the state in a row. Where the principal point was estimated, ``principal_weight`` is
    the inverse variance of its prior [px^-2], otherwise None.
    """

    evidence: Evidence
    row: FloatArray
    keypoints: SightedKeypoints
    principal_weight: float | None

    @classmethod
    def of(
        cls,
        evidence: Evidence,
        state: State,
        cameras: Sequence[Camera],
        pixels: FloatArray,
        principal_sigma: float | None,
    ) -> JointOptimum:
        """The optimum of evidence whose first sightings are of ``pixels`` (k, 2).

        ``cameras`` are those of the views at the estimate.
        """
        references = [
            camera.with_focal(camera.fx * float(np.exp(-log))) if log else camera
            for camera, log in zip(cameras, log_focals_of(evidence, state), strict=True)
        ]
        reduction, row = reduced_row(evidence, state)
        keypoints = SightedKeypoints.of(evidence, references, pixels)
        weight = None if principal_sigma is None else principal_sigma**-2
        return cls(reduction.evidence, row, keypoints, weight)

    @property
    def state(self) -> State:
        """The state."""
        return unpacked(self.evidence, self.row)

    @property
    def parts(self) -> _Parts:
        """First rows of log focals, log scales, coefficients and displacements."""
        state = self.state
        focals = 6 * len(state.poses)
        scales = focals + len(state.log_focals)
        return _Parts(focals, scales, scales + 3, scales + 3 + len(state.coefficients))

    @cached_property
    def _free(self) -> IntArray:
        """Rows of the unknowns that are estimated."""
        state, shape, focals = self.state, self.evidence.shape, self.evidence.focals
        moves = sighted_points(self.evidence) & (shape.spread > 0)
        moves &= len(state.poses) == 1  # of several, they are modes
        marks = [
            np.ones(6 * len(state.poses), dtype=bool),
            (focals.low < state.log_focals) & (state.log_focals < focals.high),
            self.evidence.scales.free > 0,
            np.ones(len(shape.modes), dtype=bool),
            np.repeat(moves, 3),
        ]
        return np.flatnonzero(np.concatenate(marks))

    @cached_property
    def slopes(self) -> DataSlopes:
        """Derivatives of all unknowns: poses, log focals, log scales, coefficients, displacements.

        Raises DegenerateError if the evidence does not determine them.
        """
        by_unknowns = np.stack([self._difference(*each) for each in self._moved()], axis=1)
        by_data = np.stack([self._difference(*each) for each in self._changed()], axis=1)
        try:
            solved = -np.linalg.solve(by_unknowns, by_data)
        except np.linalg.LinAlgError:
            solved = np.full(by_data.shape, np.nan)
        if not np.isfinite(solved).all():
            what = "the evidence does not determine all unknowns, which have no derivatives"
            raise DegenerateError(what, where="sensitivity", fix="give more evidence")
        size, count = self.parts.displacements + 3 * len(self.evidence.shape.mean), len(self._point)
        whole = np.zeros((size, solved.shape[1]))
        whole[self._free] = solved[: len(self._free)]
        by_points = whole[:, 3 * count :].reshape(size, -1, 3)
        return DataSlopes(
            whole[:, : 2 * count].reshape(size, count, 2),
            whole[:, 2 * count : 3 * count],
            by_points[:, np.unique(self._point, return_inverse=True)[1]],
        )

    @property
    def _point(self) -> IntArray:
        """Points (k,) of the shape that the keypoints are."""
        return self.evidence.sightings.point[: len(self.keypoints.pixels)]

    def _difference(self, unit: float, plus: _Place, minus: _Place) -> FloatArray:
        """Central difference of the equations that the optimum solves."""
        return (self._equations(plus) - self._equations(minus)) / (2 * unit)

    def _equations(self, place: _Place) -> FloatArray:
        evidence, row, keypoints, shift = place
        step = joint_step(evidence, has_latent(evidence), row)[self._free]
        if self.principal_weight is None:
            return np.asarray(step)
        forces = keypoints.forces(evidence, unpacked(evidence, row)).sum(axis=0)
        return np.concatenate([step, forces + self.principal_weight * shift])

    def _at(self, row: FloatArray) -> _Place:
        logs = log_focals_of(self.evidence, unpacked(self.evidence, row))
        evidence = self.evidence
        if any(camera.distortion for camera in self.keypoints.cameras):
            evidence = self.keypoints.seen_in(evidence, logs)
        return _Place(evidence, row, self.keypoints, np.zeros(2))

    def _seen(self, keypoints: SightedKeypoints, shift: FloatArray) -> _Place:
        """Other keypoints, with a principal point that is shifted."""
        logs = log_focals_of(self.evidence, self.state)
        keypoints = replace(keypoints, pixels=keypoints.pixels - shift)
        return _Place(keypoints.seen_in(self.evidence, logs), self.row, keypoints, shift)

    def _moved(self) -> Iterator[tuple[float, _Place, _Place]]:
        """Other states, one for each unknown."""
        distance = float(np.linalg.norm(self.state.poses[:, 9:], axis=1).mean())
        focals, displaced = self.parts.focals, self.parts.displacements
        spread = np.repeat(self.evidence.shape.spread, 3)
        for k in self._free.tolist():
            unit = _DIFFERENCE
            if k < focals and k % 6 >= 3:
                unit *= distance
            elif k >= displaced:
                unit *= float(spread[k - displaced])
            yield unit, self._at(self._row_at(k, unit)), self._at(self._row_at(k, -unit))
        if self.principal_weight is not None:
            for shift in _DIFFERENCE * np.eye(2):
                plus, minus = (self._seen(self.keypoints, each) for each in (shift, -shift))
                yield _DIFFERENCE, plus, minus

    def _row_at(self, unknown: int, change: float) -> FloatArray:
        """The state with one unknown changed."""
        row, poses = self.row.copy(), 6 * len(self.state.poses)
        if unknown >= poses:
            row[unknown + poses] += change  # a pose has 12 numbers
            return row
        step = np.zeros(6)
        step[unknown % 6] = change
        pose = 12 * (unknown // 6)
        move_rigid(self.row[pose : pose + 12], step, row[pose : pose + 12])
        return row

    def _changed(self) -> Iterator[tuple[float, _Place, _Place]]:
        """Other data: pixels, logarithms of standard deviations, points of the model."""
        keypoints, still = self.keypoints, np.zeros(2)
        deviations = np.sqrt(np.trace(keypoints.covariances, axis1=1, axis2=2) / 2)
        for k, axis in np.ndindex(keypoints.pixels.shape):
            change = np.zeros_like(keypoints.pixels)
            change[k, axis] = unit = _DIFFERENCE * float(deviations[k])
            plus, minus = (
                replace(keypoints, pixels=keypoints.pixels + each) for each in (change, -change)
            )
            yield unit, self._seen(plus, still), self._seen(minus, still)
        for k in range(len(keypoints.pixels)):
            factor = np.ones((len(keypoints.pixels), 1, 1))
            factor[k] = np.exp(2 * _DIFFERENCE)
            plus, minus = (
                replace(keypoints, covariances=keypoints.covariances * each)
                for each in (factor, 1 / factor)
            )
            yield _DIFFERENCE, self._seen(plus, still), self._seen(minus, still)
        shape = self.evidence.shape
        unit = _DIFFERENCE * float(np.ptp(shape.mean, axis=0).max())
        for point, axis in np.ndindex(len(np.unique(self._point)), 3):
            change = np.zeros_like(shape.mean)
            change[np.unique(self._point)[point], axis] = unit
            ahead, behind = (
                self._at(self.row)._replace(
                    evidence=self.evidence._replace(shape=shape._replace(mean=shape.mean + each))
                )
                for each in (change, -change)
            )
            yield unit, ahead, behind
