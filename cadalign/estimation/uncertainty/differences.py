"""Derivatives of joint estimates by their keypoints: of all evidence, views, shapes and cameras.

At the optimum the step of all unknowns that the equations predict is zero. Its derivatives by the
unknowns and by the data, from central differences of the equations themselves, give those of the
optimum: ``ds = -(dG/ds)^-1 dG/dd dd``. All that the objective holds counts: the determinant of what
is integrated out, weights of robust losses, the lens at other focal lengths. Contours and depth
images count by the points that they were matched with.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import DegenerateError
from cadalign.estimation.problems import focal_slopes, rays_of, whitening_of
from cadalign.estimation.uncertainty.residuals import whitening_matrices
from cadalign.geometry.camera import Camera
from cadalign.solvers.joint.evidence import Evidence, State, log_focals_of, unpacked
from cadalign.solvers.joint.search import has_latent, reduced_row, sighted_points
from cadalign.solvers.joint.system import Joint
from cadalign.solvers.search import step_at
from cadalign.solvers.unknowns import move_rigid

_DIFFERENCE = 1e-5  # in standard deviations, radians, and shares of lengths


def _at_focal(camera: Camera, log_ratio: float) -> Camera:
    return camera.with_focal(camera.fx * float(np.exp(log_ratio))) if log_ratio else camera


@dataclass(frozen=True, eq=False)
class SightedKeypoints:
    """Keypoints that an estimate rests on, which are the first k of its sightings."""

    cameras: Sequence[Camera]  # (V,) of the views, at the focal lengths that rays are relative to
    image: IntArray  # (k,), views
    pixels: FloatArray  # (k, 2)
    covariances: FloatArray  # (k, 2, 2) [px^2]

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
            rows = whitening_matrices(evidence.sightings.whitening[: len(pixels)][own])
            to_pixels = np.diag([camera.fx, camera.fy]) @ camera.distortion_jacobian(rays)
            from_pixels = rows @ np.linalg.inv(to_pixels)
            covariances[own] = np.linalg.inv(from_pixels.swapaxes(1, 2) @ from_pixels)
        return cls(cameras, image, pixels, covariances)

    def seen_in(
        self, evidence: Evidence, log_ratios: FloatArray, *, only: int | None = None
    ) -> Evidence:
        """The evidence with these keypoints, from lenses at focal lengths times exp(log ratio).

        The rays remain relative to the cameras' focal lengths. With ``only`` one of the keypoints
        in another place, the evidence has the others as they are.
        """
        given = evidence.sightings
        rays, slopes = given.rays.copy(), given.slopes.copy()
        whitening = given.whitening.copy()
        for v, (camera, log_ratio) in enumerate(zip(self.cameras, log_ratios, strict=True)):
            own = np.flatnonzero(self.image == v)
            if only is not None:
                own = own[own == only]
            if not len(own):
                continue
            ratio, lens = float(np.exp(log_ratio)), _at_focal(camera, log_ratio)
            pixels = np.ascontiguousarray(self.pixels[own])
            there = rays_of(pixels, lens, clips=True)
            whitening[own] = whitening_of(self.covariances[own], there, lens) / ratio
            if lens.distortion:
                slopes[own] = ratio * focal_slopes(pixels, lens, there)
            rays[own] = ratio * there - log_ratio * slopes[own]
        sightings = given._replace(rays=rays, whitening=whitening, slopes=slopes)
        return evidence._replace(sightings=sightings)


class DataSlopes(NamedTuple):
    """Derivatives of u unknowns by the data of k keypoints.

    Differences of a point of the model that several views see, by all at once.
    """

    by_pixels: FloatArray  # (u, k, 2)
    by_log_sigma: FloatArray  # (u, k), by logarithms of the standard deviations
    by_points: FloatArray  # (u, k, 3), by the model's


class _Place(NamedTuple):
    """Place of the equations' evaluation."""

    evidence: Evidence
    row: FloatArray


@dataclass(frozen=True, eq=False)
class JointOptimum:
    """The optimum of all evidence, in modes that the evidence tells apart."""

    evidence: Evidence
    row: FloatArray  # the state
    keypoints: SightedKeypoints

    @classmethod
    def of(
        cls,
        evidence: Evidence,
        state: State,
        cameras: Sequence[Camera],
        pixels: FloatArray,
    ) -> JointOptimum:
        """The optimum of evidence whose first sightings are of ``pixels`` (k, 2).

        ``cameras`` are those of the views at the estimate.
        """
        logs = log_focals_of(evidence, state)
        references = [_at_focal(*each) for each in zip(cameras, -logs, strict=True)]
        reduction, row = reduced_row(evidence, state)
        keypoints = SightedKeypoints.of(evidence, references, pixels)
        return cls(reduction.evidence, row, keypoints)

    @cached_property
    def state(self) -> State:
        """The state."""
        return unpacked(self.evidence, self.row)

    @cached_property
    def parts(self) -> tuple[int, int, int, int]:
        """First rows of log focals, log scales, coefficients and displacements; poses are first."""
        focals = 6 * len(self.state.poses)
        scales = focals + len(self.state.log_focals)
        return focals, scales, scales + 3, scales + 3 + len(self.state.coefficients)

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
        by_unknowns, by_data = self._by_unknowns(), self._by_data()
        try:
            solved = -np.linalg.solve(by_unknowns, by_data)
        except np.linalg.LinAlgError:
            solved = np.full(by_data.shape, np.nan)
        if not np.isfinite(solved).all():
            what = "the evidence does not determine all unknowns, which have no derivatives"
            raise DegenerateError(what, where="sensitivity", fix="give more evidence")
        size, count = self.parts[3] + 3 * len(self.evidence.shape.mean), len(self._point)
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

    def _slope(self, changed: Callable[[float], _Place], unit: float) -> FloatArray:
        """Central difference of the equations that the optimum solves."""
        plus, minus = self._equations(changed(unit)), self._equations(changed(-unit))
        return (plus - minus) / (2 * unit)

    def _equations(self, place: _Place) -> FloatArray:
        evidence, row = place
        system = Joint(evidence, has_latent(evidence))
        return np.asarray(step_at(system, row, evidence.shape.mean.size)[self._free])

    def _by_unknowns(self) -> FloatArray:
        distance = float(np.linalg.norm(self.state.poses[:, 9:], axis=1).mean())
        focals, _, _, displaced = self.parts
        spread = np.repeat(self.evidence.shape.spread, 3)
        columns = []
        for k in self._free.tolist():
            unit = _DIFFERENCE
            if k < focals and k % 6 >= 3:
                unit *= distance
            elif k >= displaced:
                unit *= float(spread[k - displaced])
            columns.append(self._slope(partial(self._with_unknown, k), unit))
        return np.stack(columns, axis=1)

    def _by_data(self) -> FloatArray:
        """Columns of pixels, logarithms of standard deviations, and points of the model."""
        covariances, mean = self.keypoints.covariances, self.evidence.shape.mean
        sigmas = np.sqrt(np.trace(covariances, axis1=1, axis2=2) / 2)
        length = float(np.ptp(mean, axis=0).max())
        columns = []
        for k, axis in np.ndindex(self.keypoints.pixels.shape):
            unit = _DIFFERENCE * float(sigmas[k])
            columns.append(self._slope(partial(self._with_pixel, k, axis), unit))
        for k in range(len(covariances)):
            columns.append(self._slope(partial(self._with_log_sigma, k), _DIFFERENCE))
        for point, axis in product(np.unique(self._point).tolist(), range(3)):
            changed = partial(self._with_point, point, axis)
            columns.append(self._slope(changed, _DIFFERENCE * length))
        return np.stack(columns, axis=1)

    def _with_unknown(self, unknown: int, change: float) -> _Place:
        row, poses = self.row.copy(), 6 * len(self.state.poses)
        if unknown >= poses:
            row[unknown + poses] += change  # a pose has 12 numbers
        else:
            step = np.zeros(6)
            step[unknown % 6] = change
            pose = 12 * (unknown // 6)
            move_rigid(self.row[pose : pose + 12], step, row[pose : pose + 12])
        return self._at(row)

    def _with_pixel(self, keypoint: int, axis: int, change: float) -> _Place:
        pixels = self.keypoints.pixels.copy()
        pixels[keypoint, axis] += change
        return self._seen_but(keypoint, replace(self.keypoints, pixels=pixels))

    def _with_log_sigma(self, keypoint: int, change: float) -> _Place:
        covariances = self.keypoints.covariances.copy()
        covariances[keypoint] *= np.exp(2 * change)
        return self._seen_but(keypoint, replace(self.keypoints, covariances=covariances))

    def _with_point(self, point: int, axis: int, change: float) -> _Place:
        shape = self.evidence.shape
        mean = shape.mean.copy()
        mean[point, axis] += change
        evidence = self.evidence._replace(shape=shape._replace(mean=mean))
        return _Place(evidence, self.row)

    def _at(self, row: FloatArray) -> _Place:
        evidence = self.evidence
        if any(camera.distortion for camera in self.keypoints.cameras):
            logs = log_focals_of(evidence, unpacked(evidence, row))
            evidence = self.keypoints.seen_in(evidence, logs)
        return _Place(evidence, row)

    @cached_property
    def _log_focals(self) -> FloatArray:
        return log_focals_of(self.evidence, self.state)

    @cached_property
    def _here(self) -> Evidence:
        """The evidence with the keypoints as they are."""
        return self.keypoints.seen_in(self.evidence, self._log_focals)

    def _seen_but(self, keypoint: int, keypoints: SightedKeypoints) -> _Place:
        """The keypoints with another one in the place of one of them."""
        evidence = keypoints.seen_in(self._here, self._log_focals, only=keypoint)
        return _Place(evidence, self.row)
