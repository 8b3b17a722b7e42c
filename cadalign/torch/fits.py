"""`fit`: alignments of a batch with gradients by keypoints, sigmas and model points."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

from cadalign.estimation.focal import USUAL, PriorOption
from cadalign.estimation.layers import FitTask, fits_of
from cadalign.estimation.options import FitOptions
from cadalign.geometry.camera import Camera
from cadalign.names import renamed
from cadalign.torch.keypoints import GivenTensors, as_array, expanded
from cadalign.torch.library import torch
from cadalign.torch.poses import PoseBatch

if TYPE_CHECKING:
    from torch import Tensor


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
    task = FitTask(given.cameras, options, exact, workers)
    found = _layer().apply(models, points_2d, given.sigma, given.mask, task)
    rotation, translation, scale, focals, covariance, valid = found
    estimated = focals if focal == "estimate" else None
    return PoseBatch(rotation, translation, scale, valid, estimated, covariance=covariance)


@cache
def _layer() -> Any:
    """The autograd function; PyTorch is there once it is asked for."""

    class FitLayer(torch.autograd.Function):
        """Fits of a batch."""

        @staticmethod
        def forward(
            ctx: Any,
            points_3d: Tensor,
            points_2d: Tensor,
            sigma: Tensor,
            mask: Tensor,
            task: FitTask,
        ) -> tuple[Tensor, ...]:
            given = points_3d, points_2d, sigma
            ctx.kinds = [(each.device, each.dtype) for each in given]
            ctx.fits = fits_of(
                task, as_array(points_3d), as_array(points_2d), as_array(sigma), mask.numpy()
            )
            *arrays, valid = ctx.fits.values
            tensors = [torch.as_tensor(each).to(points_2d) for each in arrays]
            valid = torch.as_tensor(valid, device=points_2d.device)
            ctx.mark_non_differentiable(tensors[-1], valid)
            return (*tensors, valid)

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
            pulled = ctx.fits.pulled_back(*map(as_array, slopes[:4]))
            kinds = zip(pulled, ctx.kinds, strict=True)
            return (*(torch.as_tensor(each).to(*kind) for each, kind in kinds), None, None)

    return FitLayer
