"""`fit` and `align`: alignments of a batch with gradients by keypoints, sigmas and model points."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import require_kind
from cadalign.estimation.focal import PriorOption
from cadalign.estimation.layers import FitTask, KeypointBatch, check_cameras, fits_of
from cadalign.estimation.model import checked_ids
from cadalign.estimation.options import LOSSES, FitOptions
from cadalign.estimation.prior import prior_of
from cadalign.estimation.problems import in_threads, whitening_by
from cadalign.geometry.camera import Camera
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.constants import LEAST_POINTS
from cadalign.solvers.marginal.equations import POSE, force_of
from cadalign.solvers.marginal.posterior import slopes_of
from cadalign.solvers.marginal.problem import Mixture, Seen, shape_at
from cadalign.solvers.marginal.search import search_view
from cadalign.torch.poses import PoseBatch, as_array, checked, expanded, torch

if TYPE_CHECKING:
    from torch import Tensor

_NO_STARTS = np.empty((0, POSE))
_NO_POSE = np.array([1.0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1])


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
    known_axis: str = FitOptions.known_axis,
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
        known_axis=known_axis,
        focal=focal,
        focal_prior=focal_prior,
    )
    sigmas, present, cameras = checked(points_2d, camera, sigma, mask)
    models = expanded(points_3d, (*points_2d.shape[:2], 3), "points_3d")
    task = FitTask(cameras, options, exact, workers)

    def solve(pixels: FloatArray, points: FloatArray, sigmas: FloatArray) -> _Solved:
        fits = fits_of(task, points, pixels, sigmas, present.numpy())
        *found, covariance, valid = fits.values

        def pulled_back(*slopes: FloatArray) -> tuple[FloatArray, ...]:
            by_points, by_pixels, by_sigma = fits.pulled_back(*slopes)
            return by_pixels, by_points, by_sigma

        return _Solved(tuple(found), (covariance, valid), pulled_back)

    found = _layer().apply(solve, points_2d, models, sigmas)
    rotation, translation, scale, focals, covariance, valid = found
    estimated = focals if focal == "estimate" else None
    return PoseBatch(rotation, translation, scale, valid, estimated, covariance=covariance)


class _Solved(NamedTuple):
    """Arrays that have gradients, others, and what takes slopes by the former to the input's."""

    found: tuple[FloatArray, ...]
    fixed: tuple[np.ndarray, ...]
    pulled_back: Callable[..., tuple[FloatArray, ...]]


@cache
def _layer() -> Any:
    """The autograd function; PyTorch is there once it is asked for."""

    class KernelLayer(torch.autograd.Function):
        """Optima that kernels find on the processor; the first tensor is that of the keypoints."""

        @staticmethod
        def forward(ctx: Any, solve: Callable[..., _Solved], *given: Tensor) -> tuple[Tensor, ...]:
            ctx.kinds = [(each.device, each.dtype) for each in given]
            solved = ctx.solved = solve(*map(as_array, given))
            found = [torch.as_tensor(each).to(given[0]) for each in solved.found]
            fixed = [torch.as_tensor(each) for each in solved.fixed]
            fixed = [
                each.to(given[0] if each.is_floating_point() else given[0].device) for each in fixed
            ]
            ctx.mark_non_differentiable(*fixed)
            return (*found, *fixed)

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
            pulled = ctx.solved.pulled_back(*map(as_array, slopes[: len(ctx.solved.found)]))
            kinds = zip(pulled, ctx.kinds, strict=True)
            return (None, *(torch.as_tensor(each).to(*kind) for each, kind in kinds))

    return KernelLayer


def align(
    model: ShapeModel,
    points_2d: Tensor,
    camera: Camera | Sequence[Camera],
    *,
    ids: Sequence[Hashable] | None = None,
    sigma: Tensor | float = 1.0,
    mask: Tensor | None = None,
    loss: str = FitOptions.loss,
    loss_scale: float = FitOptions.loss_scale,
    workers: int = -1,
) -> PoseBatch:
    """Align a learned shape to a batch of images, as `cadalign.align` does, with gradients.

    Problems without a solution do not raise: ``valid`` of the result marks them.

    Parameters
    ----------
    model : ShapeModel
    points_2d : (B, n, 2) tensor
        Keypoints in the images [px].
    camera : Camera or sequence of B Camera
    ids : sequence of n int or str, optional
        Ids of the keypoints; by default those of the model, in their order.
    sigma, mask, workers
        As for `cadalign.torch.fit`.
    loss, loss_scale
        As for `cadalign.align`.

    Returns
    -------
    PoseBatch
        With ``points_3d``, all keypoints of the objects; the scale is 1.

    Raises
    ------
    InputError
        If a type, a shape or an option is wrong, a keypoint or a focal length is unknown, or a
        lens is a wide one.

    Examples
    --------
    >>> import torch
    >>> corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
    >>> model = ShapeModel.from_basis(corners, [corners * [1, 0, 0]], [0.2], residual_sigma=1e-3)
    >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
    >>> seen = torch.as_tensor(camera.project(corners * [1.2, 1, 1] + [0.3, 0.2, 9.0]))
    >>> found = align(model, seen[None], camera)
    >>> round(float(found.points_3d[0, 1, 0] - found.points_3d[0, 0, 0]), 2)
    2.4
    """
    fix = "points of a Model go to cadalign.torch.fit"
    require_kind(model, ShapeModel, "model", fix=fix)
    options = FitOptions(loss=loss, loss_scale=loss_scale)
    sigmas, present, cameras = checked(points_2d, camera, sigma, mask)
    check_cameras(cameras)
    names = checked_ids(model.ids if ids is None else ids, points_2d.shape[1])
    rows = np.array(prior_of(model).rows_of(names, "ids"), dtype=np.int64)
    weights, means, covariances = model.gaussians
    mixture = Mixture(means, covariances, -2 * np.log(weights))

    def solve(pixels: FloatArray, sigmas: FloatArray) -> _Solved:
        batch = KeypointBatch.of(pixels, sigmas, present.numpy(), cameras)
        task = _ShapeTask(mixture, rows, len(model.ids), batch, options, workers)
        found = task.aligned()
        poses, points = task.values(found)
        arrays = poses[:, :9].reshape(-1, 3, 3), poses[:, 9:], points
        valid = np.array([each is not None for each in found], dtype=bool)
        return _Solved(arrays, (valid,), lambda *slopes: task.pulled_back(found, *slopes))

    rotation, translation, points, valid = _layer().apply(solve, points_2d, sigmas)
    return PoseBatch(
        rotation, translation, torch.ones_like(translation), valid=valid, points_3d=points
    )


class _Aligned(NamedTuple):
    """A minimum of one problem: its component, pose (12,) and forces (n, 3) on its keypoints."""

    seen: Seen
    component: int
    pose: FloatArray
    force: FloatArray


@dataclass(frozen=True, eq=False)
class _ShapeTask:
    """Keypoints of a batch, and the shapes of which they are the points ``rows``."""

    mixture: Mixture
    rows: IntArray
    keypoints: int  # points of the mixture that are keypoints, not corners of the box
    batch: KeypointBatch
    options: FitOptions
    workers: int

    def _seen(self, problem: int) -> Seen:
        """Present keypoints of a problem as the kernels take them."""
        batch = self.batch
        present = batch.present[problem]
        whitening = whitening_by(batch.information[problem, present])
        loss, bend = LOSSES[self.options.loss], float(self.options.loss_scale)
        return Seen(self.rows[present], batch.rays[problem, present], whitening, loss, bend)

    def _minimum(self, problem: int) -> _Aligned | None:
        """The best minimum of a problem; None where there is none."""
        seen = self._seen(problem)
        if len(seen.points) < LEAST_POINTS:
            return None
        minima, _ = search_view(self.mixture, seen, _NO_STARTS)
        if not minima.counts[0] or not np.isfinite(minima.states[0]).all():
            return None
        state = minima.states[0]
        return _Aligned(seen, int(minima.label[0]), state[:POSE].copy(), force_of(state))

    def aligned(self) -> list[_Aligned | None]:
        @np.errstate(all="ignore")
        def run(first: int, last: int) -> list[_Aligned | None]:
            return [self._minimum(problem) for problem in range(first, last)]

        return list(chain.from_iterable(in_threads(run, len(self.batch.pixels), self.workers)))

    def values(self, found: list[_Aligned | None]) -> tuple[FloatArray, FloatArray]:
        """Poses (B, 12) and keypoints (B, m, 3); where there is no minimum, of the mean."""
        poses = np.tile(_NO_POSE, (len(found), 1))
        points = np.tile(self.mixture.means[0, : self.keypoints], (len(found), 1, 1))
        for b, each in enumerate(found):
            if each is not None:
                poses[b] = each.pose
                own = shape_at(self.mixture, each.component, each.seen, each.force)
                points[b] = own[: self.keypoints]
        return poses, points

    def pulled_back(
        self,
        found: list[_Aligned | None],
        by_rotation: FloatArray,
        by_translation: FloatArray,
        by_points: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Slopes by the pixels (B, n, 2) and by the sigmas (B, n)."""
        batch = self.batch
        by_pixels, by_sigma = np.zeros_like(batch.pixels), np.zeros_like(batch.sigmas)

        def one(b: int, aligned: _Aligned) -> None:
            seen, component, pose, force = aligned
            by_state, by_data = slopes_of(self.mixture, component, seen, pose, force)
            beside = (3 * seen.points[:, None] + np.arange(3)).ravel()
            whole = self.mixture.covariances[component][: 3 * self.keypoints][:, beside]
            turn = np.cross(pose[:9].reshape(3, 3), by_rotation[b], axis=0).sum(axis=1)
            wanted = np.concatenate([turn, by_translation[b], by_points[b].ravel() @ whole])
            try:
                adjoint = -np.linalg.solve(by_state.T, wanted)
            except np.linalg.LinAlgError:
                return
            pulled = adjoint @ by_data
            if not np.isfinite(pulled).all():
                return
            n, present = len(seen.points), batch.present[b]
            by_rays = pulled[: 2 * n].reshape(n, 1, 2)
            by_pixels[b, present] = (by_rays @ batch.by_pixels[b, present])[:, 0]
            by_sigma[b, present] = pulled[2 * n :] / batch.sigmas[b, present]

        @np.errstate(all="ignore")
        def run(first: int, last: int) -> None:
            for b in range(first, last):
                aligned = found[b]
                if aligned is not None:
                    one(b, aligned)

        in_threads(run, len(found), self.workers)
        return by_pixels, by_sigma
