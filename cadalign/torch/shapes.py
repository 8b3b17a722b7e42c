"""`align`: poses and shapes of a batch from a learned shape, with gradients by the keypoints."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.estimation.layers import KeypointBatch, in_threads
from cadalign.estimation.options import LOSSES, FitOptions
from cadalign.estimation.prior import prior_of
from cadalign.geometry.camera import Camera
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.marginal.equations import POSE, force_of
from cadalign.solvers.marginal.problem import Mixture, Seen, shape_at
from cadalign.solvers.marginal.search import search_view
from cadalign.solvers.marginal.slopes import slopes_of
from cadalign.torch.keypoints import GivenTensors, as_array
from cadalign.torch.library import torch
from cadalign.torch.poses import PoseBatch

if TYPE_CHECKING:
    from torch import Tensor

_LEAST_POINTS = 4
_NO_STARTS = np.empty((0, POSE))


def align(
    model: ShapeModel,
    points_2d: Tensor,
    camera: Camera | Sequence[Camera],
    *,
    ids: Sequence[Hashable] | None = None,
    sigma: Tensor | float = 1.0,
    mask: Tensor | None = None,
    loss: str = "linear",
    loss_scale: float = 2.0,
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
        If a shape or an option is wrong, a keypoint is unknown, or a lens is a wide one.

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
    options = FitOptions(loss=loss, loss_scale=loss_scale)
    given = GivenTensors.of(points_2d, camera, sigma, mask)
    names = tuple(model.ids if ids is None else ids)
    if len(names) != points_2d.shape[1]:
        what = f"{len(names)} ids for {points_2d.shape[1]} keypoints"
        raise InputError(what, where="ids", fix="give the id of each keypoint")
    rows = np.array(prior_of(model).rows_of(names, "ids"), dtype=np.int64)
    means, covariances, weights = model.gaussians
    task = _ShapeTask(
        Mixture(means, covariances, -2 * np.log(weights)),
        rows,
        len(model.ids),
        given.cameras,
        given.mask.numpy(),
        options,
        workers,
    )
    rotation, translation, points, valid = _layer().apply(points_2d, given.sigma, task)
    return PoseBatch(
        rotation, translation, torch.ones_like(translation), valid=valid, points_3d=points
    )


@dataclass(frozen=True, eq=False)
class _ShapeTask:
    mixture: Mixture
    rows: IntArray
    keypoints: int
    cameras: tuple[Camera, ...]
    mask: BoolArray
    options: FitOptions
    workers: int

    def seen(self, batch: KeypointBatch, problem: int) -> Seen:
        """Present keypoints of a problem as the kernels take them."""
        present = batch.present[problem]
        information = batch.information[problem, present]
        loss, bend = LOSSES[self.options.loss], float(self.options.loss_scale)
        a = np.sqrt(information[:, 0, 0])
        b = information[:, 0, 1] / a
        whitening = np.stack([a, b, np.sqrt(information[:, 1, 1] - b * b)], axis=1)
        return Seen(self.rows[present], batch.rays[problem, present], whitening, loss, bend)


@dataclass(frozen=True, eq=False)
class _Aligned:
    """A minimum of one problem: its component, pose (12,) and forces (n, 3) on its keypoints."""

    seen: Seen
    component: int
    pose: FloatArray
    force: FloatArray


@cache
def _layer() -> Any:
    """The autograd function; PyTorch is there once it is asked for."""

    class ShapeLayer(torch.autograd.Function):
        """Alignments of a batch."""

        @staticmethod
        def forward(
            ctx: Any, points_2d: Tensor, sigma: Tensor, task: _ShapeTask
        ) -> tuple[Tensor, ...]:
            batch = KeypointBatch.of(as_array(points_2d), as_array(sigma), task.mask, task.cameras)
            found = _aligned(batch, task)
            ctx.found, ctx.batch, ctx.task = found, batch, task
            ctx.kinds = [(each.device, each.dtype) for each in (points_2d, sigma)]
            poses = np.tile(np.concatenate([np.eye(3).ravel(), [0.0, 0.0, 1.0]]), (len(found), 1))
            points = np.tile(task.mixture.means[0, : task.keypoints], (len(found), 1, 1))
            for b, each in enumerate(found):
                if each is not None:
                    poses[b] = each.pose
                    own = shape_at(task.mixture, each.component, each.seen, each.force)
                    points[b] = own[: task.keypoints]
            arrays = poses[:, :9].reshape(-1, 3, 3), poses[:, 9:], points
            valid = torch.tensor([each is not None for each in found], device=points_2d.device)
            ctx.mark_non_differentiable(valid)
            return (*(torch.as_tensor(each).to(points_2d) for each in arrays), valid)

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
            by_pixels, by_sigma = _pulled_back(
                ctx.found, ctx.batch, ctx.task, *map(as_array, slopes[:3])
            )
            return (
                torch.as_tensor(by_pixels).to(*ctx.kinds[0]),
                torch.as_tensor(by_sigma).to(*ctx.kinds[1]),
                None,
            )

    return ShapeLayer


def _aligned(batch: KeypointBatch, task: _ShapeTask) -> list[_Aligned | None]:
    """The best minimum of every problem; None where there is none."""

    def one(problem: int) -> _Aligned | None:
        seen = task.seen(batch, problem)
        if len(seen.points) < _LEAST_POINTS:
            return None
        minima, _ = search_view(task.mixture, seen, _NO_STARTS)
        if not minima.counts[0] or not np.isfinite(minima.states[0]).all():
            return None
        state = minima.states[0]
        return _Aligned(seen, int(minima.label[0]), state[:POSE].copy(), force_of(state))

    @np.errstate(all="ignore")
    def run(first: int, last: int) -> list[_Aligned | None]:
        return [one(problem) for problem in range(first, last)]

    return list(chain.from_iterable(in_threads(run, len(batch.pixels), task.workers)))


def _pulled_back(
    found: list[_Aligned | None],
    batch: KeypointBatch,
    task: _ShapeTask,
    by_rotation: FloatArray,
    by_translation: FloatArray,
    by_points: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Slopes by the pixels (B, n, 2) and by the sigmas (B, n)."""
    by_pixels, by_sigma = np.zeros_like(batch.pixels), np.zeros_like(batch.sigmas)

    def one(b: int, aligned: _Aligned) -> None:
        seen = aligned.seen
        slopes = slopes_of(
            task.mixture, aligned.component, seen, aligned.pose, aligned.force, False
        )
        beside = (3 * seen.points[:, None] + np.arange(3)).ravel()
        whole = task.mixture.covariances[aligned.component]
        rotation = aligned.pose[:9].reshape(3, 3)
        turn = np.cross(rotation, by_rotation[b], axis=0).sum(axis=1)
        force = by_points[b].ravel() @ whole[: 3 * task.keypoints][:, beside]
        wanted = np.concatenate([turn, by_translation[b], force])
        try:
            adjoint = -np.linalg.solve(slopes.by_state.T, wanted)
        except np.linalg.LinAlgError:
            return
        by_data = adjoint @ slopes.by_data
        if not np.isfinite(by_data).all():
            return
        n, present = len(seen.points), batch.present[b]
        by_rays = by_data[: 2 * n].reshape(n, 1, 2)
        by_pixels[b, present] = (by_rays @ batch.by_pixels[b, present])[:, 0]
        by_sigma[b, present] = by_data[2 * n :] / batch.sigmas[b, present]

    @np.errstate(all="ignore")
    def run(first: int, last: int) -> None:
        for b in range(first, last):
            aligned = found[b]
            if aligned is not None:
                one(b, aligned)

    in_threads(run, len(found), task.workers)
    return by_pixels, by_sigma
