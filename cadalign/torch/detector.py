"""A small keypoint network: heat maps whose means are keypoints and whose spreads are sigmas.

A baseline to start from, with rendered views of one category to train and to judge it with. The
heat map of a keypoint is a probability over cells; its mean is the keypoint (Sun et al., *Integral
Human Pose Regression*, ECCV 2018), its standard deviation that of the keypoint.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, instance_rng, require_counts
from cadalign.datasets.sample.model import SampleModel
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.render.raycast.renderer import RaycastRenderer
from cadalign.render.scene import Scene
from cadalign.render.viewpoints import frame_object, look_at, visible_keypoints
from cadalign.shapes.examples import Example
from cadalign.shapes.model import ShapeModel
from cadalign.torch.poses import torch

if TYPE_CHECKING:
    from torch import Tensor


_CELL = 4  # pixels of a heat map's cell
_LEAST_SIGMA = 0.3  # [px]
_TARGET_SIGMA = 0.8  # of the heat maps that are learned [cells]
_GROUPS = 8

LossOfKeypoints = Callable[["Tensor", "Tensor", "Tensor"], "Tensor"]
"""Loss of keypoints (B, k, 2), sigmas (B, k), both [px], and the views' numbers (B,)."""
_ELEVATION = (5.0, 50.0)  # [degrees]
_FILL = (0.6, 0.85)
_TINT = (0.6, 1.2)  # factors of the colour channels
_NOISE = 6.0  # of pixels, of 255
_COARSE = 6  # cells of a background's noise along a side


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
        """An untrained network of so many keypoints; ``width`` channels in its first layer.

        Raises InputError if a number is below 1 or ``width`` not a multiple of 8.
        """
        require_counts(keypoints=keypoints, width=width)
        if width % _GROUPS:
            raise InputError(f"{width} is not a multiple of {_GROUPS}", where="width")
        nn = torch.nn

        def block(inputs: int, outputs: int, stride: int) -> Any:
            convolution = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
            return nn.Sequential(convolution, nn.GroupNorm(_GROUPS, outputs), nn.ReLU())

        def residual(*layers: Any, inputs: int, outputs: int) -> Any:
            """Layers at half the resolution beside a skip, joined by a convolution."""
            inner = nn.Sequential(*layers)
            inner.register_forward_hook(_beside)
            return nn.Sequential(inner, block(inputs, outputs, 1))

        w = width
        with torch.random.fork_rng(devices=()):  # the program's own random numbers go on
            torch.manual_seed(seed)
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


def _beside(_: Any, given: tuple[Tensor], made: Tensor) -> Tensor:
    """Join the input of layers with what they made of it, at its resolution."""
    size = given[0].shape[2:]
    large = torch.nn.functional.interpolate(made, size=size, mode="bilinear")
    return torch.cat([given[0], large], dim=1)


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

    Raises
    ------
    InputError
        If a number of steps or views is below 1.
    """
    require_counts(steps=steps, batch=batch)
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


@dataclass(frozen=True, eq=False)
class RenderedViews:
    """Views of V objects whose k keypoints have the same ids.

    Parameters
    ----------
    images : (V, h, w, 3) uint8
    points_2d : (V, k, 2) float
        Keypoints in the images [px], hidden ones too.
    visible : (V, k) bool
    points_3d : (V, k, 3) float
        Keypoints of each object in its model's frame.
    rotation, translation : (V, 3, 3) and (V, 3) float
        True poses; the scale is 1.
    bounds : (V, 2, 3) float
        Least and greatest coordinates of each object in its model's frame.
    camera : Camera
    ids : tuple of int
    """

    images: npt.NDArray[np.uint8]
    points_2d: FloatArray
    visible: BoolArray
    points_3d: FloatArray
    rotation: FloatArray
    translation: FloatArray
    bounds: FloatArray
    camera: Camera
    ids: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.images)

    def box(self, view: int) -> Box:
        """The true box of a view's object in the camera."""
        pose = Alignment(self.rotation[view], self.translation[view], np.ones(3))
        return Box.from_model(self.bounds[view], pose)


def learned_shape(models: Iterable[SampleModel], ids: Sequence[int], category: str) -> ShapeModel:
    """The learned shape of models, of the keypoints with these ids."""
    examples = [
        Example(each.model_id, ids, _points(each, ids), bounds=each.mesh.bounds) for each in models
    ]
    return ShapeModel.learn(examples, category=category, up_axis="y", unit="diagonal")


def render_views(
    models: Sequence[SampleModel],
    *,
    ids: Sequence[int],
    count: int,
    size: int = 96,
    seed: int = 0,
) -> RenderedViews:
    """Render random views of models in turns, with random colours, backgrounds and noise.

    Parameters
    ----------
    models : sequence of SampleModel
        Of `cadalign.datasets.sample_models`.
    ids : sequence of int
        Semantic ids of the keypoints, which all models have.
    count : int
        Number of views.
    size : int
        Width and height of the images [px].
    seed : int
        Every view depends on it and its own number alone.

    Raises
    ------
    InputError
        If there is no model, a model lacks a keypoint, or a number is below 1.
    """
    require_counts(count=count, size=size)
    if not models:
        raise InputError("there is none", where="models", fix="give at least one")
    camera = Camera.from_fov(size, size, fov_x=40.0)
    renderer = RaycastRenderer()
    scenes = [Scene(each.mesh) for each in models]
    rows: list[tuple[np.ndarray, ...]] = []
    for number in range(count):
        rng = instance_rng(seed, f"view {number}")
        model, scene = models[number % len(models)], scenes[number % len(models)]
        points = _points(model, ids)
        azimuth, elevation = float(rng.uniform(0, 360)), float(rng.uniform(*_ELEVATION))
        turned = look_at(azimuth=azimuth, elevation=elevation, distance=1.0).rotation
        fill = float(rng.uniform(*_FILL))
        pose = frame_object(model.mesh.bounds, camera, rotation=turned, fill=fill)
        frame = renderer.render(scene, camera, pose, samples=2)
        rows.append(
            (
                _on_background(np.asarray(frame.color), rng),
                camera.project(pose.apply(points)),
                visible_keypoints(scene, points, camera, pose),
                points,
                pose.rotation,
                pose.translation,
                np.asarray(model.mesh.bounds),
            )
        )
    columns: list[Any] = [np.array(each) for each in zip(*rows, strict=True)]
    return RenderedViews(*[*columns, camera, tuple(ids)])


def _points(model: SampleModel, ids: Sequence[int]) -> FloatArray:
    """Keypoints (k, 3) of a model."""
    place = {each.semantic_id: each.xyz for each in model.keypoints}
    missing = [each for each in ids if each not in place]
    if missing:
        raise InputError(f"{model.model_id} has no keypoint {missing[0]}", where="ids")
    return np.array([place[each] for each in ids])


def _on_background(color: npt.NDArray[np.uint8], rng: np.random.Generator) -> np.ndarray:
    """A rendered picture (h, w, 4) before coarse noise, tinted, with noise; (h, w, 3) uint8."""
    height, width = color.shape[:2]
    coarse = rng.uniform(0, 255, (_COARSE, _COARSE, 3))
    rows = np.linspace(0, _COARSE - 1e-6, height).astype(int)
    columns = np.linspace(0, _COARSE - 1e-6, width).astype(int)
    background = coarse[rows][:, columns]
    share = color[..., 3:] / 255.0
    object_ = color[..., :3] * rng.uniform(*_TINT, 3)
    mixed = share * object_ + (1 - share) * background + rng.normal(0, _NOISE, background.shape)
    return np.asarray(np.clip(mixed, 0, 255), dtype=np.uint8)
