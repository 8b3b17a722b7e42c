"""A small keypoint network: heat maps whose means are keypoints and whose spreads are sigmas.

A baseline to start from, for renders of one category. The heat map of a keypoint is a probability
over cells; its mean is the keypoint (Sun et al., *Integral Human Pose Regression*, ECCV 2018), its
standard deviation that of the keypoint.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.torch.poses import torch
from cadalign.torch.renders import RenderedViews

if TYPE_CHECKING:
    from torch import Tensor

_CELL = 4  # pixels of a heat map's cell
_LEAST_SIGMA = 0.3  # [px]
_TARGET_SIGMA = 0.8  # of the heat maps that are learned [cells]
_GROUPS = 8

LossOfKeypoints = Callable[["Tensor", "Tensor", "Tensor"], "Tensor"]
"""Loss of keypoints (B, k, 2), sigmas (B, k), both [px], and the views' numbers (B,)."""


@dataclass(frozen=True, eq=False)
class KeypointDetector:
    """A network from images to heat maps (B, k, h / 4, w / 4) of logits.

    Parameters
    ----------
    network : torch.nn.Module
    calibration : float
        Factor of the heat maps' spreads.
    """

    network: Any
    calibration: float = 1.0

    @classmethod
    def untrained(cls, keypoints: int, *, width: int = 24, seed: int = 0) -> KeypointDetector:
        """An untrained network of so many keypoints; ``width`` channels in its first layer."""
        torch.manual_seed(seed)
        nn = torch.nn

        def block(inputs: int, outputs: int, stride: int) -> Any:
            convolution = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
            return nn.Sequential(convolution, nn.GroupNorm(_GROUPS, outputs), nn.ReLU())

        def residual(*layers: Any, inputs: int, outputs: int) -> Any:
            """Layers at half the resolution beside a skip, joined by a convolution."""
            inner = nn.Sequential(*layers, nn.Upsample(scale_factor=2, mode="bilinear"))
            inner.register_forward_hook(lambda _, given, made: torch.cat([given[0], made], dim=1))
            return nn.Sequential(inner, block(inputs, outputs, 1))

        w = width
        lowest = block(4 * w, 4 * w, 2), block(4 * w, 4 * w, 1)
        deepest = residual(*lowest, inputs=8 * w, outputs=4 * w)
        middle = residual(block(2 * w, 4 * w, 2), deepest, inputs=6 * w, outputs=4 * w)
        head = nn.Conv2d(4 * w, keypoints, 1)
        return cls(nn.Sequential(block(3, w, 2), block(w, 2 * w, 2), middle, head))

    def __call__(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Keypoints (B, k, 2) and sigmas (B, k) [px] of images (B, h, w, 3), 0 to 255."""
        return self.read(self.logits(images))

    def logits(self, images: Tensor) -> Tensor:
        """Heat maps of images (B, h, w, 3), 0 to 255."""
        return self.network(images.float().permute(0, 3, 1, 2) / 127.5 - 1)

    def read(self, logits: Tensor) -> tuple[Tensor, Tensor]:
        """Means (B, k, 2) and spreads (B, k) [px] of heat maps."""
        rows, columns = logits.shape[2:]
        shares = torch.softmax(logits.flatten(2), dim=2).reshape(logits.shape)
        x = (torch.arange(columns) + 0.5) * _CELL - 0.5
        y = (torch.arange(rows) + 0.5) * _CELL - 0.5
        of_x, of_y = shares.sum(dim=2), shares.sum(dim=3)
        means = torch.stack([of_x @ x, of_y @ y], dim=2)
        spread = (of_x * (x - means[..., :1]) ** 2).sum(dim=2)
        spread = (spread + (of_y * (y - means[..., 1:]) ** 2).sum(dim=2)) / 2
        return means, self.calibration * torch.sqrt(spread + _LEAST_SIGMA**2)

    def calibrated(self, views: RenderedViews) -> KeypointDetector:
        """The detector whose spreads are those of its errors on views that it has not seen."""
        points, sigma = self.predict(views)
        squares = ((points - views.points_2d) ** 2).sum(axis=2) / sigma**2
        factor = float(np.sqrt(np.median(squares) / 1.386))  # of a chi-square of 2
        return KeypointDetector(self.network, self.calibration * factor)

    def predict(self, views: RenderedViews) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints (V, k, 2) and sigmas (V, k) [px] of rendered views."""
        self.network.eval()
        with torch.no_grad():
            found = [self(torch.as_tensor(part)) for part in np.array_split(views.images, 8)]
        points, sigmas = (torch.cat(each).double().numpy() for each in zip(*found, strict=True))
        return points, sigmas

    def copy(self) -> KeypointDetector:
        """A copy that is trained apart."""
        return KeypointDetector(deepcopy(self.network), self.calibration)


def heatmap_loss(logits: Tensor, points_2d: Tensor) -> Tensor:
    """Cross entropy of heat maps (B, k, h, w) with Gaussians about true keypoints [px], (B, k)."""
    rows, columns = logits.shape[2:]
    place = (points_2d + 0.5) / _CELL - 0.5
    across = (torch.arange(columns) - place[..., :1]) ** 2
    down = (torch.arange(rows) - place[..., 1:]) ** 2
    wanted = -(down[..., :, None] + across[..., None, :]) / (2 * _TARGET_SIGMA**2)
    shares = torch.softmax(wanted.flatten(2), dim=2)
    return -(shares * torch.log_softmax(logits.flatten(2), dim=2)).sum(dim=2)


def train(
    detector: KeypointDetector,
    views: RenderedViews,
    *,
    steps: int,
    batch: int = 16,
    rate: float = 2e-3,
    pose_loss: LossOfKeypoints | None = None,
    pose_weight: float = 1.0,
    seed: int = 0,
) -> list[float]:
    """Train on rendered views by the heat maps' loss, and by a loss of the keypoints beside it.

    Parameters
    ----------
    detector : KeypointDetector
        Changed in place.
    views : RenderedViews
    steps, batch : int
        Steps of Adam, of so many views each.
    rate : float
        First learning rate; it falls to 0 as a cosine.
    pose_loss : callable, optional
        Loss (B,) of keypoints, sigmas and the numbers of the views.
    pose_weight : float
        Its weight.
    seed : int
        Seed of the batches.

    Returns
    -------
    list of float
        The whole loss of every step.
    """
    detector.network.train()
    optimizer = torch.optim.AdamW(detector.network.parameters(), lr=rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    images, points = torch.as_tensor(views.images), torch.as_tensor(views.points_2d).float()
    losses = []
    for rows in _batches(len(views), steps, batch, seed):
        logits = detector.logits(images[rows])
        loss = heatmap_loss(logits, points[rows]).mean()
        if pose_loss is not None:
            loss = loss + pose_weight * pose_loss(*detector.read(logits), rows).mean()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(detector.network.parameters(), 5.0)
        optimizer.step()
        schedule.step()
        losses.append(float(loss.detach()))
    return losses


def _batches(count: int, steps: int, batch: int, seed: int) -> Iterator[Tensor]:
    """Numbers of views of every step, each view once before any comes again."""
    rng = np.random.default_rng(seed)
    waiting = np.empty(0, dtype=np.int64)
    for _ in range(steps):
        while len(waiting) < batch:
            waiting = np.concatenate([waiting, rng.permutation(count)])
        rows, waiting = waiting[:batch], waiting[batch:]
        yield torch.as_tensor(rows)
