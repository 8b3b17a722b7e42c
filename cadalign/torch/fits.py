"""`fit`: alignments of a batch with gradients by keypoints, sigmas and model points.

The forward pass is the search of `cadalign.fit_batch`; a Newton step removes what its tolerance
leaves. The backward pass solves one linear system for each problem, vectorised over the batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import InputError
from cadalign.estimation.focal import USUAL, PriorOption, log_focal_range
from cadalign.estimation.options import LOSSES, FitOptions
from cadalign.estimation.problems import Problems
from cadalign.estimation.solve import solve
from cadalign.estimation.uncertainty.derivatives import (
    UNKNOWNS,
    Optima,
    PriorTerms,
    SeenKeypoints,
)
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import rotations_from_vectors
from cadalign.names import renamed
from cadalign.solvers.constants import OK
from cadalign.torch.keypoints import GivenTensors, KeypointBatch, as_array, expanded, in_threads
from cadalign.torch.library import torch
from cadalign.torch.poses import PoseBatch

if TYPE_CHECKING:
    from torch import Tensor

_LARGEST_POLISH = 0.02  # turn [rad] or change of a logarithm beyond which a step is no polish
_AT_BOUND = 1e-9
_HELD = 1e12  # information about a log focal length at its bound
_NO_POSE = np.array([1.0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1, 1, 1, 1])


@renamed(scale_prior_sigma="stretch_sigma")
def fit(
    points_3d: Tensor,
    points_2d: Tensor,
    camera: Camera | Sequence[Camera],
    *,
    sigma: Tensor | float = 1.0,
    mask: Tensor | None = None,
    loss: str = "linear",
    loss_scale: float = 2.0,
    stretch: str | None = None,
    stretch_sigma: float | None = None,
    known_axis: str = "x",
    focal: str = "known",
    focal_prior: PriorOption = USUAL,
    exact: bool = True,
    workers: int = -1,
) -> PoseBatch:
    """Fit a batch of models to their keypoints, as `cadalign.fit` does, with gradients.

    Problems without a solution do not raise: ``valid`` of the result marks the others. Gradients
    are those of the optimum, by ``points_2d``, ``sigma`` and ``points_3d``; there are no second
    ones.

    Parameters
    ----------
    points_3d : (n, 3) or (B, n, 3) tensor
        Keypoints on the models [model units].
    points_2d : (B, n, 2) tensor
        The same keypoints in the images [px]. Its precision is the result's; the search itself is
        in double precision, on the processor.
    camera : Camera or sequence of B Camera
    sigma : float or tensor that expands to (B, n)
        Standard deviations of the keypoints [px].
    mask : (B, n) bool tensor, optional
        Marks the keypoints that are present. Those that are not finite count as absent.
    loss, loss_scale, stretch, stretch_sigma, known_axis, focal, focal_prior
        As for `cadalign.fit`; with ``focal="estimate"`` all images have one size.
    exact : bool
        Take the cost's Hessian for the gradients, otherwise its Gauss-Newton matrix.
    workers : int
        Number of threads that share the problems; -1 for all cores.

    Returns
    -------
    PoseBatch

    Raises
    ------
    InputError
        If a shape or an option is wrong, or a lens is a wide one.

    Examples
    --------
    >>> import torch
    >>> corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0]).double()] * 3)
    >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
    >>> true = PoseBatch(torch.eye(3)[None].double(), torch.tensor([[0.1, 0.2, 5.0]]).double(),
    ...                  torch.tensor([[1.0, 1.2, 0.8]]).double())
    >>> seen = true.project(corners, camera).requires_grad_()
    >>> found = fit(corners, seen, camera)
    >>> found.scale.detach().round(decimals=3).tolist()
    [[1.0, 1.2, 0.8]]
    >>> found.translation.sum().backward()
    >>> seen.grad.shape
    torch.Size([1, 8, 2])
    """
    options = FitOptions(
        "optimal",
        1.0,
        loss,
        loss_scale,
        stretch,
        stretch_sigma,
        known_axis,
        focal,
        focal_prior,
    )
    given = GivenTensors.of(points_2d, camera, sigma, mask)
    models = expanded(points_3d, (*points_2d.shape[:2], 3), "points_3d")
    task = _FitTask(given.cameras, given.mask.numpy(), options, exact, workers)
    found = _layer().apply(models, points_2d, given.sigma, task)
    rotation, translation, scale, focals, covariance, valid = found
    estimated = focals if focal == "estimate" else None
    return PoseBatch(rotation, translation, scale, valid, estimated, covariance=covariance)


@dataclass(frozen=True, eq=False)
class _FitTask:
    """Input of a fit beside tensors."""

    cameras: tuple[Camera, ...]
    mask: BoolArray
    options: FitOptions
    exact: bool
    workers: int


@dataclass(frozen=True, eq=False)
class _Fits:
    """Fits of some problems, their optima before the polish, and which of them are valid (B,).

    ``by_pixels`` (B, n, 2, 2) are the derivatives of the optima's rays by the pixels.
    """

    optima: Optima
    by_pixels: FloatArray
    sigmas: FloatArray
    rotation: FloatArray
    translation: FloatArray
    scale: FloatArray
    focals: FloatArray
    valid: BoolArray

    @property
    def covariance(self) -> FloatArray:
        """Inverse of the Hessian (B, 10, 10) of all unknowns."""
        free = self.optima.free
        covariance = np.zeros((len(self.valid), UNKNOWNS, UNKNOWNS))
        covariance[:, free[:, None], free] = self.optima.inverse
        covariance[~self.valid] = 0.0
        return covariance

    def pulled_back(
        self,
        by_rotation: FloatArray,
        by_translation: FloatArray,
        by_scale: FloatArray,
        by_focal: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Slopes by points, pixels and sigmas from those by what the layer returns."""
        slopes = np.empty((len(by_focal), UNKNOWNS))
        slopes[:, :3] = np.cross(self.rotation, by_rotation, axis=1).sum(axis=2)
        slopes[:, 3:6] = by_translation
        slopes[:, 6:9] = by_scale * self.scale
        slopes[:, 9] = by_focal * self.focals
        slopes[~self.valid] = 0.0
        pulled = self.optima.pull_back(slopes)
        by_pixels = (pulled.by_rays[..., None, :] @ self.by_pixels)[..., 0, :]
        return pulled.by_points, by_pixels, pulled.by_log_sigma / self.sigmas


@cache
def _layer() -> Any:
    """The autograd function; PyTorch is there once it is asked for."""

    class FitLayer(torch.autograd.Function):
        """Fits of a batch."""

        @staticmethod
        def forward(
            ctx: Any, points_3d: Tensor, points_2d: Tensor, sigma: Tensor, task: _FitTask
        ) -> tuple[Tensor, ...]:
            given = points_3d, points_2d, sigma
            ctx.kinds = [(each.device, each.dtype) for each in given]
            ctx.parts = _all_fits(task, *map(as_array, given))
            names = "rotation", "translation", "scale", "focals", "covariance", "valid"
            arrays = [np.concatenate([getattr(each, name) for each in ctx.parts]) for name in names]
            tensors = [torch.as_tensor(each).to(points_2d) for each in arrays[:-1]]
            valid = torch.as_tensor(arrays[-1], device=points_2d.device)
            ctx.mark_non_differentiable(tensors[-1], valid)
            return (*tensors, valid)

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
            given = [as_array(each) for each in slopes[:4]]
            ends = np.cumsum([len(each.valid) for each in ctx.parts])

            pulled = [
                part.pulled_back(*(each[end - len(part.valid) : end] for each in given))
                for part, end in zip(ctx.parts, ends, strict=True)
            ]
            arrays = [np.concatenate(each) for each in zip(*pulled, strict=True)]
            kinds = zip(arrays, ctx.kinds, strict=True)
            return (*(torch.as_tensor(each).to(*kind) for each, kind in kinds), None)

    return FitLayer


def _all_fits(
    task: _FitTask, points: FloatArray, pixels: FloatArray, sigmas: FloatArray
) -> list[_Fits]:
    """Fits of a batch, in the parts that the threads share."""
    options = task.options
    if options.focal == "estimate":
        if len({(each.width, each.height) for each in task.cameras}) > 1:
            what = "with an unknown focal length all images must have one size"
            raise InputError(what, where="camera", fix="call fit for each size")
        if any(each.distortion for each in task.cameras):
            what = "an unknown focal length and lens distortion have no gradients together"
            raise InputError(what, where="focal", fix="undistort keypoints and camera first")
        options = options.for_camera(task.cameras[0])

    @np.errstate(all="ignore")  # holds for one thread only
    def run(first: int, last: int) -> _Fits:
        some = slice(first, last)
        cameras = task.cameras if len(task.cameras) == 1 else task.cameras[some]
        present = task.mask[some] & np.isfinite(points[some]).all(axis=2)
        batch = KeypointBatch.of(pixels[some], sigmas[some], present, cameras)
        known = np.where(batch.present[..., None], points[some], 0.0)
        return _fits_of(known, batch, options, task.exact)

    return in_threads(run, len(points), task.workers)


def _fits_of(points: FloatArray, batch: KeypointBatch, options: FitOptions, exact: bool) -> _Fits:
    """The fits of some problems, polished by a Newton step.

    The derivatives are those before it: it is far below the noise.
    """
    poses, focals, valid = _solved(points, batch, options)
    pose = poses[:, :9].reshape(-1, 3, 3), poses[:, 9:12], poses[:, 12:]
    given = np.array([camera.fx for camera in batch.cameras])
    ratio = (focals / given)[:, None, None]
    prior = PriorTerms(options.scale_prior)
    rays, information, by_pixels = batch.rays, batch.information, batch.by_pixels
    if options.focal == "estimate":
        rays, by_pixels = rays / ratio, by_pixels / ratio[..., None]
        information = information * ratio[..., None] ** 2
        low, high, mean, weight = log_focal_range(batch.cameras[0], options.focal_prior)
        logs = np.log(focals)
        is_held = (logs < low + _AT_BOUND) | (logs > high - _AT_BOUND)
        weights = np.where(is_held, _HELD, weight)
        prior = PriorTerms(options.scale_prior, np.where(is_held, 0.0, logs - mean), weights)
    loss, bend = LOSSES[options.loss], options.loss_scale
    keypoints = SeenKeypoints(points, rays, information, loss, bend)
    optima = Optima(keypoints, *pose, prior, options.estimated_unknowns, exact)
    step = optima.newton_step
    size = np.abs(step[:, [0, 1, 2, 6, 7, 8, 9]]).max(axis=1)
    step[~(valid & (size < _LARGEST_POLISH))] = 0.0
    return _Fits(
        optima,
        by_pixels,
        batch.sigmas,
        rotations_from_vectors(step[:, :3]) @ pose[0],
        pose[1] + step[:, 3:6],
        pose[2] * np.exp(step[:, 6:9]),
        focals * np.exp(step[:, 9]),
        valid & optima.determined,
    )


def _solved(
    points: FloatArray, batch: KeypointBatch, options: FitOptions
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Poses (B, 15) and focal lengths (B,) of the best minima, and which problems have one."""
    present, cameras = batch.present, batch.cameras
    offsets = np.concatenate([[0], np.cumsum(batch.counts)]).astype(np.int64)
    problems = Problems(points[present], batch.pixels[present], offsets, cameras)
    sigmas, each = batch.sigmas[present], None
    if len(cameras) > 1 or options.focal == "estimate":
        each = [sigmas[problems.rows(b)] for b in range(len(points))]
    else:  # those of all problems, one after the other
        options = replace(options, sigma=sigmas)
    found = solve(problems, options, each)
    valid = (found.statuses == OK) & np.isfinite(found.poses[:, 0]).all(axis=1)
    valid[list(found.errors)] = False
    poses = np.where(valid[:, None], found.poses[:, 0], _NO_POSE)
    focals = np.array([camera.fx for camera in cameras]) * np.ones(len(points))
    if found.focals is not None:
        focals = np.where(valid, found.focals[:, 0], focals)
    return poses, focals, valid
