"""Losses between batches of alignments, the least over the symmetries of the model.

A symmetry's motion g takes the model to itself, so ``truth @ g`` places the object as the truth
does, where the stretch keeps the symmetry: the stretches across an axis are equal.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from cadalign.errors import InputError, require_kind
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry
from cadalign.geometry.symmetry_group import group_of
from cadalign.torch.poses import PoseBatch, torch

if TYPE_CHECKING:
    from torch import Tensor

_STEP = np.pi / 36  # of `Symmetry.poses`: 36 rotations about an axis
_TINY = 1e-12


def rotation_loss(
    found: PoseBatch, truth: PoseBatch, *, symmetry: Symmetry | None = None
) -> Tensor:
    """One minus the cosine of the rotation error: half its square near 0, and smooth.

    Parameters
    ----------
    found, truth : PoseBatch
        In single or double precision, each its own.
    symmetry : Symmetry, optional
        The model's. Rotations about an axis count nothing, in closed form.

    Returns
    -------
    (B,) tensor
        0, without gradient, for estimates that are not valid.

    Examples
    --------
    >>> import torch
    >>> from cadalign.geometry.rotations import rotation_from_vector
    >>> turned = torch.as_tensor(rotation_from_vector(np.array([0, np.pi / 2, 0])))[None]
    >>> zero, one = torch.zeros(1, 3), torch.ones(1, 3)
    >>> turns = turned, torch.eye(3)[None].double()
    >>> found, truth = (PoseBatch(each, zero, one) for each in turns)
    >>> round(rotation_loss(found, truth).item(), 6)
    1.0
    >>> quarter = Symmetry.around((0, 1, 0), fold=4)
    >>> abs(round(rotation_loss(found, truth, symmetry=quarter).item(), 6))
    0.0
    """
    if symmetry is None:
        symmetry = Symmetry.none()
    require_kind(symmetry, Symmetry, "symmetry")
    group = group_of(symmetry)
    between = truth.rotation.to(found.rotation).mT @ found.rotation  # in the model's frame
    if group.is_free:
        return _of_valid(torch.zeros_like(between[:, 0, 0]) * between.sum(dim=(1, 2)), found)
    rotations = torch.as_tensor(np.array(group.rotations)).to(between)
    products = rotations.transpose(1, 2)[None] @ between[:, None]
    traces = products.diagonal(dim1=2, dim2=3).sum(dim=2)
    if group.axis is not None:
        axis = torch.as_tensor(np.array(group.axis)).to(between)
        along = (products @ axis) @ axis
        skew = products - products.transpose(2, 3)
        turn = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)
        traces = torch.sqrt((traces - along) ** 2 + (turn @ axis) ** 2 + _TINY) + along
    return _of_valid((3 - traces.amax(dim=1)) / 2, found)


def reprojection_loss(
    found: PoseBatch,
    truth: PoseBatch,
    points_3d: Tensor,
    camera: Camera | Sequence[Camera],
    *,
    symmetry: Symmetry | None = None,
    beta: float = 1.0,
) -> Tensor:
    """Mean distance of projected model points from where the truth projects them, smooth L1 [px].

    Parameters
    ----------
    found, truth, symmetry
        As for `rotation_loss`, rotations about an axis in steps of 10 degrees or less. For a
        learned shape, the points of each are its own, where it has ``points_3d``.
    points_3d : (n, 3) or (B, n, 3) tensor
    camera : Camera or sequence of B Camera
        Without distortion.
    beta : float
        Distance below which the loss is quadratic [px].

    Returns
    -------
    (B,) tensor
        As of `rotation_loss`.

    Examples
    --------
    >>> import torch
    >>> points, camera = torch.eye(3)[:2], Camera(640, 480, 100, 100, 319.5, 239.5)
    >>> found, truth = (
    ...     PoseBatch(torch.eye(3)[None], torch.tensor([[x, 0, 4.0]]), torch.ones(1, 3))
    ...     for x in (0.0, 0.4)
    ... )
    >>> reprojection_loss(found, truth, points, camera).tolist()
    [9.5]
    """
    own, true = _points(found, points_3d), _points(truth, points_3d)

    def distances(points: Tensor) -> Tensor:
        lengths = _lengths(found.project(own, camera) - truth.project(points, camera))
        return torch.where(lengths < beta, lengths**2 / (2 * beta), lengths - beta / 2)

    return _of_valid(_least(distances, true, symmetry), found)


def box_loss(
    found: PoseBatch,
    truth: PoseBatch,
    bounds: Tensor,
    *,
    symmetry: Symmetry | None = None,
) -> Tensor:
    """Mean distance of the box's corners over the true box's diagonal.

    For a learned shape, the estimated box is that of its keypoints.

    Parameters
    ----------
    found, truth, symmetry
        As for `reprojection_loss`.
    bounds : (2, 3) or (B, 2, 3) tensor
        Least and greatest coordinates of the model, before its stretch.

    Returns
    -------
    (B,) tensor
        As of `rotation_loss`.

    Examples
    --------
    >>> import torch
    >>> bounds = torch.tensor([[0.0, 0, 0], [2, 2, 1]])
    >>> found, truth = (
    ...     PoseBatch(torch.eye(3)[None], torch.tensor([[x, 0, 4.0]]), torch.ones(1, 3))
    ...     for x in (0.0, 0.3)
    ... )
    >>> round(box_loss(found, truth, bounds).item(), 3)
    0.1
    """
    if bounds.shape[-2:] != (2, 3):
        what = f"shape {tuple(bounds.shape)}, expected (2, 3) or (B, 2, 3)"
        raise InputError(what, where="bounds")
    own = bounds
    if found.points_3d is not None:
        own = torch.stack([found.points_3d.amin(dim=1), found.points_3d.amax(dim=1)], dim=1)
    corners, true = found.apply(_corners(own)), _corners(bounds)
    least = _least(lambda points: _lengths(corners - truth.apply(points)), true, symmetry)
    extents = (bounds[..., 1, :] - bounds[..., 0, :]) * truth.scale
    return _of_valid(least / extents.norm(dim=-1), found)


def _points(poses: PoseBatch, points_3d: Tensor) -> Tensor:
    return points_3d if poses.points_3d is None else poses.points_3d


def _least(
    distances: Callable[[Tensor], Tensor], points: Tensor, symmetry: Symmetry | None
) -> Tensor:
    """The least of the mean distances (B,) over a symmetry's motions, which move ``points``."""
    if symmetry is not None:
        require_kind(symmetry, Symmetry, "symmetry")
    motions = np.eye(4)[None] if symmetry is None else symmetry.poses(max_step=_STEP)
    means = [
        distances(points @ motion[:3, :3].T + motion[:3, 3]).mean(dim=1)
        for motion in torch.as_tensor(motions).to(points)
    ]
    return torch.stack(means).amin(dim=0)


def _lengths(vectors: Tensor) -> Tensor:
    return torch.sqrt((vectors**2).sum(dim=-1) + _TINY)


def _corners(bounds: Tensor) -> Tensor:
    """Corners (8, 3) or (B, 8, 3) of boxes."""
    choice = torch.cartesian_prod(*[torch.arange(2)] * 3)
    return torch.stack([bounds[..., choice[:, axis], axis] for axis in range(3)], dim=-1)


def _of_valid(loss: Tensor, found: PoseBatch) -> Tensor:
    if found.valid is None:
        return loss
    return torch.where(found.valid, loss, torch.zeros_like(loss))
