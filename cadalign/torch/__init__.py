"""Alignment as a differentiable PyTorch function: `fit`.

Gradients flow to keypoints, sigmas and model points, by the implicit function theorem at the
optimum. Fits run on the CPU, in the compiled kernels. Needs the extra ``torch``:
``pip install "cadalign[torch]"``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from cadalign.arrays import is_number
from cadalign.errors import InputError, require_kind
from cadalign.estimation.options import FitOptions
from cadalign.geometry.camera import Camera

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["PoseBatch", "fit"]


@dataclass(frozen=True, eq=False)
class PoseBatch:
    """Alignments of B objects, with gradients.

    A model point x has the normalised image coordinates (u, v) of
    ``depth (u, v, 1) = rotation diag(scale) x + translation``, in OpenCV's camera axes.

    Parameters
    ----------
    rotation : (B, 3, 3) tensor
    translation : (B, 3) tensor
        [model units].
    scale : (B, 3) tensor
        Stretch along x, y and z.
    valid : (B,) bool tensor
        True where a solution exists and the keypoints determine it. Elsewhere gradients are 0. A
        problem without a solution has an identity rotation, translation (0, 0, 1) and scale 1.
    covariance : (B, 9, 9) tensor
        Inverse of the cost's Hessian, without gradients, in the order of
        `cadalign.Result.covariance`. Entries of fixed unknowns and of invalid problems are 0.
    """

    rotation: Tensor
    translation: Tensor
    scale: Tensor
    valid: Tensor
    covariance: Tensor

    def apply(self, points_3d: Tensor) -> Tensor:
        """Transform model points (n, 3) or (B, n, 3) to camera coordinates (B, n, 3)."""
        stretched = points_3d.to(self.scale) * self.scale[..., None, :]
        return stretched @ self.rotation.mT + self.translation[..., None, :]


def fit(
    points_3d: Tensor,
    points_2d: Tensor,
    camera: Camera | Sequence[Camera],
    *,
    sigma: Tensor | float = 1.0,
    mask: Tensor | None = None,
    loss: str = FitOptions.loss,
    loss_scale: float = FitOptions.loss_scale,
    stretch: str | None = FitOptions.stretch,
    stretch_sigma: float | None = FitOptions.stretch_sigma,
    workers: int = -1,
) -> PoseBatch:
    """Fit a batch of models to their keypoints, as `cadalign.fit` does, with gradients.

    Gradients flow to ``points_2d``, ``sigma`` and ``points_3d``. Second derivatives and
    `torch.func` (``grad``, ``vmap``) are not supported. A problem without a solution does not
    raise: its entry of ``valid`` is False.

    Parameters
    ----------
    points_3d : (n, 3) or (B, n, 3) tensor
        Keypoints on the models [model units].
    points_2d : (B, n, 2) tensor
        The same keypoints in the images [px]. The result has the dtype and the device of this
        tensor. The search runs in double precision, on the CPU.
    camera : Camera or sequence of B Camera
    sigma : float or tensor that expands to (B, n)
        Standard deviations of the keypoints [px].
    mask : (B, n) bool tensor, optional
        True for the keypoints to use. A keypoint that is not finite, or whose sigma is not
        positive, is ignored.
    loss, loss_scale, stretch, stretch_sigma
        As for `cadalign.fit`.
    workers : int
        Number of threads; -1 for all cores.

    Returns
    -------
    PoseBatch

    Raises
    ------
    InputError
        If a type, a shape or an option is wrong, a focal length is unknown, or a lens is wide
        (`cadalign.Camera.is_wide`).

    Examples
    --------
    >>> import numpy as np
    >>> import torch
    >>> from cadalign import Alignment
    >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
    >>> seen = camera.project(Alignment(np.eye(3), [0.1, 0.2, 5], [1, 1.2, 0.8]).apply(corners))
    >>> pixels = torch.tensor(seen[None], requires_grad=True)
    >>> found = fit(torch.tensor(corners), pixels, camera)
    >>> found.scale.detach().round(decimals=3).tolist()
    [[1.0, 1.2, 0.8]]
    >>> found.translation.sum().backward()
    >>> pixels.grad.shape
    torch.Size([1, 8, 2])
    """
    # PyTorch is an optional dependency.
    from cadalign.torch.layer import FitTask, solve_optima

    options = FitOptions(
        loss=loss, loss_scale=loss_scale, stretch=stretch, stretch_sigma=stretch_sigma
    )
    _check_pixels(points_2d)
    shape = tuple(points_2d.shape[:2])
    sigma = points_2d.new_tensor(float(sigma)) if is_number(sigma) else sigma
    mask = points_2d.new_tensor(True, dtype=bool) if mask is None else mask
    _require_tensor(sigma, "sigma", fix="give a number or a tensor [px]")
    found = solve_optima(
        FitTask(_cameras(camera, len(points_2d)), options, workers),
        _expand(points_3d, (*shape, 3), "points_3d").double().cpu(),
        points_2d.double().cpu(),
        _expand(sigma, shape, "sigma").double().cpu(),
        _expand(mask, shape, "mask").bool().cpu(),
    )
    rotation, translation, scale, covariance = (each.to(points_2d) for each in found[:4])
    valid = found.valid.to(points_2d.device)
    return PoseBatch(rotation, translation, scale, valid, covariance)


def _cameras(camera: Camera | Sequence[Camera], count: int) -> tuple[Camera, ...]:
    """Cameras as a tuple: one for all problems, or ``count``; otherwise raise InputError."""
    cameras = tuple(camera) if isinstance(camera, Iterable) else (camera,)
    for each in cameras:
        require_kind(each, Camera, "camera")
    if len(cameras) not in (1, count):
        what = f"{len(cameras)} cameras for {count} problems"
        raise InputError(what, where="camera", fix="give one camera, or one per problem")
    return cameras


def _check_pixels(points_2d: Tensor) -> None:
    _require_tensor(points_2d, "points_2d")
    if not points_2d.is_floating_point():  # the result has its dtype
        what = f"expected floating point numbers, got {points_2d.dtype}"
        raise InputError(what, where="points_2d", fix="give points_2d.double()")
    if points_2d.ndim != 3 or points_2d.shape[2] != 2:
        what = f"shape {tuple(points_2d.shape)}, expected (B, n, 2)"
        raise InputError(what, where="points_2d")


def _require_tensor(
    value: object, where: str, *, fix: str = "convert it with torch.as_tensor(...)"
) -> None:
    from torch import Tensor

    if not isinstance(value, Tensor):
        what = f"expected a tensor, got {type(value).__name__}"
        raise InputError(what, where=where, fix=fix)


def _expand(tensor: Tensor, shape: tuple[int, ...], where: str) -> Tensor:
    _require_tensor(tensor, where)
    try:
        return tensor.expand(shape)
    except RuntimeError:
        what = f"shape {tuple(tensor.shape)} does not expand to {shape}"
        raise InputError(what, where=where) from None
