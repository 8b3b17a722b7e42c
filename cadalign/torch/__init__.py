"""Alignment in PyTorch programs: `fit`, with gradients by keypoints, sigmas and model points.

Needs the extra ``torch``: ``pip install "cadalign[torch]"``. Fits run in the compiled kernels,
on the processor; gradients are those of the optimum, by the implicit function theorem.
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

    ``depth (u, v, 1) = rotation diag(scale) x + translation`` in OpenCV's camera axes.

    Parameters
    ----------
    rotation : (B, 3, 3) tensor
    translation : (B, 3) tensor
        [model units].
    scale : (B, 3) tensor
        Stretch along x, y and z.
    valid : (B,) bool tensor
        Marks the estimates that exist and that the keypoints determine; the others have no
        gradients, and those that do not exist are an identity.
    covariance : (B, 9, 9) tensor
        Inverse of the cost's Hessian, without gradients, in the order of
        `cadalign.Result.covariance`; 0 for what is held or not determined.
    """

    rotation: Tensor
    translation: Tensor
    scale: Tensor
    valid: Tensor
    covariance: Tensor

    def apply(self, points_3d: Tensor) -> Tensor:
        """Model points (n, 3) or (B, n, 3) in the cameras; (B, n, 3) tensor."""
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

    Problems without a solution do not raise: ``valid`` of the result marks the others. Gradients
    are those of the optimum, by ``points_2d``, ``sigma`` and ``points_3d``; there are no second
    ones, and `torch.func` (``grad``, ``vmap``) does not pass: a batch is what ``vmap`` would make.

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
        Marks the keypoints that are present. Those that are not finite, or whose sigma is not
        positive, count as absent.
    loss, loss_scale, stretch, stretch_sigma
        As for `cadalign.fit`.
    workers : int
        Number of threads that share the problems; -1 for all cores.

    Returns
    -------
    PoseBatch

    Raises
    ------
    InputError
        If a type, a shape or an option is wrong, a focal length is unknown, or a lens is a wide
        one.

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
    # PyTorch, an extra, is imported when it is wanted.
    from cadalign.torch.layer import FitTask, optima_of

    options = FitOptions(
        loss=loss, loss_scale=loss_scale, stretch=stretch, stretch_sigma=stretch_sigma
    )
    _check_pixels(points_2d)
    shape = tuple(points_2d.shape[:2])
    sigma = points_2d.new_tensor(float(sigma)) if is_number(sigma) else sigma
    mask = points_2d.new_tensor(True, dtype=bool) if mask is None else mask
    _require_tensor(sigma, "sigma", fix="give a number or a tensor, standard deviations in pixels")
    found = optima_of(
        FitTask(_cameras(camera, len(points_2d)), options, workers),
        _expanded(points_3d, (*shape, 3), "points_3d").double().cpu(),
        points_2d.double().cpu(),
        _expanded(sigma, shape, "sigma").double().cpu(),
        _expanded(mask, shape, "mask").bool().cpu(),
    )
    rotation, translation, scale, covariance = (each.to(points_2d) for each in found[:4])
    valid = found.valid.to(points_2d.device)
    return PoseBatch(rotation, translation, scale, valid, covariance)


def _cameras(camera: Camera | Sequence[Camera], count: int) -> tuple[Camera, ...]:
    """The camera of all, or those of ``count`` problems.

    Raises InputError if it is neither one nor as many.
    """
    cameras = tuple(camera) if isinstance(camera, Iterable) else (camera,)
    for each in cameras:
        require_kind(each, Camera, "camera")
    if len(cameras) not in (1, count):
        what = f"{len(cameras)} cameras for {count} problems"
        raise InputError(what, where="camera", fix="give one, or one for each problem")
    return cameras


def _check_pixels(points_2d: Tensor) -> None:
    _require_tensor(points_2d, "points_2d")
    if not points_2d.is_floating_point():  # the estimates are of its type
        what = f"expected floating point numbers, got {points_2d.dtype}"
        raise InputError(what, where="points_2d", fix="give points_2d.double()")
    if points_2d.ndim != 3 or points_2d.shape[2] != 2:
        what = f"shape {tuple(points_2d.shape)}, expected (B, n, 2)"
        raise InputError(what, where="points_2d")


def _require_tensor(
    value: object, where: str, *, fix: str = "torch.as_tensor makes one of an array"
) -> None:
    """Refuse what is no tensor."""
    from torch import Tensor

    if not isinstance(value, Tensor):
        what = f"expected a tensor, got {type(value).__name__}"
        raise InputError(what, where=where, fix=fix)


def _expanded(tensor: Tensor, shape: tuple[int, ...], where: str) -> Tensor:
    """The tensor expanded to a shape.

    Raises InputError if that is not possible, or it is no tensor.
    """
    _require_tensor(tensor, where)
    try:
        return tensor.expand(shape)
    except RuntimeError:
        what = f"shape {tuple(tensor.shape)}, expected one that expands to {shape}"
        raise InputError(what, where=where) from None
