"""Arguments of a batch: tensors, checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.geometry.camera import Camera
from cadalign.torch.library import torch
from cadalign.torch.poses import cameras_of

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True, eq=False)
class GivenTensors:
    """Checked arguments: points (B, n, 2) [px], sigma (B, n), mask (B, n), and the cameras."""

    points_2d: Tensor
    sigma: Tensor
    mask: Tensor
    cameras: tuple[Camera, ...]

    @classmethod
    def of(
        cls,
        points_2d: Tensor,
        camera: Camera | Sequence[Camera],
        sigma: Tensor | float,
        mask: Tensor | None,
    ) -> GivenTensors:
        """Check the arguments of a batch.

        Raises InputError if a shape is wrong.
        """
        if points_2d.ndim != 3 or points_2d.shape[2] != 2:
            what = f"shape {tuple(points_2d.shape)}, expected (B, n, 2)"
            raise InputError(what, where="points_2d")
        count, n = points_2d.shape[:2]
        if not isinstance(sigma, torch.Tensor):
            sigma = points_2d.new_full((), sigma)
        if mask is None:
            mask = torch.ones(count, n, dtype=torch.bool)
        return cls(
            points_2d,
            expanded(sigma, (count, n), "sigma"),
            expanded(mask.detach().to("cpu", torch.bool), (count, n), "mask"),
            cameras_of(camera, count),
        )


def expanded(tensor: Tensor, shape: tuple[int, ...], where: str) -> Tensor:
    """The tensor expanded to a shape.

    Raises InputError if that is not possible.
    """
    try:
        return tensor.expand(shape)
    except RuntimeError:
        what = f"shape {tuple(tensor.shape)}, expected one that expands to {shape}"
        raise InputError(what, where=where) from None


def as_array(tensor: Tensor) -> FloatArray:
    """The tensor as an array of double precision."""
    return np.asarray(tensor.detach().to("cpu", torch.float64).numpy())
