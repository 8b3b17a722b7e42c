"""Fits of a batch with their derivatives: what the layer of PyTorch needs.

The forward pass is the search of `cadalign.fit_batch`; a Newton step removes what its tolerance
leaves. The backward pass solves one linear system for each problem, vectorised over the batch.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import InputError
from cadalign.estimation.focal import log_focal_range
from cadalign.estimation.options import LOSSES, FitOptions
from cadalign.estimation.problems import Problems, in_threads, rays_of
from cadalign.estimation.solve import solve
from cadalign.estimation.uncertainty.derivatives import UNKNOWNS, Optima, lens_slopes
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import rotations_from_vectors

_LARGEST_POLISH = 0.02  # turn [rad] or change of a logarithm beyond which a step is no polish
_AT_BOUND = 1e-9
_HELD = 1e12  # information about a log focal length at its bound
_NO_POSE = np.array([1.0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1, 1, 1, 1])


@dataclass(frozen=True, eq=False)
class KeypointBatch:
    """Keypoints of B problems in arrays: what is absent or not finite is 0.

    ``pixels`` (B, n, 2), ``sigmas`` (B, n) [px], ``present`` (B, n), rays (B, n, 2), and
    ``by_pixels`` (B, n, 2, 2), derivatives of the rays by the pixels.
    """

    pixels: FloatArray
    sigmas: FloatArray
    present: BoolArray
    rays: FloatArray
    by_pixels: FloatArray
    cameras: tuple[Camera, ...]

    @classmethod
    def of(
        cls,
        pixels: FloatArray,
        sigmas: FloatArray,
        present: BoolArray,
        cameras: tuple[Camera, ...],
    ) -> KeypointBatch:
        """The batch of checked arrays, seen by cameras that `FitTask` takes."""
        present = present & np.isfinite(pixels).all(axis=2) & np.isfinite(sigmas) & (sigmas > 0)
        pixels = np.where(present[..., None], pixels, 0.0)
        sigmas = np.where(present, sigmas, 1.0)
        rays, by_pixels = np.zeros_like(pixels), np.zeros((*present.shape, 2, 2))
        for b, camera in enumerate(cameras):
            own = slice(None) if len(cameras) == 1 else slice(b, b + 1)
            flat = np.ascontiguousarray(pixels[own].reshape(-1, 2))
            if camera.distortion:
                flat[~present[own].ravel()] = camera.cx, camera.cy
            seen = rays_of(flat, camera)
            rays[own] = seen.reshape(rays[own].shape)
            by_pixels[own] = lens_slopes(seen, camera).reshape(by_pixels[own].shape)
        return cls(pixels, sigmas, present, rays, by_pixels, cameras)

    @property
    def information(self) -> FloatArray:
        """Information (B, n, 2, 2) of the rays; 0 for those that are absent."""
        (a, b), (c, d) = self.by_pixels.transpose(2, 3, 0, 1)
        weights = self.present / (self.sigmas * (a * d - b * c)) ** 2
        mixed = -weights * (a * c + b * d)  # of the inverse's columns; NumPy's takes thrice as long
        rows = [weights * (c * c + d * d), mixed], [mixed, weights * (a * a + b * b)]
        return np.ascontiguousarray(np.array(rows).transpose(2, 3, 0, 1))


@dataclass(frozen=True, eq=False)
class FitTask:
    """Input of a batch's fits beside arrays: one camera, or one for each problem.

    Raises InputError for cameras that the derivatives don't know.
    """

    cameras: tuple[Camera, ...]
    options: FitOptions
    exact: bool
    workers: int

    def __post_init__(self) -> None:
        if any(each.is_wide for each in self.cameras):
            what = "wide lenses have no gradients"
            raise InputError(what, where="camera", fix="undistort keypoints and camera first")
        if self.options.focal == "known":
            for each in self.cameras:
                each.require_focal()
            return
        if len({(each.width, each.height) for each in self.cameras}) > 1:
            what = "with an unknown focal length all images must have one size"
            raise InputError(what, where="camera", fix="call fit for each size")
        if any(each.distortion for each in self.cameras):
            what = "an unknown focal length and lens distortion have no gradients together"
            raise InputError(what, where="focal", fix="undistort keypoints and camera first")


class FitValues(NamedTuple):
    """Fits of B problems; the covariance (B, 10, 10) is that of all unknowns."""

    rotation: FloatArray
    translation: FloatArray
    scale: FloatArray
    focal: FloatArray
    covariance: FloatArray
    valid: BoolArray


@dataclass(frozen=True, eq=False)
class BatchFits:
    """Fits of a batch in the parts that threads have shared."""

    parts: list[_Part]

    @property
    def values(self) -> FitValues:
        """The fits."""
        return FitValues(*_joined(part.values for part in self.parts))

    def pulled_back(self, *slopes: FloatArray) -> tuple[FloatArray, ...]:
        """Slopes by points, pixels and sigmas from those by rotation, translation, scale, focal."""
        ends = np.cumsum([len(part.sigmas) for part in self.parts])[:-1]
        given = zip(self.parts, *(np.split(each, ends) for each in slopes), strict=True)
        return _joined(part.pulled_back(*own) for part, *own in given)


def _joined(parts: Iterable[tuple[Any, ...]]) -> tuple[Any, ...]:
    return tuple(map(np.concatenate, zip(*parts, strict=True)))


@dataclass(frozen=True, eq=False)
class _Part:
    """Fits of some problems, and their optima before a Newton step.

    ``by_pixels`` (B, n, 2, 2) are the derivatives of the optima's rays by the pixels.
    """

    optima: Optima
    by_pixels: FloatArray
    sigmas: FloatArray
    values: FitValues

    def pulled_back(
        self,
        by_rotation: FloatArray,
        by_translation: FloatArray,
        by_scale: FloatArray,
        by_focal: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        values, slopes = self.values, np.empty((len(by_focal), UNKNOWNS))
        slopes[:, :3] = np.cross(values.rotation, by_rotation, axis=1).sum(axis=2)
        slopes[:, 3:6] = by_translation
        slopes[:, 6:9] = by_scale * values.scale
        slopes[:, 9] = by_focal * values.focal
        slopes[~values.valid] = 0.0
        by_rays, by_log_sigma, by_points = self.optima.pull_back(slopes)
        by_pixels = (by_rays[..., None, :] @ self.by_pixels)[..., 0, :]
        return by_points, by_pixels, by_log_sigma / self.sigmas


def fits_of(
    task: FitTask,
    points: FloatArray,
    pixels: FloatArray,
    sigmas: FloatArray,
    mask: BoolArray,
) -> BatchFits:
    """The fits of a batch.

    Points (B, n, 3), pixels (B, n, 2), sigmas and mask (B, n).
    """
    options = task.options
    if options.focal == "estimate":
        options = options.for_camera(task.cameras[0])

    @np.errstate(all="ignore")  # holds for one thread only
    def run(first: int, last: int) -> _Part:
        some = slice(first, last)
        cameras = task.cameras if len(task.cameras) == 1 else task.cameras[some]
        present = mask[some] & np.isfinite(points[some]).all(axis=2)
        batch = KeypointBatch.of(pixels[some], sigmas[some], present, cameras)
        known = np.where(batch.present[..., None], points[some], 0.0)
        return _fitted(known, batch, options, exact=task.exact)

    return BatchFits(in_threads(run, len(points), task.workers))


def _fitted(points: FloatArray, batch: KeypointBatch, options: FitOptions, *, exact: bool) -> _Part:
    """The fits of some problems, polished by a Newton step.

    The derivatives are those before it: it is far below the noise.
    """
    poses, focals, valid = _searched(points, batch, options)
    pose = poses[:, :9].reshape(-1, 3, 3), poses[:, 9:12], poses[:, 12:]
    given = np.array([camera.fx for camera in batch.cameras])
    ratio = (focals / given)[:, None, None]
    offset = weight = np.zeros(len(focals))
    rays, information, by_pixels = batch.rays, batch.information, batch.by_pixels
    if options.focal == "estimate":
        rays, by_pixels = rays / ratio, by_pixels / ratio[..., None]
        information = information * ratio[..., None] ** 2
        low, high, mean, of_prior = log_focal_range(batch.cameras[0], options.focal_prior)
        logs = np.log(focals)
        is_held = (logs < low + _AT_BOUND) | (logs > high - _AT_BOUND)
        weight = np.where(is_held, _HELD, of_prior)
        offset = np.where(is_held, 0.0, logs - mean)
    optima = Optima(
        points,
        rays,
        information,
        *pose,
        scale_prior=options.scale_prior,
        free=options.estimated_unknowns,
        loss=LOSSES[options.loss],
        loss_scale=options.loss_scale,
        exact=exact,
        focal_offset=offset,
        focal_weight=weight,
    )
    step = optima.newton_step
    size = np.abs(step[:, [0, 1, 2, 6, 7, 8, 9]]).max(axis=1)
    step[~(valid & (size < _LARGEST_POLISH))] = 0.0
    valid, free = valid & optima.solved[1], optima.free
    covariance = np.zeros((len(valid), UNKNOWNS, UNKNOWNS))
    covariance[:, free[:, None], free] = optima.solved[0]  # the Hessian's inverse
    covariance[~valid] = 0.0
    values = FitValues(
        rotations_from_vectors(step[:, :3]) @ pose[0],
        pose[1] + step[:, 3:6],
        pose[2] * np.exp(step[:, 6:9]),
        focals * np.exp(step[:, 9]),
        covariance,
        valid,
    )
    return _Part(optima, by_pixels, batch.sigmas, values)


def _searched(
    points: FloatArray, batch: KeypointBatch, options: FitOptions
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Poses (B, 15) and focal lengths (B,) of the best minima, and for which problems (B,)."""
    present, cameras = batch.present, batch.cameras
    offsets = np.concatenate([[0], np.cumsum(present.sum(axis=1))]).astype(np.int64)
    problems = Problems(points[present], batch.pixels[present], offsets, cameras)
    sigmas = batch.sigmas[present]
    rows = [problems.rows(b) for b in range(len(points))]
    if options.focal == "estimate":
        found = [
            solve(problems.part(b, b + 1), replace(options, sigma=sigmas[own]))
            for b, own in enumerate(rows)
        ]
    elif len(cameras) > 1:
        found = [solve(problems, options, [sigmas[own] for own in rows])]
    else:  # those of all problems, one after the other
        found = [solve(problems, replace(options, sigma=sigmas))]
    valid = np.concatenate([each.solved for each in found])
    poses = np.concatenate([each.poses[:, 0] for each in found])
    poses = np.where(valid[:, None], poses, _NO_POSE)
    focals = np.array([camera.fx for camera in cameras]) * np.ones(len(points))
    if options.focal == "estimate":
        estimated = [np.nan if each.focals is None else each.focals[0, 0] for each in found]
        focals = np.where(valid, estimated, focals)
    return poses, focals, valid
