"""Keypoints of a batch: tensors checked, and as the solvers take them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray, worker_count
from cadalign.errors import InputError
from cadalign.estimation.problems import rays_of
from cadalign.estimation.uncertainty.sensitivity import lens_slopes
from cadalign.geometry.camera import Camera
from cadalign.torch.library import torch
from cadalign.torch.poses import cameras_of

if TYPE_CHECKING:
    from torch import Tensor

T = TypeVar("T")


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
        """The batch of checked arrays.

        Raises InputError for wide lenses.
        """
        if any(each.is_wide for each in cameras):
            what = "wide lenses have no gradients"
            raise InputError(what, where="camera", fix="undistort keypoints and camera first")
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
    def counts(self) -> IntArray:
        """Numbers of present keypoints (B,)."""
        return np.asarray(self.present.sum(axis=1))

    @property
    def information(self) -> FloatArray:
        """Information (B, n, 2, 2) of the rays; 0 for those that are absent."""
        to_pixels = np.linalg.inv(self.by_pixels)
        weights = self.present / self.sigmas**2
        return np.asarray(weights[..., None, None] * (to_pixels.swapaxes(-1, -2) @ to_pixels))

    def camera(self, problem: int) -> Camera:
        """The camera of a problem."""
        return self.cameras[problem if len(self.cameras) > 1 else 0]


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


def in_threads(run: Callable[[int, int], T], count: int, workers: int) -> list[T]:
    """Results of ``run(first, last)`` over parts of so many problems, shared among threads."""
    bounds = np.linspace(0, count, min(worker_count(workers), max(count, 1)) + 1).astype(int)
    parts = list(pairwise(bounds.tolist()))
    if len(parts) == 1:
        return [run(*parts[0])]
    with ThreadPoolExecutor(len(parts)) as pool:
        return list(pool.map(run, *zip(*parts, strict=True)))
