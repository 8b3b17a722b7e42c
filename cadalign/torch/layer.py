"""Optima of a batch of problems, with their derivatives by the data.

The search of `cadalign.fit_batch` finds the optimum t of data d. There half the gradient of the
cost vanishes: ``g(t, d) = 0``. The implicit function theorem gives ``dt/dd = -H^-1 dg/dd``, with
``H = dg/dt`` (for PnP: Chen et al., *End-to-end learnable geometric vision by backpropagating PnP
optimization*, CVPR 2020). The Newton step ``t - H^-1 g(t, d)`` with a constant H has the same
derivatives, so PyTorch differentiates this step. It also removes the error that the search's
tolerance leaves.

The unknowns t are ordered as in `cadalign.Result.covariance`: rotation vector in the camera frame,
translation, log scales.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.fit import fit_once
from cadalign.estimation.options import FitOptions
from cadalign.estimation.problems import Problems, join_problems, rays_of, run_in_threads
from cadalign.estimation.solve import are_solved_at_once, solve
from cadalign.geometry.camera import Camera
from cadalign.solvers.constants import OK

try:
    import torch
    from torch import Tensor
except ImportError:
    raise CadalignError(
        "PyTorch is not installed", where="cadalign.torch", fix="pip install 'cadalign[torch]'"
    ) from None

_UNKNOWNS = 9
_LARGEST_POLISH = 0.02  # largest rotation [rad] or log scale of a Newton step that is applied
_IDENTITY_POSE = np.array([1.0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1, 1, 1, 1])
_LEAST_DEPTH = 1e-9  # replaces smaller and negative depths
_LEAST_SHARE = 1e-10  # least information about an unknown given the others, relative to its own


class Optima(NamedTuple):
    """Fits of B problems. Covariance (B, 9, 9) and ``valid`` have no derivatives."""

    rotation: Tensor  # (B, 3, 3)
    translation: Tensor  # (B, 3)
    scale: Tensor  # (B, 3)
    covariance: Tensor
    valid: Tensor  # (B,) bool


@dataclass(frozen=True, eq=False)
class FitTask:
    """Cameras and options of a batch of fits: one camera for all, or one per problem.

    Raises InputError for a wide lens or an unknown focal length.
    """

    cameras: tuple[Camera, ...]
    options: FitOptions
    workers: int

    def __post_init__(self) -> None:
        if any(each.is_wide for each in self.cameras):
            what = "gradients are not implemented for wide lenses"
            raise InputError(what, where="camera", fix="undistort keypoints and camera first")
        if not all(each.focal_known for each in self.cameras):
            what = "the focal length is unknown"
            raise InputError(what, where="camera", fix="give it: camera.replace_focal(...)")


class _FirstOrder(torch.autograd.Function):
    """Identity that refuses a second derivative, since the Newton step treats H as constant."""

    @staticmethod
    def forward(ctx: Any, data: Tensor) -> Tensor:
        return data.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, slopes: Tensor) -> Tensor:
        return slopes


@np.errstate(all="ignore")
def solve_optima(
    task: FitTask, points: Tensor, pixels: Tensor, sigmas: Tensor, mask: Tensor
) -> Optima:
    """Solve for points (B, n, 3), pixels (B, n, 2), sigmas and mask (B, n), in double precision.

    Derivatives are taken before the Newton step, which is far below the noise.
    """
    options = task.options
    points, pixels, sigmas = map(_FirstOrder.apply, (points, pixels, sigmas))
    present = mask & points.isfinite().all(2) & pixels.isfinite().all(2)
    present &= sigmas.isfinite() & (sigmas > 0)
    points, pixels = (torch.where(present[..., None], each, 0.0) for each in (points, pixels))
    sigmas = torch.where(present, sigmas, 1.0)
    given = [each.detach().numpy() for each in (points, pixels, sigmas, present)]
    poses, found = _search(task, *given)
    cost = _Cost(task, poses, given[1], given[3])
    with torch.enable_grad():  # the Hessian needs it, even under torch.no_grad
        step = torch.zeros(len(poses), _UNKNOWNS, dtype=torch.float64, requires_grad=True)
        total = cost.half_cost(step, points, pixels, sigmas)
        (gradient,) = torch.autograd.grad(total, step, create_graph=True)
        free = torch.as_tensor(options.estimated_unknowns)
        rows = [
            torch.autograd.grad(gradient[:, k].sum(), step, retain_graph=True)[0]
            for k in free.tolist()
        ]
    inverse, determined = _invert(torch.stack(rows, 1)[:, :, free])
    valid = determined & torch.as_tensor(found)
    covariance = torch.zeros(len(poses), _UNKNOWNS, _UNKNOWNS, dtype=torch.float64)
    covariance[:, free[:, None], free] = inverse
    covariance[~valid] = 0.0
    gradient = torch.where(valid[:, None], gradient, 0.0)
    if not any(each.requires_grad for each in (points, pixels, sigmas)):
        gradient = gradient.detach()
    polish = -(covariance @ gradient[..., None])[..., 0]
    is_small = polish.detach()[:, [0, 1, 2, 6, 7, 8]].abs().amax(1) < _LARGEST_POLISH
    # A larger step is not applied, but keeps its derivatives.
    polish = polish - torch.where(is_small[:, None], 0.0, polish.detach())
    return Optima(
        torch.linalg.matrix_exp(_cross_matrices(polish[:, :3])) @ cost.rotation,
        cost.translation + polish[:, 3:6],
        cost.scale * polish[:, 6:9].exp(),
        covariance,
        valid,
    )


class _Cost:
    """Half the cost as a function of a step from the optima and of the data."""

    def __init__(
        self, task: FitTask, poses: FloatArray, pixels: FloatArray, present: BoolArray
    ) -> None:
        self._options = task.options
        packed, self._present = torch.as_tensor(poses), torch.as_tensor(present)
        self.rotation, self.translation = packed[:, :9].reshape(-1, 3, 3), packed[:, 9:12]
        self.scale = packed[:, 12:]
        rays, by_rays = _rays(pixels, present, task.cameras)
        self._rays, self._by_rays = torch.as_tensor(rays), torch.as_tensor(by_rays)
        self._pixels = torch.as_tensor(pixels)

    def half_cost(self, step: Tensor, points: Tensor, pixels: Tensor, sigmas: Tensor) -> Tensor:
        """Half the total cost, exact to second order in the step (B, 9)."""
        turn = _cross_matrices(step[:, :3])
        turned = self.rotation + turn @ self.rotation + turn @ turn @ self.rotation / 2
        scale = self.scale * step[:, 6:9].exp()
        center = self.translation + step[:, 3:6]
        in_camera = (points * scale[:, None]) @ turned.mT + center[:, None]
        rays = in_camera[..., :2] / in_camera[..., 2:].clamp(min=_LEAST_DEPTH)
        errors = (self._by_rays @ (rays - self._rays)[..., None])[..., 0] - (pixels - self._pixels)
        squares = (errors**2).sum(-1) / sigmas**2
        total = torch.where(self._present, self._apply_loss(squares), 0.0).sum()
        prior = self._options.scale_prior
        logs = scale.log()
        beyond = logs - logs.clamp(-prior.width, prior.width)
        return (total + prior.weight * (beyond**2).sum()) / 2

    def _apply_loss(self, squares: Tensor) -> Tensor:
        bend = self._options.loss_scale
        if self._options.loss == "huber":
            outer = 2 * bend * squares.clamp(min=bend**2).sqrt() - bend**2
            return torch.where(squares > bend**2, outer, squares)
        if self._options.loss == "cauchy":
            return bend**2 * (squares / bend**2).log1p()
        return squares


def _cross_matrices(vectors: Tensor) -> Tensor:
    """Cross product matrices (B, 3, 3): ``matrix @ x = cross(vector, x)`` for vectors (B, 3)."""
    x, y, z = vectors.unbind(1)
    rows = [torch.zeros_like(x), -z, y, z, torch.zeros_like(x), -x, -y, x, torch.zeros_like(x)]
    return torch.stack(rows, 1).reshape(-1, 3, 3)


def _invert(hessian: Tensor) -> tuple[Tensor, Tensor]:
    """Invert H (B, u, u); also return where the data determine all unknowns (B,).

    The inverse is 0 where H is nearly singular or not positive definite.
    """
    diagonal = hessian.diagonal(dim1=1, dim2=2)
    usable = (diagonal > 0).all(1) & hessian.isfinite().all(2).all(1)
    root = torch.where(usable[:, None], diagonal, 1.0).sqrt()
    scales = root[:, :, None] * root[:, None, :]
    scaled = torch.where(usable[:, None, None], hessian / scales, torch.eye(hessian.shape[1]))
    inverse, failed = torch.linalg.inv_ex(scaled)
    shares = inverse.diagonal(dim1=1, dim2=2)
    determined = usable & (failed == 0) & ((shares > 0) & (shares < 1 / _LEAST_SHARE)).all(1)
    return torch.where(determined[:, None, None], inverse / scales, 0.0), determined


def _rays(
    pixels: FloatArray, present: BoolArray, cameras: tuple[Camera, ...]
) -> tuple[FloatArray, FloatArray]:
    """Rays (B, n, 2) of pixels, and the derivatives (B, n, 2, 2) of pixels by rays."""
    rays, by_rays = np.zeros_like(pixels), np.zeros((*present.shape, 2, 2))
    for b, camera in enumerate(cameras):
        own = slice(None) if len(cameras) == 1 else slice(b, b + 1)
        flat = np.ascontiguousarray(pixels[own].reshape(-1, 2))
        if camera.distortion:
            flat[~present[own].ravel()] = camera.cx, camera.cy
        seen = rays_of(flat, camera)
        slopes = np.diag([camera.fx, camera.fy]) @ camera.distortion_jacobian(seen)
        rays[own], by_rays[own] = seen.reshape(rays[own].shape), slopes.reshape(by_rays[own].shape)
    return rays, by_rays


def _search(
    task: FitTask, points: FloatArray, pixels: FloatArray, sigmas: FloatArray, present: BoolArray
) -> tuple[FloatArray, BoolArray]:
    """Packed poses (B, 15) of the best minima, and True where one was found (B,)."""
    cameras, options = task.cameras * (len(points) if len(task.cameras) == 1 else 1), task.options
    problems = [
        Problems(points[b, kept], pixels[b, kept], np.array([0, kept.sum()]), cameras[b])
        for b, kept in enumerate(present)
    ]
    poses, valid = np.tile(_IDENTITY_POSE, (len(points), 1)), np.zeros(len(points), dtype=bool)

    def fit_alone(b: int) -> None:
        part = replace(options, sigma=sigmas[b, present[b]])
        with suppress(CadalignError):
            poses[b] = fit_once(problems[b], part, None, None, 0.0).alignment.vector
            valid[b] = True

    @np.errstate(all="ignore")  # NumPy keeps this state per thread
    def run(first: int, last: int) -> None:
        if not are_solved_at_once(problems, options):
            for b in range(first, last):
                fit_alone(b)
            return
        part = replace(options, sigma=sigmas[first:last][present[first:last]])
        found = solve(join_problems(problems[first:last]), part)
        solved = first + np.flatnonzero(found.statuses == OK)
        poses[solved], valid[solved] = found.poses[solved - first, 0], True

    run_in_threads(run, len(points), task.workers)
    return poses, valid
