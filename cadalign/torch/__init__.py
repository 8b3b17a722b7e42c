"""Alignment in PyTorch programs: `fit`, with gradients by keypoints, sigmas and model points.

Needs the extra ``torch``: ``pip install "cadalign[torch]"``. Fits run in the compiled kernels,
on the processor; gradients are those of the optimum, by the implicit function theorem.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, is_number
from cadalign.errors import CadalignError, InputError, require_kind
from cadalign.estimation.options import FitOptions
from cadalign.geometry.camera import Camera
from cadalign.io.focal import PriorOption
from cadalign.torch.fits import FitTask, fits_of

if TYPE_CHECKING:
    import torch
    from torch import Tensor
else:

    class _LazyLibrary:
        """PyTorch's names; CadalignError, which names the extra, where it is not installed."""

        def __getattr__(self, name: str) -> Any:
            try:
                import torch
            except ImportError:
                raise CadalignError(
                    "PyTorch is not installed",
                    where="cadalign.torch",
                    fix="pip install 'cadalign[torch]'",
                ) from None
            return getattr(torch, name)

    torch = _LazyLibrary()

__all__ = ["PoseBatch", "fit"]

_LEAST_DEPTH = 1e-3  # over the distance; what lies nearer or behind is projected from there


@dataclass(frozen=True, eq=False)
class PoseBatch:
    """Alignments of B objects: estimates with gradients, or given ones.

    ``depth (u, v, 1) = rotation diag(scale) x + translation`` in OpenCV's camera axes.

    Parameters
    ----------
    rotation : (B, 3, 3) tensor
    translation : (B, 3) tensor
        [model units].
    scale : (B, 3) tensor
        Stretch along x, y and z.
    valid : (B,) bool tensor, optional
        Marks the estimates that exist and that the keypoints determine; the others are an identity
        without gradients. None: all are.
    focal : (B,) tensor, optional
        Focal lengths along the image's x [px], where they were estimated.
    covariance : (B, 10, 10) tensor, optional
        Inverse of the cost's Hessian, without gradients, in the order of
        `cadalign.Result.covariance`; 0 for what is held or not determined.

    Examples
    --------
    >>> import torch
    >>> one = PoseBatch(torch.eye(3)[None], torch.tensor([[0.0, 0, 4]]), torch.ones(1, 3))
    >>> one.project(torch.zeros(2, 3), Camera(640, 480, 900, 900, 319.5, 239.5))[0, 0].tolist()
    [319.5, 239.5]
    """

    rotation: Tensor
    translation: Tensor
    scale: Tensor
    valid: Tensor | None = None
    focal: Tensor | None = None
    covariance: Tensor | None = None

    def apply(self, points_3d: Tensor) -> Tensor:
        """Model points (n, 3) or (B, n, 3) in the cameras; (B, n, 3) tensor."""
        stretched = points_3d.to(self.scale) * self.scale[..., None, :]
        return stretched @ self.rotation.mT + self.translation[..., None, :]

    def project(self, points_3d: Tensor, camera: Camera | Sequence[Camera]) -> Tensor:
        """Project model points (n, 3) or (B, n, 3); (B, n, 2) tensor [px].

        What lies behind a camera is projected from just before it, which keeps gradients finite.

        Raises
        ------
        InputError
            If a camera has distortion, or no focal length where the poses have none.
        """
        cameras = _cameras(camera, len(self.scale))
        if self.focal is None:
            for each in cameras:
                each.require_focal()
        if any(each.distortion or each.is_wide for each in cameras):
            what = "projections in PyTorch know no lens distortion"
            raise InputError(what, where="camera", fix="undistort keypoints and camera first")
        rows = [[each.fx, each.fy, each.cx, each.cy] for each in cameras]
        calibration = torch.as_tensor(np.array(rows)).to(self.scale)[:, None]
        in_camera = self.apply(points_3d)
        least = _LEAST_DEPTH * self.translation.detach().norm(dim=-1)[..., None]
        depths = torch.maximum(in_camera[..., 2], least)[..., None]
        plane = in_camera[..., :2] / depths * calibration[..., :2]
        if self.focal is not None:
            plane = plane * (self.focal[:, None, None] / calibration[..., :1])
        return plane + calibration[..., 2:]


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
    focal: str = FitOptions.focal,
    focal_prior: PriorOption = FitOptions.focal_prior,
    exact: bool = True,
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
    loss, loss_scale, stretch, stretch_sigma, focal, focal_prior
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
        If a type, a shape or an option is wrong, a focal length is unknown, or a lens is a wide
        one.

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
        loss=loss,
        loss_scale=loss_scale,
        stretch=stretch,
        stretch_sigma=stretch_sigma,
        focal=focal,
        focal_prior=focal_prior,
    )
    sigmas, present, cameras = _checked(points_2d, camera, sigma, mask)
    models = _expanded(points_3d, (*points_2d.shape[:2], 3), "points_3d")
    task = FitTask(cameras, options, exact, workers)
    found = _layer().apply(task, present, models, points_2d, sigmas)
    rotation, translation, scale, focals, covariance, valid = found
    estimated = focals if focal == "estimate" else None
    return PoseBatch(rotation, translation, scale, valid, estimated, covariance)


@cache
def _layer() -> Any:
    """The autograd function; PyTorch is there once it is asked for."""

    class KernelLayer(torch.autograd.Function):
        """Fits that kernels find on the processor, by points, pixels and sigmas."""

        @staticmethod
        def forward(
            ctx: Any, task: FitTask, present: BoolArray, *given: Tensor
        ) -> tuple[Tensor, ...]:
            ctx.kinds = [(each.device, each.dtype) for each in given]
            points, pixels, sigmas = map(_as_array, given)
            ctx.fits = fits_of(task, points, pixels, sigmas, present)
            found, valid = ctx.fits.values[:-1], ctx.fits.values.valid
            found = [torch.as_tensor(each).to(given[1]) for each in found]
            valid = torch.as_tensor(valid).to(given[1].device)
            ctx.mark_non_differentiable(found[-1], valid)  # the covariance, too
            return (*found, valid)

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
            pulled = ctx.fits.pulled_back(*map(_as_array, slopes[:4]))
            kinds = zip(pulled, ctx.kinds, strict=True)
            return (None, None, *(torch.as_tensor(each).to(*kind) for each, kind in kinds))

    return KernelLayer


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


def _checked(
    points_2d: Tensor,
    camera: Camera | Sequence[Camera],
    sigma: Tensor | float,
    mask: Tensor | None,
) -> tuple[Tensor, BoolArray, tuple[Camera, ...]]:
    """Sigmas (B, n), the mask (B, n), and the cameras of keypoints (B, n, 2).

    Raises InputError if a type or a shape is wrong.
    """
    _require_tensor(points_2d, "points_2d")
    if not points_2d.is_floating_point():  # the estimates are of its type
        what = f"expected floating point numbers, got {points_2d.dtype}"
        raise InputError(what, where="points_2d", fix="give points_2d.double()")
    if points_2d.ndim != 3 or points_2d.shape[2] != 2:
        what = f"shape {tuple(points_2d.shape)}, expected (B, n, 2)"
        raise InputError(what, where="points_2d")
    shape = tuple(points_2d.shape[:2])
    if is_number(sigma):
        sigma = points_2d.new_full((), float(sigma))
    _require_tensor(sigma, "sigma", fix="give a number or a tensor, standard deviations in pixels")
    mask = torch.tensor(True) if mask is None else mask
    present = _expanded(mask, shape, "mask").detach().to("cpu", torch.bool).numpy()
    return _expanded(sigma, shape, "sigma"), present, _cameras(camera, len(points_2d))


def _require_tensor(
    value: object, where: str, *, fix: str = "torch.as_tensor makes one of an array"
) -> None:
    """Refuse what is no tensor."""
    if not isinstance(value, torch.Tensor):
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


def _as_array(tensor: Tensor) -> FloatArray:
    """The tensor as an array of double precision."""
    return np.asarray(tensor.detach().to("cpu", torch.float64).numpy())
