"""Real models seen by cameras, right or with a usual mistake, and what estimates say of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from cadalign import Alignment, Camera, Result
from cadalign.datasets import KeypointNet
from cadalign.errors import CadalignError
from cadalign.shapes.examples import Example
from cadalign.shapes.model import ShapeModel

CATEGORIES = ("chair", "bottle", "airplane", "mug")
CAMERA = Camera(640, 480, 935.0, 935.0, 319.5, 239.5)
LEAST = 9  # keypoints of a model


@dataclass(frozen=True)
class Sighting:
    """Keypoints (n, 3) of an upright object, by their ids, and where a camera sees them (n, 2)."""

    points_3d: np.ndarray
    ids: tuple[int, ...]
    points_2d: np.ndarray
    camera: Camera
    pose: Alignment

    def swapped(self) -> Sighting:
        return replace(self, points_2d=self.points_2d[:, ::-1].copy())

    def flipped(self) -> Sighting:
        return replace(self, points_2d=self.points_2d * [-1, 1] + [self.camera.width - 1, 0])

    def upside_down(self) -> Sighting:
        return replace(self, points_2d=self.points_2d * [1, -1] + [0, self.camera.height - 1])

    def mirrored(self) -> Sighting:
        return replace(self, points_3d=self.points_3d * [-1, 1, 1])

    def of_size(self, factor: float) -> Sighting:
        return replace(self, points_2d=(self.points_2d + 0.5) * factor - 0.5)

    def normalised(self) -> Sighting:
        return replace(self, points_2d=self.points_2d / [self.camera.width, self.camera.height])


@cache
def examples(root: Path, category: str) -> tuple[Example, ...]:
    """Annotated models of a category of KeypointNet with enough keypoints."""
    models = KeypointNet(root / "keypointnet").subset(categories=[category])
    return tuple(
        Example(each.model_id, [int(name) for name in each.keypoints.ids], xyz)
        for each in models
        if len(xyz := np.array(each.keypoints.xyz)) >= LEAST
    )


@cache
def learned(root: Path, category: str) -> ShapeModel:
    """The shape of a category, learned from every other model."""
    known = examples(root, category)[::2]
    return ShapeModel.learn(known[:100], category=category, components=1, up_axis="y")


def sighting(
    points: np.ndarray,
    ids: tuple[int, ...],
    rng: np.random.Generator,
    *,
    camera: Camera = CAMERA,
    noise_px: float = 1.0,
    distance: tuple[float, float] = (1.5, 4.0),
) -> Sighting:
    """An upright object's points from a random side and height, near the middle of the image."""
    while True:
        azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(-10, 50))
        flat = np.cos(elevation)
        backward = np.array([flat * np.sin(azimuth), np.sin(elevation), flat * np.cos(azimuth)])
        right = np.cross([0, 1, 0], backward) / flat
        rotation = np.array([right, np.cross(right, backward), -backward])
        far = rng.uniform(*distance)
        place = far * np.array([rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1), 1.0])
        pose = Alignment(rotation, place - rotation @ points.mean(axis=0), np.ones(3))
        in_camera = pose.apply(points)
        if in_camera[:, 2].min() > 0.3:
            noise = rng.normal(0, noise_px, (len(points), 2))
            return Sighting(points, ids, camera.project(in_camera) + noise, camera, pose)


def seen(root: Path, category: str, seed: int, **options: object) -> Sighting:
    """A stretched model of the category; its keypoints are those of the model as it is."""
    models, rng = examples(root, category), np.random.default_rng([seed, 3])
    model = models[7 * seed % len(models)]
    scale = np.exp([0.0, *rng.normal(0, 0.15, 2)])
    found = sighting(model.points_3d * scale, tuple(model.ids), rng, **options)
    return replace(found, points_3d=model.points_3d)


def said(estimate: Callable[[], Result]) -> str:
    """All that an estimate says: its warnings, or its refusal."""
    try:
        return " | ".join(map(str, estimate().warnings))
    except CadalignError as error:
        return str(error)
