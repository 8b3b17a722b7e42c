"""Batches of alignments as tensors, arguments of a batch, and PyTorch itself, imported on use."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.arrays import FloatArray, is_number
from cadalign.errors import CadalignError, InputError, require_kind
from cadalign.geometry.camera import Camera

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

__all__ = ["PoseBatch", "as_array", "calibrations", "cameras_of", "checked", "expanded", "torch"]

_LEAST_DEPTH = 1e-3  # over the distance; what lies nearer or behind is projected from there


@dataclass(frozen=True, eq=False)
class PoseBatch:
    """Alignments of B objects: estimates with gradients, or truths.

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
        without gradients. None for truths: all are.
    focal : (B,) tensor, optional
        Focal lengths along the image's x [px], where they were estimated.
    points_3d : (B, m, 3) tensor, optional
        All keypoints of a learned shape, in the model's frame.
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
    points_3d: Tensor | None = None
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
        calibration = calibrations(camera, len(self.scale), own_focals=self.focal is not None)
        calibration = calibration.to(self.scale)
        ratio = None if self.focal is None else (self.focal / calibration[:, 0])[:, None, None]
        return self.project_by(calibration[:, None], points_3d, ratio)

    def project_by(
        self, calibration: Tensor, points_3d: Tensor, ratio: Tensor | None = None
    ) -> Tensor:
        """Project by `calibrations` (..., 1, 4), with focal lengths times a ratio."""
        in_camera = self.apply(points_3d)
        least = _LEAST_DEPTH * self.translation.detach().norm(dim=-1)[..., None]
        depths = torch.maximum(in_camera[..., 2], least)[..., None]
        plane = in_camera[..., :2] / depths * calibration[..., :2]
        return (plane if ratio is None else plane * ratio) + calibration[..., 2:]


def calibrations(
    camera: Camera | Sequence[Camera], count: int, *, own_focals: bool = False
) -> Tensor:
    """Focal lengths and principal points of ``count`` cameras, (B, 4) or (1, 4) tensor.

    With ``own_focals`` those of poses take the place of the cameras'. Raises InputError if a camera
    has distortion, or no focal length that is needed.
    """
    cameras = cameras_of(camera, count)
    for each in () if own_focals else cameras:
        each.require_focal()
    if any(each.distortion or each.is_wide for each in cameras):
        what = "projections in PyTorch know no lens distortion"
        raise InputError(what, where="camera", fix="undistort keypoints and camera first")
    rows = [[each.fx, each.fy, each.cx, each.cy] for each in cameras]
    return torch.as_tensor(np.array(rows))


def cameras_of(camera: Camera | Sequence[Camera], count: int) -> tuple[Camera, ...]:
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


def checked(
    points_2d: Tensor,
    camera: Camera | Sequence[Camera],
    sigma: Tensor | float,
    mask: Tensor | None,
) -> tuple[Tensor, Tensor, tuple[Camera, ...]]:
    """Sigmas (B, n), the mask (B, n) on the processor, and the cameras of keypoints (B, n, 2).

    Raises InputError if a type or a shape is wrong.
    """
    require_tensor(points_2d, "points_2d")
    if not points_2d.is_floating_point():  # the estimates are of its type
        what = f"expected floating point numbers, got {points_2d.dtype}"
        raise InputError(what, where="points_2d", fix="give points_2d.double()")
    if points_2d.ndim != 3 or points_2d.shape[2] != 2:
        what = f"shape {tuple(points_2d.shape)}, expected (B, n, 2)"
        raise InputError(what, where="points_2d")
    shape = tuple(points_2d.shape[:2])
    if is_number(sigma):
        sigma = points_2d.new_full((), float(sigma))
    require_tensor(sigma, "sigma", fix="give a number or a tensor, standard deviations in pixels")
    mask = torch.tensor(True) if mask is None else mask
    present = expanded(mask, shape, "mask").detach().to("cpu", torch.bool)
    return expanded(sigma, shape, "sigma"), present, cameras_of(camera, len(points_2d))


def require_tensor(
    value: object, where: str, *, fix: str = "torch.as_tensor makes one of an array"
) -> None:
    """Refuse what is no tensor."""
    if not isinstance(value, torch.Tensor):
        what = f"expected a tensor, got {type(value).__name__}"
        raise InputError(what, where=where, fix=fix)


def expanded(tensor: Tensor, shape: tuple[int, ...], where: str) -> Tensor:
    """The tensor expanded to a shape.

    Raises InputError if that is not possible, or it is no tensor.
    """
    require_tensor(tensor, where)
    try:
        return tensor.expand(shape)
    except RuntimeError:
        what = f"shape {tuple(tensor.shape)}, expected one that expands to {shape}"
        raise InputError(what, where=where) from None


def as_array(tensor: Tensor) -> FloatArray:
    """The tensor as an array of double precision."""
    return np.asarray(tensor.detach().to("cpu", torch.float64).numpy())
