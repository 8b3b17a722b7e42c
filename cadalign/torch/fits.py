"""Fits of a batch with their derivatives: what the layer of PyTorch needs.

The forward pass is the search of `cadalign.fit_batch`; a Newton step removes what its tolerance
leaves. The backward pass solves one linear system for each problem, vectorised over the batch.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.fit import fit_once
from cadalign.estimation.options import LOSSES, FitOptions
from cadalign.estimation.prior import log_focal_range
from cadalign.estimation.problems import Problems, in_threads, joined, rays_of
from cadalign.estimation.solve import are_solved_at_once, solve
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import rotations_from_vectors
from cadalign.solvers.constants import OK
from cadalign.torch.derivatives import UNKNOWNS, Optima, lens_slopes

_LARGEST_POLISH = 0.02  # turn [rad] or change of a logarithm beyond which a step is no polish
_AT_BOUND = 1e-9
_HELD = 1e12  # information about a log focal length at its bound
_NO_POSE = np.array([1.0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1, 1, 1, 1])


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
    """Fits of a batch, and their optima before a Newton step.

    ``by_pixels`` (B, n, 2, 2) are the derivatives of the optima's rays by the pixels.
    """

    values: FitValues
    optima: Optima
    by_pixels: FloatArray
    sigmas: FloatArray

    def pulled_back(
        self,
        by_rotation: FloatArray,
        by_translation: FloatArray,
        by_scale: FloatArray,
        by_focal: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Slopes by points, pixels and sigmas from those by rotation, translation, scale, focal."""
        values, slopes = self.values, np.empty((len(by_focal), UNKNOWNS))
        slopes[:, :3] = np.cross(values.rotation, by_rotation, axis=1).sum(axis=2)
        slopes[:, 3:6] = by_translation
        slopes[:, 6:9] = by_scale * values.scale
        slopes[:, 9] = by_focal * values.focal
        slopes[~values.valid] = 0.0
        by_rays, by_log_sigma, by_points = self.optima.pull_back(slopes)
        by_pixels = (by_rays[..., None, :] @ self.by_pixels)[..., 0, :]
        return by_points, by_pixels, by_log_sigma / self.sigmas


@np.errstate(all="ignore")
def fits_of(
    task: FitTask,
    points: FloatArray,
    pixels: FloatArray,
    sigmas: FloatArray,
    mask: BoolArray,
) -> BatchFits:
    """The fits of a batch, polished by a Newton step.

    Points (B, n, 3), pixels (B, n, 2), sigmas and mask (B, n). The derivatives are those before the
    step: it is far below the noise.
    """
    options, cameras = task.options, task.cameras
    if options.focal == "estimate":
        options = options.for_camera(cameras[0])
    present = mask & np.isfinite(points).all(axis=2) & np.isfinite(pixels).all(axis=2)
    present &= np.isfinite(sigmas) & (sigmas > 0)
    points, pixels = (np.where(present[..., None], each, 0.0) for each in (points, pixels))
    sigmas = np.where(present, sigmas, 1.0)
    rays, by_pixels = _rays(pixels, present, cameras)
    information = _information(by_pixels, present, sigmas)
    poses, focals, valid = _searched(task, options, points, pixels, sigmas, present)
    pose = poses[:, :9].reshape(-1, 3, 3), poses[:, 9:12], poses[:, 12:]
    ratio = (focals / np.array([camera.fx for camera in cameras]))[:, None, None]
    offset = weight = np.zeros(len(focals))
    if options.focal == "estimate":
        rays, by_pixels = rays / ratio, by_pixels / ratio[..., None]
        information = information * ratio[..., None] ** 2
        low, high, mean, of_prior = log_focal_range(cameras[0], options.focal_prior)
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
        exact=task.exact,
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
    return BatchFits(values, optima, by_pixels, sigmas)


def _rays(
    pixels: FloatArray, present: BoolArray, cameras: tuple[Camera, ...]
) -> tuple[FloatArray, FloatArray]:
    """Rays (B, n, 2) of pixels, and their derivatives (B, n, 2, 2) by these."""
    rays, by_pixels = np.zeros_like(pixels), np.zeros((*present.shape, 2, 2))
    for b, camera in enumerate(cameras):
        own = slice(None) if len(cameras) == 1 else slice(b, b + 1)
        flat = np.ascontiguousarray(pixels[own].reshape(-1, 2))
        if camera.distortion:
            flat[~present[own].ravel()] = camera.cx, camera.cy
        seen = rays_of(flat, camera)
        rays[own] = seen.reshape(rays[own].shape)
        by_pixels[own] = lens_slopes(seen, camera).reshape(by_pixels[own].shape)
    return rays, by_pixels


def _information(by_pixels: FloatArray, present: BoolArray, sigmas: FloatArray) -> FloatArray:
    """Information (B, n, 2, 2) of the rays; 0 for those that are absent."""
    (a, b), (c, d) = by_pixels.transpose(2, 3, 0, 1)
    weights = present / (sigmas * (a * d - b * c)) ** 2
    mixed = -weights * (a * c + b * d)  # of the inverse's columns; NumPy's takes thrice as long
    rows = [weights * (c * c + d * d), mixed], [mixed, weights * (a * a + b * b)]
    return np.ascontiguousarray(np.array(rows).transpose(2, 3, 0, 1))


def _searched(
    task: FitTask,
    options: FitOptions,
    points: FloatArray,
    pixels: FloatArray,
    sigmas: FloatArray,
    present: BoolArray,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Poses (B, 15) and focal lengths (B,) of the best minima, and for which problems (B,)."""
    cameras = task.cameras * (len(points) if len(task.cameras) == 1 else 1)
    problems = [
        Problems(points[b, kept], pixels[b, kept], np.array([0, kept.sum()]), cameras[b])
        for b, kept in enumerate(present)
    ]
    focals = np.array([camera.fx for camera in task.cameras]) * np.ones(len(points))
    poses, valid = np.tile(_NO_POSE, (len(points), 1)), np.zeros(len(points), dtype=bool)

    def fit_alone(b: int) -> None:
        part = replace(options, sigma=sigmas[b, present[b]])
        with suppress(CadalignError):
            found = fit_once(problems[b], part, None, None, 0.0)
            poses[b], focals[b], valid[b] = found.alignment.packed, found.camera.fx, True

    @np.errstate(all="ignore")  # holds for one thread only
    def run(first: int, last: int) -> None:
        if not are_solved_at_once(problems, options):
            for b in range(first, last):
                fit_alone(b)
            return
        part = replace(options, sigma=sigmas[first:last][present[first:last]])
        found = solve(joined(problems[first:last]), part)
        solved = first + np.flatnonzero(found.statuses == OK)
        poses[solved], valid[solved] = found.poses[solved - first, 0], True

    in_threads(run, len(points), task.workers)
    return poses, focals, valid
