"""Batches of alignments as tensors, losses between them, and PyTorch itself, imported on use.

Losses are the least over the symmetries of the model. A symmetry's motion g takes the model to
itself, so ``truth @ g`` places the object as the truth does, where the stretch keeps the symmetry:
the stretches across an axis are equal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.arrays import FloatArray, is_number
from cadalign.errors import CadalignError, InputError, require_kind
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry
from cadalign.geometry.symmetry_group import group_of

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

__all__ = [
    "PoseBatch",
    "as_array",
    "box_loss",
    "calibrations",
    "cameras_of",
    "checked",
    "expanded",
    "reprojection_loss",
    "require_same_count",
    "rotation_loss",
    "torch",
]

_LEAST_DEPTH = 1e-3  # over the distance; what lies nearer or behind is projected from there
_STEP = np.pi / 36  # of `Symmetry.poses`: 36 rotations about an axis
_TINY = 1e-12


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


def rotation_loss(
    found: PoseBatch, truth: PoseBatch, *, symmetry: Symmetry | None = None
) -> Tensor:
    """One minus the cosine of the rotation error: half its square near 0, and smooth.

    Parameters
    ----------
    found, truth : PoseBatch
        In single or double precision, each its own; one truth may be that of all.
    symmetry : Symmetry, optional
        The model's. Rotations about an axis count nothing, in closed form.

    Returns
    -------
    (B,) tensor
        0, without gradient, for estimates that are not valid.

    Raises
    ------
    InputError
        If there are neither as many truths as estimates nor one, or the symmetry is none.

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
    require_same_count(found, truth)
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
    require_same_count(found, truth)
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
    require_same_count(found, truth)
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


def require_same_count(found: PoseBatch, truth: PoseBatch) -> None:
    """Raise an InputError where there are neither as many truths as estimates nor one."""
    count, true = len(found.rotation), len(truth.rotation)
    if true not in (1, count):
        what = f"{true} alignments, but {count} are compared with it"
        raise InputError(what, where="truth", fix="give one for each, or a single one")


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
