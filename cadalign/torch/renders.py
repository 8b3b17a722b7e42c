"""Rendered views of a category's models, to train and to judge a keypoint network with."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray
from cadalign.datasets.sample.model import SampleModel
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.render.raycast.renderer import RaycastRenderer
from cadalign.render.scene import Scene
from cadalign.render.viewpoints import frame_object, look_at, visible_keypoints
from cadalign.seeding import instance_rng
from cadalign.shapes.examples import Example
from cadalign.shapes.model import ShapeModel

_ELEVATION = (5.0, 50.0)  # [degrees]
_FILL = (0.6, 0.85)
_TINT = (0.6, 1.2)  # factors of the colour channels
_NOISE = 6.0  # of pixels, of 255
_COARSE = 6  # cells of a background's noise along a side


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
        If a model lacks a keypoint.
    """
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
